"""Our MCAP files against the writer and the readers of ``mcap``."""

import io
import struct
import zlib

import numpy as np
import pytest
from mcap.records import (
    Chunk,
    ChunkIndex,
    Footer,
    MessageIndex,
    MetadataIndex,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from imu_fusion.recordings.mcap_writer import COMPRESSIONS, McapWriter

CHUNK = 4000
PLACES = {ChunkIndex, MessageIndex, MetadataIndex, SummaryOffset, Footer}


def messages():
    """(channel, sequence, log time, publish time, data), out of order, of many lengths."""
    rng = np.random.default_rng(3)
    for i in range(400):
        stamp = 1_700_000_000_000_000_000 + int(rng.integers(0, 10 ** 9))
        yield 1 + i % 3, i, stamp, stamp - 5, rng.bytes(int(rng.integers(0, 90)))


def ours(compression):
    stream = io.BytesIO()
    writer = McapWriter(stream, "ros2", "test", CHUNK, compression)
    for k in range(2):
        schema = writer.add_schema(f"a_msgs/msg/T{k}", "ros2msg", b"int8 x")
        writer.add_channel(f"/t{k}", "cdr", schema, {"key": "value"})
    for i, message in enumerate(messages()):
        if i == 2:    # a topic that appears later
            writer.add_channel("/late", "cdr", 1, {})
        writer.add_message(*message)
    writer.finish("rosbag2", {"a": "b"})
    return stream.getvalue()


def theirs(compression):
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=CHUNK, compression=compression)
    writer.start("ros2", "test")
    for k in range(2):
        schema = writer.register_schema(f"a_msgs/msg/T{k}", "ros2msg", b"int8 x")
        writer.register_channel(f"/t{k}", "cdr", schema, {"key": "value"})
    for i, (channel, sequence, log_time, publish_time, data) in enumerate(messages()):
        if i == 2:
            writer.register_channel("/late", "cdr", 1, {})
        writer.add_message(channel, log_time, data, publish_time, sequence)
    writer.add_metadata("rosbag2", {"a": "b"})
    writer.finish()
    return stream.getvalue()


def records(data, **options):
    return list(StreamReader(io.BytesIO(data), validate_crcs=True, **options).records)


def of(kind, found):
    return [record for record in found if isinstance(record, kind)]


@pytest.mark.parametrize("name", COMPRESSIONS)
def test_a_file_holds_what_mcap_s_own_writer_would_have_written(name):
    mine, other = (records(data) for data in (
        ours(name), theirs(CompressionType[name.upper()])))
    for kind in {type(record) for record in other} - PLACES - {Statistics}:
        assert sorted(map(repr, of(kind, mine))) == sorted(map(repr, of(kind, other)))
    (counts,), (expected,) = of(Statistics, mine), of(Statistics, other)
    # Chunks end a few bytes later: definitions do not count.
    expected.chunk_count = counts.chunk_count
    assert counts == expected and counts.chunk_count > 3


def test_indices_point_at_what_they_name():
    """Every entry of every message index, the indices of the summary, and the summary's CRC."""
    data = ours("none")
    found = records(data, emit_chunks=True)
    indices = of(MessageIndex, found)
    count = 0
    for chunk, index in zip(of(Chunk, found), of(ChunkIndex, found), strict=True):
        assert data[index.chunk_start_offset] == 0x06
        ends = chunk.message_start_time, chunk.message_end_time
        assert ends == (index.message_start_time, index.message_end_time)
        times = []
        for offset in index.message_index_offsets.values():
            assert data[offset] == 0x07
            entry = indices.pop(0)
            for log_time, place in entry.records:
                opcode, _, channel, _, stamp = struct.unpack_from("<BQHIQ", chunk.data, place)
                assert (opcode, channel, stamp) == (5, entry.channel_id, log_time)
                times.append(log_time)
        assert (min(times), max(times)) == ends
        count += len(times)
    assert count == 400 and not indices
    for group in of(SummaryOffset, found):
        assert data[group.group_start] == group.group_opcode
    (index,), (footer,) = of(MetadataIndex, found), of(Footer, found)
    assert data[index.offset] == 0x0C
    assert zlib.crc32(data[footer.summary_start:-12]) == footer.summary_crc
