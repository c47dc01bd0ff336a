"""MCAP files (https://mcap.dev/spec), whole or damaged, by one way.

The records of the file are walked from its begin to its end, without unpacking a chunk: an index
at the end is a convenience that a crash leaves out. Where no record follows, the next one is
searched for; a chunk is checked when it is unpacked, and left out if its bytes have changed.
"""

import contextlib
import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imu_fusion.errors import BagError
from imu_fusion.recordings.qos import read_profiles
from imu_fusion.recordings.storage import (
    DamageError,
    Part,
    Row,
    Storage,
    StoredTopic,
    Window,
    in_order,
    span,
    unpack,
)

MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX, _DATA_END = 2, 3, 4, 5, 6, 7, 15
_LAST = 15                 # opcode of the specification
_PRIVATE = 128             # and beyond: of others, may be stepped over
# Least and greatest length of each record; the lengths inside of it must add up besides.
_LENGTHS = {1: (8, 1 << 20), 2: (20, 20), 3: (14, 1 << 26), 4: (16, 1 << 26), 5: (22, 1 << 62),
            6: (40, 1 << 62), 7: (6, 1 << 40), 8: (64, 1 << 30), 9: (36, 1 << 62),
            10: (44, 1 << 30), 11: (42, 1 << 30), 12: (8, 1 << 30), 13: (20, 1 << 30),
            14: (17, 17), 15: (4, 4)}
_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_AGREE = 3                 # records in a row that are not there by chance
_SEARCH = 1 << 20
_TOGETHER = 1 << 20        # bytes of records outside of chunks that are read at once
_TRIES = 3                 # chunks that are unpacked in search of a channel


class _Channel(NamedTuple):
    schema: int
    topic: str
    encoding: str
    metadata: dict[str, str]


class _Schema(NamedTuple):
    name: str
    encoding: str
    data: bytes


@dataclass
class _Block:
    """A chunk, or a run of records outside of chunks (``compression`` None)."""

    position: int
    size: int
    unpacked: int
    compression: str | None
    crc: int = 0
    first: int | None = None
    last: int | None = None
    counts: dict[int, int] = field(default_factory=dict)   # messages of each channel

    def saw(self, first: int, last: int) -> None:
        """Its log times are at least from ``first`` to ``last``."""
        self.first = first if self.first is None else min(self.first, first)
        self.last = last if self.last is None else max(self.last, last)


class McapStorage(Storage):
    """See :class:`imu_fusion.recordings.storage.Storage`."""

    def __init__(self, path: Path, lose: Callable[[str], object],
                 mention: Callable[[str], object]) -> None:
        super().__init__(path, lose, mention)
        self._file = Window(path)
        self._blocks: list[_Block] = []
        self._channels: dict[int, _Channel] = {}
        self._schemas: dict[int, _Schema] = {}
        # Those of the index: good as long as its checksum says so.
        self._index: tuple[dict[int, _Channel], dict[int, _Schema]] = {}, {}
        self._in_index = False
        self._holes: list[tuple[int, int, _Block]] = []   # (bytes, number of the block after, lost)
        self._lost: _Block | None = None    # a chunk that is no more, though its index may be
        try:
            self._walk()
            self._learn_channels()
            self._make_topics()
            self._tell_holes()
            if not self._blocks and not self._channels and self._file.read(0, 8) != MAGIC:
                raise BagError(f"{path}: not an MCAP file, or damaged beyond reading")
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        self._file.close()

    def messages(self, topics: Collection[str], start: int | None,
                 stop: int | None) -> Iterator[Row]:
        wanted = {number: channel.topic for number, channel in self._channels.items()
                  if channel.topic in topics and channel.topic in self.topics
                  and self._type_of(channel)}
        parts = [Part(block.first or 0, block.unpacked,
                      partial(self._rows, block, wanted, start, stop))
                 for block in self._blocks
                 if (not block.counts or not wanted.keys().isdisjoint(block.counts))
                 and (block.first is None or stop is None or block.first < stop)
                 and (block.last is None or start is None or block.last >= start)]
        return in_order(parts)

    # The walk over the records.

    def _walk(self) -> None:
        position = len(MAGIC) if self._file.read(0, len(MAGIC)) == MAGIC else 0
        size = self._file.size
        while position < size:
            if size - position == len(MAGIC) and self._file.read(position, 8) == MAGIC:
                return
            end = self._end_of(position)
            if end is None or not self._is_followed(position, end):
                position = self._resume(position)
                continue
            self._take(position, end)
            position = end

    def _resume(self, position: int) -> int:
        """The next record after one that is none; the end of the file without one."""
        start = position + 1
        block = self._blocks[-1] if self._blocks else None
        if block is not None and block.compression is not None and (
                block.position + block.size == position and not self._is_sound(block)):
            # The chunk before it is shorter than it says: bytes are missing in it.
            self._blocks.pop()
            position = start = block.position
        found = self._find(start)
        if self._in_index:
            self.mention(f"{self.path.name}: not closed properly: its index is damaged or cut off; "
                         "it is read without")
        else:
            self._lost = _Block(position, 0, 0, "")
            self._holes.append((found - position, len(self._blocks), self._lost))
        return found

    def _is_sound(self, block: _Block) -> bool:
        try:
            self._unpacked(block)
        except DamageError:
            return False
        return bool(block.crc)

    def _end_of(self, position: int) -> int | None:
        """Where the record at ``position`` ends, None if there is none."""
        head = self._file.read(position, _HEAD.size)
        if len(head) < _HEAD.size:
            return None
        opcode, length = _HEAD.unpack(head)
        if opcode == 0 or _LAST < opcode < _PRIVATE:
            return None
        end = position + _HEAD.size + length
        low, high = _LENGTHS.get(opcode, (0, 1 << 40))
        if not low <= length <= high or end > self._file.size:
            return None
        return end if self._adds_up(opcode, position + _HEAD.size, length) else None

    def _adds_up(self, opcode: int, position: int, length: int) -> bool:
        """Whether the lengths inside of a record make its own."""
        if opcode == _CHUNK:
            head = self._file.read(position, 72)
            (text,) = struct.unpack_from("<I", head, 28)
            if text > 32:
                return False
            (records,) = struct.unpack_from("<Q", head, 32 + text)
            return length == 40 + text + records
        if opcode == _INDEX:
            (entries,) = struct.unpack("<I", self._file.read(position + 2, 4))
            return length == 6 + entries and entries % 16 == 0
        if opcode in (_SCHEMA, _CHANNEL):
            try:
                content = self._file.read(position, length)
                (_schema if opcode == _SCHEMA else _channel)(content)
            except DamageError:
                return False
        return True

    def _is_followed(self, position: int, end: int) -> bool:
        """Whether a message outside of chunks, which nothing else vouches for, ends where another
        record begins, or the file does."""
        if self._file.read(position, 1)[0] != _MESSAGE or end == self._file.size:
            return True
        if self._end_of(end) is not None:
            return True
        head = self._file.read(end, _HEAD.size)
        if len(head) < _HEAD.size:
            return 0 < head[0] <= _LAST
        opcode, length = _HEAD.unpack(head)
        return (0 < opcode <= _LAST and length < 1 << 32
                and end + _HEAD.size + length > self._file.size)   # the cut end of a file

    def _find(self, start: int) -> int:
        """Position of the first record at or after ``start``, the size of the file without one."""
        while start < self._file.size - _HEAD.size:
            data = self._file.read(start, _SEARCH)
            bytes_ = np.frombuffer(data, np.uint8)
            count = len(bytes_) - _HEAD.size + 1
            opcode = bytes_[:count]
            length = np.lib.stride_tricks.sliding_window_view(bytes_[1:], 8)[:count]
            # The length fits into a file: its upper bytes are zero.
            places = np.flatnonzero((opcode > 0) & (opcode <= _LAST)
                                    & (length[:, 5:] == 0).all(axis=1))
            for place in places.tolist():
                if self._is_record(start + place):
                    return start + place
            start += count
        return self._file.size

    def _is_record(self, position: int) -> bool:
        """Whether enough records follow from ``position`` on not to be chance."""
        opcode = self._file.read(position, 1)[0]
        for _ in range(_AGREE):
            end = self._end_of(position)
            if end is None:
                return False
            if opcode == _CHUNK or end == self._file.size:
                return True
            position = end
            if self._file.size - position == len(MAGIC):
                return self._file.read(position, 8) == MAGIC
        return True

    # What the records say.

    def _take(self, position: int, end: int) -> None:
        opcode = self._file.read(position, 1)[0]
        content = position + _HEAD.size
        if opcode in (_CHUNK, _MESSAGE):
            self._lost = None
        if opcode == _CHUNK:
            self._take_chunk(content, end)
        elif opcode == _INDEX:
            self._take_index(self._file.read(content, end - content))
        elif opcode == _MESSAGE:
            number, _, log_time, _ = _MESSAGE_HEAD.unpack(
                self._file.read(content, _MESSAGE_HEAD.size))
            block = self._open_run(position)
            block.size = block.unpacked = end - block.position
            block.counts[number] = block.counts.get(number, 0) + 1
            block.saw(log_time, log_time)
        elif opcode in (_SCHEMA, _CHANNEL):
            channels, schemas = self._index if self._in_index else (self._channels, self._schemas)
            _define(opcode, self._file.read(content, end - content), channels, schemas)
        elif opcode == _DATA_END:
            self._in_index = True
        elif opcode == _FOOTER:
            self._check_index(position, self._file.read(content, 20))

    def _take_chunk(self, content: int, end: int) -> None:
        head = self._file.read(content, 72)
        first, last, unpacked, crc, text = _CHUNK_HEAD.unpack_from(head)
        compression = head[32:32 + text].decode("ascii", "replace")
        start = content + 40 + text
        self._blocks.append(_Block(start, end - start, unpacked, compression, crc,
                                   *((first, last) if first <= last else (None, None))))

    def _take_index(self, content: bytes) -> None:
        """How many messages of a channel the chunk before it holds, and when."""
        block = self._lost or (self._blocks[-1] if self._blocks else None)
        if block is None or block.compression is None or len(content) < 22:
            return
        (number,) = struct.unpack_from("<H", content)
        times = np.frombuffer(content, "<u8", offset=6)[::2]
        if not block.counts:
            block.first = block.last = None    # exact from here on
        block.counts[number] = len(times)
        block.saw(int(times.min()), int(times.max()))

    def _open_run(self, position: int) -> _Block:
        """The block of a message outside of chunks."""
        block = self._blocks[-1] if self._blocks else None
        if (block is None or block.compression is not None or block.size > _TOGETHER
                or block.position + block.size != position):
            block = _Block(position, 0, 0, None)
            self._blocks.append(block)
        return block

    def _check_index(self, position: int, footer: bytes) -> None:
        """Forget what the index said if its checksum does not fit."""
        start, _, crc = struct.unpack("<QQI", footer)
        if not crc or not 0 < start <= position:
            return
        value, size = 0, position + _HEAD.size + 16 - start
        for offset in range(0, size, _SEARCH):
            value = zlib.crc32(self._file.read(start + offset, min(_SEARCH, size - offset)), value)
        if value != crc:
            self._index = {}, {}
            self.mention(f"{self.path.name}: its index is damaged; it is read without")

    def _learn_channels(self) -> None:
        """Find the channels that messages name: beside the chunks, else inside of them."""
        channels, schemas = self._index
        self._channels = channels | self._channels
        self._schemas = schemas | self._schemas
        tries: dict[int, int] = {}
        for block in self._blocks:
            if block.compression is None:
                continue
            unknown = [n for n in block.counts if n not in self._channels
                       and tries.get(n, 0) < _TRIES]
            if block.counts and not unknown:
                continue
            counted = bool(block.counts)
            try:
                data = self._unpacked(block)
            except DamageError as error:
                self._lose_chunk(block, error)
                if block.compression:
                    continue
                counted = True
                data = self._file.read(block.position, block.size)    # definitions may be sound
            for number in unknown:
                tries[number] = tries.get(number, 0) + 1
            for opcode, content in _records(data):
                if opcode in (_SCHEMA, _CHANNEL):
                    with contextlib.suppress(DamageError):
                        _define(opcode, content, self._channels, self._schemas)
                elif opcode == _MESSAGE and not counted and len(content) >= _MESSAGE_HEAD.size:
                    number, _, log_time, _ = _MESSAGE_HEAD.unpack_from(content)
                    block.counts[number] = block.counts.get(number, 0) + 1
                    block.saw(log_time, log_time)

    def _type_of(self, channel: _Channel) -> str:
        """The message type of a channel; empty, if it is no topic of ROS 2."""
        schema = self._schemas.get(channel.schema)
        known = schema is not None and channel.encoding == "cdr" and channel.topic
        return schema.name if schema is not None and known else ""

    def _make_topics(self) -> None:
        counts: dict[int, int] = {}
        times: list[int] = []
        for block in self._blocks:
            for number, count in block.counts.items():
                counts[number] = counts.get(number, 0) + count
            if block.counts:
                times += [t for t in (block.first, block.last) if t is not None]
        if times:
            self.times = min(times), max(times)
        several: dict[str, set[str]] = {}
        for number, channel in self._channels.items():
            name, schema = self._type_of(channel), self._schemas.get(channel.schema)
            if not name or schema is None:
                kind = channel.encoding or "no encoding"
                self.left_out.append(f"{channel.topic or 'a channel without name'} ({kind})")
                continue
            topic = self.topics.get(channel.topic)
            if topic is None:
                source = f"{self.path.name}, QoS of {channel.topic}"
                topic = self.topics[channel.topic] = StoredTopic(
                    channel.topic, name, 0, read_profiles(
                        channel.metadata.get("offered_qos_profiles", ""), source),
                    (schema.data.decode("utf-8", "replace"),
                     channel.metadata.get("topic_type_hash", ""))
                    if schema.encoding == "ros2msg" else None)
            if topic.msgtype != name:
                several.setdefault(channel.topic, {topic.msgtype}).add(name)
            topic.count += counts.get(number, 0)
        for name, kinds in several.items():
            del self.topics[name]
            self.lose(f"topic {name} holds several types ({', '.join(sorted(kinds))}) and is left "
                      "out")
        unknown = sum(n for number, n in counts.items() if number not in self._channels)
        if unknown:
            self.lose(f"{self.path.name}: {unknown} messages are of channels whose definition is "
                      "lost with a damaged part; they are left out")

    def _tell_holes(self) -> None:
        for size, after, lost in self._holes:
            last = next((b.last for b in reversed(self._blocks[:after]) if b.last is not None),
                        None)
            first = next((b.first for b in self._blocks[after:] if b.first is not None), None)
            where = "damaged" if after < len(self._blocks) else (
                "damaged or cut off: the file is not closed properly; what comes before is "
                "recovered")
            which = (f"messages of {span(last, first)} may be missing" if not lost.counts else
                     f"{sum(lost.counts.values())} messages of {span(lost.first, lost.last)} are "
                     "missing")
            self.lose(f"{self.path.name}: {size if size > 0 else 'some'} bytes are {where}; "
                      f"{which}")
        if not self._in_index and not self._holes:
            self.lose(f"{self.path.name}: not closed properly; what comes before is recovered, "
                      "what was not yet written to the disk is missing")

    # Messages.

    def _unpacked(self, block: _Block) -> bytes:
        if block.compression is None:
            return self._file.read(block.position, block.size)
        if block.compression == "" and block.unpacked != block.size:
            raise DamageError(f"it unpacks to another size than the {block.unpacked} bytes stated")
        data = unpack(self._file.read(block.position, block.size), block.compression,
                      block.unpacked)
        if block.crc and zlib.crc32(data) != block.crc:
            raise DamageError("its checksum does not fit")
        return data

    def _lose_chunk(self, block: _Block, error: DamageError) -> None:
        count = sum(block.counts.values()) or "its"
        self.lose(f"{self.path.name}: a chunk at byte {block.position} is left out: {error}; "
                  f"{count} messages of {span(block.first, block.last)} are missing")

    def _rows(self, block: _Block, wanted: dict[int, str], start: int | None,
              stop: int | None) -> Iterator[Row]:
        try:
            data = self._unpacked(block)
        except DamageError as error:
            self._lose_chunk(block, error)
            return iter(())
        rows = []
        for opcode, content in _records(data):
            if opcode != _MESSAGE or len(content) < _MESSAGE_HEAD.size:
                continue
            number, _, log_time, _ = _MESSAGE_HEAD.unpack_from(content)
            topic = wanted.get(number)
            if topic is not None and (start is None or log_time >= start) and (
                    stop is None or log_time < stop):
                rows.append((log_time, topic, bytes(content[_MESSAGE_HEAD.size:])))
        rows.sort(key=lambda row: row[0])
        return iter(rows)


def _records(data: bytes) -> Iterator[tuple[int, memoryview]]:
    """(opcode, content) of the records of a chunk, as far as their lengths fit."""
    view, position = memoryview(data), 0
    while position + _HEAD.size <= len(data):
        opcode, length = _HEAD.unpack_from(data, position)
        position += _HEAD.size
        if length > len(data) - position:
            return
        yield opcode, view[position:position + length]
        position += length


def _define(opcode: int, content: bytes | memoryview, channels: dict[int, _Channel],
            schemas: dict[int, _Schema]) -> None:
    if opcode == _SCHEMA:
        number, schema = _schema(content)
        schemas[number] = schema
    else:
        number, channel = _channel(content)
        channels[number] = channel


def _schema(content: bytes | memoryview) -> tuple[int, _Schema]:
    reader = _Strings(content, 2)
    schema = _Schema(reader.text(), reader.text(), reader.take())
    reader.end()
    return struct.unpack_from("<H", content)[0], schema


def _channel(content: bytes | memoryview) -> tuple[int, _Channel]:
    reader = _Strings(content, 4)
    topic, encoding = reader.text(), reader.text()
    entries = _Strings(reader.take(), 0)
    metadata = {}
    while entries.left():
        key = entries.text()
        metadata[key] = entries.text()
    reader.end()
    number, schema = struct.unpack_from("<HH", content)
    return number, _Channel(schema, topic, encoding, metadata)


class _Strings:
    """Bytes with their length ahead of them, one after the other."""

    def __init__(self, data: bytes | memoryview, position: int) -> None:
        self._data, self._position = bytes(data), position

    def left(self) -> bool:
        return self._position < len(self._data)

    def take(self) -> bytes:
        start = self._position + 4
        if start > len(self._data):
            raise DamageError("a length is missing")
        (length,) = struct.unpack_from("<I", self._data, self._position)
        self._position = start + length
        if self._position > len(self._data):
            raise DamageError("a length is beyond the record")
        return self._data[start:self._position]

    def text(self) -> str:
        return self.take().decode("utf-8", "replace")

    def end(self) -> None:
        if self.left():
            raise DamageError("lengths do not add up")
