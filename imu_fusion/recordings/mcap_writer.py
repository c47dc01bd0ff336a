"""MCAP files, written a chunk at a time.

The records are those of ``mcap``; its own writer takes some 10 us for each message, most of it in
building an object and writing a field at a time. Here a message is two byte strings until its
chunk is complete, and numpy makes the indices of the chunk.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import BinaryIO

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

# A message's record ahead of its data (https://mcap.dev/spec#message-op0x05).
_HEAD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
                  ("log_time", "<u8"), ("publish_time", "<u8")])
_PACK_HEAD = struct.Struct("<BQHIQQ").pack
_BEHIND_LENGTH = _HEAD.itemsize - 9    # what `length` counts beside the data
_INDEX = np.dtype([("log_time", "<u8"), ("offset", "<u8")])

COMPRESSIONS: Mapping[str, tuple[str, Callable[[bytes], bytes]]] = {
    "zstd": ("zstd", zstandard.compress), "lz4": ("lz4", lz4.frame.compress),
    "none": ("", lambda data: data)}
"""Our names of compressions: to MCAP's, and what compresses."""


class McapWriter:
    """One MCAP file with chunks, CRCs, indices and a summary.

    Args:
        stream: binary file open for writing, at its beginning.
        profile, library: what the header says.
        chunk_size: bytes of messages beyond which a chunk is complete; it is flushed then.
        compression: a key of COMPRESSIONS.

    All methods raise OSError where the disk is full. ``start_time`` and ``end_time`` are those of
    the messages in complete chunks, int ns, None without any.
    """

    def __init__(self, stream: BinaryIO, profile: str, library: str, chunk_size: int,
                 compression: str) -> None:
        self._stream, self._chunk_size = stream, chunk_size
        self._compression, self._compress = COMPRESSIONS[compression]
        self._schemas: list[McapRecord] = []
        self._channels: list[McapRecord] = []
        self._chunks: list[McapRecord] = []
        self._counts: Counter[int] = Counter()
        self.start_time: int | None = None
        self.end_time: int | None = None
        self._position = 0
        self._definitions: list[McapRecord] = []   # of which the next chunk is the first to know
        self._pieces: list[bytes] = []             # head and data of each message
        self._size = 0
        self._write(MCAP0_MAGIC + _bytes([Header(profile, library)]))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Register a schema; returns its id."""
        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._definitions.append(schema)
        return schema.id

    def add_channel(self, topic: str, encoding: str, schema: int,
                    metadata: dict[str, str]) -> int:
        """Register a channel; returns its id."""
        channel = Channel(id=len(self._channels) + 1, topic=topic, message_encoding=encoding,
                          metadata=metadata, schema_id=schema)
        self._channels.append(channel)
        self._definitions.append(channel)
        return channel.id

    def add_message(self, channel: int, sequence: int, log_time: int, publish_time: int,
                    data: bytes) -> None:
        """Append one message; times are int nanoseconds."""
        self._pieces += (_PACK_HEAD(Opcode.MESSAGE, _BEHIND_LENGTH + len(data), channel, sequence,
                                    log_time, publish_time), data)
        self._size += _HEAD.itemsize + len(data)
        if self._size > self._chunk_size:
            self.end_chunk()

    def finish(self, name: str, metadata: dict[str, str]) -> None:
        """Write the open chunk, a metadata record and the summary; the stream stays open."""
        self.end_chunk()
        record = _bytes([Metadata(name=name, metadata=metadata)])
        index = MetadataIndex(offset=self._position, length=len(record), name=name)
        self._write(record + _bytes([DataEnd(data_section_crc=0)]))
        begin, summary = self._position, b""
        offsets: list[McapRecord] = []
        for opcode, records in ((Opcode.SCHEMA, self._schemas), (Opcode.CHANNEL, self._channels),
                                (Opcode.STATISTICS, [self._statistics()]),
                                (Opcode.CHUNK_INDEX, self._chunks),
                                (Opcode.METADATA_INDEX, [index])):
            group = _bytes(records)
            offsets.append(SummaryOffset(group_opcode=opcode, group_start=begin + len(summary),
                                         group_length=len(group)))
            summary += group
        offsets_begin = begin + len(summary)
        summary += _bytes(offsets)
        # The CRC goes up to its own field.
        footer = _bytes([Footer(summary_start=begin, summary_offset_start=offsets_begin,
                                summary_crc=0)])[:-4]
        crc = zlib.crc32(summary + footer)
        self._write(summary + footer + struct.pack("<I", crc) + MCAP0_MAGIC)

    def end_chunk(self) -> None:
        """Write and flush the open chunk, if it has messages."""
        if not self._pieces:
            return
        definitions = _bytes(self._definitions)
        heads = np.frombuffer(b"".join(self._pieces[::2]), _HEAD)
        data = definitions + b"".join(self._pieces)
        self._definitions, self._pieces, self._size = [], [], 0
        index = np.empty(len(heads), _INDEX)
        index["log_time"] = heads["log_time"]
        sizes = heads["length"].astype(np.int64) + 9
        index["offset"] = len(definitions) + np.cumsum(sizes) - sizes
        start, end = int(heads["log_time"].min()), int(heads["log_time"].max())
        compressed = self._compress(data)
        chunk = _bytes([Chunk(compression=self._compression, data=compressed,
                              message_start_time=start, message_end_time=end,
                              uncompressed_crc=zlib.crc32(data), uncompressed_size=len(data))])
        indices, offsets = b"", {}
        for channel in np.unique(heads["channel"]).tolist():
            entries = index[heads["channel"] == channel].tobytes()
            offsets[channel] = self._position + len(chunk) + len(indices)
            indices += struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(entries), channel,
                                   len(entries)) + entries
            self._counts[channel] += len(entries) // _INDEX.itemsize
        self._chunks.append(ChunkIndex(
            chunk_length=len(chunk), chunk_start_offset=self._position,
            compression=self._compression, compressed_size=len(compressed),
            message_start_time=start, message_end_time=end, message_index_length=len(indices),
            message_index_offsets=offsets, uncompressed_size=len(data)))
        self.start_time = start if self.start_time is None else min(self.start_time, start)
        self.end_time = end if self.end_time is None else max(self.end_time, end)
        self._write(chunk + indices)
        self._stream.flush()

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=0, channel_count=len(self._channels),
            channel_message_counts=dict(self._counts), chunk_count=len(self._chunks),
            message_count=self._counts.total(), message_start_time=self.start_time or 0,
            message_end_time=self.end_time or 0, metadata_count=1,
            schema_count=len(self._schemas))

    def _write(self, data: bytes) -> None:
        self._stream.write(data)
        self._position += len(data)


def _bytes(records: Iterable[McapRecord]) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()
