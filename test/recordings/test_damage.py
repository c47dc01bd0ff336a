"""Damaged recordings: what is sound is read, and what is lost is said."""

import json
import random
import struct
import zlib

import numpy as np
import pytest

from benchmarks.fuzz import write_db3, write_mcap, write_ros1
from imu_fusion.calibrate.files import read_topic
from imu_fusion.errors import INCOMPLETE
from imu_fusion.messages.convert import fix_message, imu_message
from imu_fusion.messages.layouts import FIX, IMU
from imu_fusion.nodes.pipeline import find_left_out, plan_pipeline
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.logs import read_log
from imu_fusion.recordings.mcap_records import HEAD, INDEX, MAGIC
from imu_fusion.recordings.repair import repair
from imu_fusion.samples.guard import Verdict
from imu_fusion.streams.orientation import OrientationStream
from imu_fusion.streams.smoother import SmootherStream
from test.recordings.doors import rows_of, run, through
from test.recordings.raw_mcap import channel, chunk, in_chunk, mcap, message, schema
from test.recordings.test_bag import START, STEP, imu, write


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
@pytest.mark.parametrize("damage", ["zeros", "lost", "zeros at a border", "foreign"])
def test_a_hole_in_an_mcap_costs_the_chunks_it_touches(tmp_path, compression, damage):
    file = write_mcap(tmp_path, compression)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    before, _ = rows_of(file)
    data = file.read_bytes()
    at = len(data) // 2
    if damage == "zeros at a border":
        at = data.index(compression.encode() if compression != "none" else b"\x06", at) - 40
    filler = {"lost": b"", "foreign": random.Random(1).randbytes(1000)}.get(damage, bytes(1000))
    file.write_bytes(data[:at] + filler + data[at + 1000:])
    after, reader = rows_of(file)
    # Chunks are of 8192 bytes, 18 messages and more: three may be touched.
    assert len(before) - 110 <= len(after) < len(before)
    assert [row for row in before if row in set(after)] == after
    assert reader.damaged and any(f"{START // 10**9 // 100}" in text for text in reader.warnings)
    assert through("info", file, None).exit_code == INCOMPLETE
    counts = repair(file, tmp_path / "clean")
    assert sum(counts.values()) == len(after)
    clean, reader = rows_of(tmp_path / "clean")
    assert clean == after and not reader.warnings


def test_what_is_lost_is_told_with_its_stamps_and_number(tmp_path):
    file = write_mcap(tmp_path, "zstd")
    before, _ = rows_of(file)
    data = bytearray(file.read_bytes())
    data[len(data) // 2:len(data) // 2 + 100] = bytes(100)
    file.write_bytes(data)
    after, reader = rows_of(file)
    lost = sorted(set(before) - set(after), key=lambda row: row[2])
    (warning,) = reader.warnings
    first, last = (f"{row[2] // 10**9}.{row[2] % 10**9:09d}" for row in (lost[0], lost[-1]))
    assert f"{len(lost)} messages" in warning and first in warning and last in warning


def test_what_was_cut_off_is_read_up_to_the_cut(tmp_path):
    for compression in ("none", "zstd"):
        file = write_mcap(tmp_path / compression, compression)
        before, _ = rows_of(file)
        data = file.read_bytes()
        for share in (0.2, 0.5, 0.8):
            file.write_bytes(data[:int(share * len(data))] + bytes(4096))
            after, reader = rows_of(file)
            assert after == before[:len(after)] and reader.warnings
            assert reader.damaged or after == before    # the index behind the data is cut off
            assert len(after) > share * 0.9 * len(before) - 40


def test_an_index_that_is_cut_off_costs_nothing(tmp_path):
    file = write_mcap(tmp_path, "zstd")
    before, _ = rows_of(file)
    file.write_bytes(file.read_bytes()[:-150])
    after, reader = rows_of(file)
    assert after == before and not reader.damaged and "not closed properly" in reader.warnings[0]


def test_a_hole_in_a_chunk_without_checksum_is_stepped_over_and_told(tmp_path):
    """As rosbag2's preset fastwrite leaves it."""
    opcode, content = in_chunk(schema(IMU.msgtype), channel("/imu"), *(
        message(imu(i), log_time=START + i * STEP) for i in range(20)))
    content = bytearray(content)
    at = len(content) // 2
    content[at:at + 600] = bytes(600)
    rows, reader = rows_of(mcap(tmp_path / "t.mcap", (opcode, bytes(content))))
    found = [row[2] for row in rows]
    assert 15 <= len(rows) < 20 and {START, START + 19 * STEP} <= set(found)
    assert reader.damaged and "in a chunk at byte" in " ".join(reader.warnings)


def test_a_checksum_tells_a_changed_byte(tmp_path):
    content = b"".join(struct.pack("<BQ", op, len(c)) + c for op, c in (
        schema(IMU.msgtype), channel("/imu"), message(imu(0))))
    sound = mcap(tmp_path / "a.mcap", chunk("", content, len(content), zlib.crc32(content)))
    assert through("info", sound, None).exit_code == 0
    changed = bytearray(content)
    changed[-1] ^= 1
    file = mcap(tmp_path / "b.mcap", chunk("", bytes(changed), len(content), zlib.crc32(content)))
    result = through("info", file, None)
    assert result.exit_code == INCOMPLETE and "its checksum does not fit" in result.output


def test_a_ros1_bag_is_read_around_its_hole(tmp_path):
    file = write_ros1(tmp_path)
    before, _ = rows_of(file)
    data = file.read_bytes()
    at = len(data) // 2
    for broken in (data[:at] + bytes(500) + data[at + 500:], data[:at] + data[at + 500:],
                   data[:at]):
        file.write_bytes(broken)
        after, reader = rows_of(file)
        # Without a checksum nothing tells the two messages into which the hole has bitten.
        sound = [row for row in after if row in set(before)]
        assert reader.damaged and len(after) - len(sound) <= 2
        assert [row for row in before if row in set(sound)] == sound
        assert len(after) >= (0.4 if broken == data[:at] else 0.7) * len(before)


def in_one_chunk(folder):
    """A ROS 1 bag as small ones are, its rows and its bytes."""
    file = write_ros1(folder, 1 << 20)
    return file, rows_of(file)[0], file.read_bytes()


@pytest.mark.parametrize("damage", ["zeros", "foreign", "lost", "cut off"])
def test_damage_in_the_only_chunk_of_a_ros1_bag_costs_what_it_touches(tmp_path, damage):
    file, before, data = in_one_chunk(tmp_path)
    at = len(data) // 2
    filler = {"lost": b"", "foreign": random.Random(1).randbytes(1000)}.get(damage, bytes(1000))
    file.write_bytes(data[:at] + (b"" if damage == "cut off" else filler + data[at + 1000:]))
    after, reader = rows_of(file)
    sound = [row for row in after if row in set(before)]
    assert reader.damaged and [row for row in before if row in set(sound)] == sound
    # The message into which the damage has bitten may be read as it is now.
    assert len(after) - len(sound) <= 1
    assert len(sound) >= (0.4 * len(before) if damage == "cut off" else len(before) - 8)


def test_the_beginning_of_a_ros1_bag_is_not_all_of_it(tmp_path):
    file, before, data = in_one_chunk(tmp_path)
    header = data.index(b"compression=none") - 8
    for broken in (bytes(13) + data[13:],                                  # what it begins with
                   data[:13] + bytes(4096) + data[13 + 4096:],             # the header of the bag
                   data[:header] + bytes(30) + data[header + 30:]):        # the one of the chunk
        file.write_bytes(broken)
        after, reader = rows_of(file)
        assert after == before and reader.damaged


def test_definitions_of_a_ros1_bag_stand_in_it_twice(tmp_path):
    file, before, data = in_one_chunk(tmp_path)
    behind = data.rindex(b"geometry_msgs/Quaternion")
    file.write_bytes(data[:behind] + bytes(300) + data[behind + 300:])
    assert rows_of(file)[0] == before
    text = data.index(b"geometry_msgs/Quaternion")
    assert text < behind
    file.write_bytes(data[:text] + bytes(300) + data[text + 300:])
    assert rows_of(file)[0] == before


def test_a_ros1_recorder_that_was_killed_has_not_closed_its_chunk(tmp_path):
    """Its header stands there, without a size: rosbag reindex reads on, too."""
    file, before, data = in_one_chunk(tmp_path)
    sizes = data.index(b"size=", data.index(b"compression=none")) + len("size=")
    unclosed = data[:sizes] + bytes(8) + data[sizes + 8:len(data) // 2]
    (tmp_path / "t.bag.active").write_bytes(unclosed)
    after, reader = rows_of(tmp_path / "t.bag.active")
    assert reader.damaged and after == before[:len(after)] and len(after) > 0.4 * len(before)


def test_a_foreign_index_of_a_chunk_is_not_believed(tmp_path):
    file, before, data = in_one_chunk(tmp_path)
    entries = data.index(b"ver=", data.index(b"compression=none") + 1)
    entries = data.index(struct.pack("<I", 12 * 300), entries) + 4    # of the Imu
    file.write_bytes(data[:entries] + random.Random(2).randbytes(600) + data[entries + 600:])
    after, reader = rows_of(file)
    assert after == before and reader.end_time - 1 == max(row[2] for row in before)


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_a_damaged_index_of_a_chunk_hides_no_topic(tmp_path, compression):
    file = write_mcap(tmp_path, compression)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    before, _ = rows_of(file)
    data, indices, position = file.read_bytes(), [], len(MAGIC)
    while len(indices) < 2:    # of the first chunk
        opcode, length = HEAD.unpack_from(data, position)
        indices += [position] * (opcode == INDEX)
        position += HEAD.size + length
    file.write_bytes(data[:indices[1]] + bytes(30) + data[indices[1] + 30:])
    for topic in {row[0] for row in before}:
        with open_bag(file) as reader:
            assert list(reader.messages([topic])) == [row for row in before if row[0] == topic]
            assert reader.damaged and "are missing" not in " ".join(reader.warnings)


def test_bytes_that_are_missing_at_the_beginning_leave_the_index_good(tmp_path):
    """With the definitions that are lost ahead of it."""
    file = write_mcap(tmp_path, "lz4")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    before, _ = rows_of(file)
    data = file.read_bytes()
    file.write_bytes(data[:20] + data[1000:])
    after, reader = rows_of(file)
    assert reader.damaged and len(after) > len(before) - 70 and set(after) < set(before)


def test_a_database_is_read_around_its_damaged_pages(tmp_path):
    file = write_db3(tmp_path)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    before, _ = rows_of(file)
    data = bytearray(file.read_bytes())
    at = len(data) // 2 // 4096 * 4096
    data[at:at + 4096] = bytes(4096)
    file.write_bytes(data)
    after, reader = rows_of(file)
    assert reader.damaged and 0.9 * len(before) < len(after) < len(before)
    assert set(after) < set(before)


def test_a_database_that_was_cut_off_is_read_up_to_the_cut(tmp_path):
    file = write_db3(tmp_path)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    before, _ = rows_of(file)
    data = file.read_bytes()
    file.write_bytes(data[:len(data) // 2])
    after, reader = rows_of(file)
    assert reader.damaged and set(after) < set(before) and len(after) > 0.3 * len(before)


def test_a_file_of_a_split_recording_that_is_none_costs_no_other(tmp_path):
    bag = write(tmp_path / "bag", 30)
    before, _ = rows_of(bag)
    (bag / "metadata.yaml").unlink()
    (bag / "bag_1.mcap").write_bytes(b"garbage" * 100)
    (bag / "bag_2.mcap").write_bytes(b"")
    after, reader = rows_of(bag)
    assert after == before and reader.damaged
    assert "bag_1.mcap is left out" in " ".join(reader.warnings)
    (bag / "bag_0.mcap").unlink()
    result = through("info", bag, None)
    assert result.exit_code == 1 and "none of its files can be read" in result.output


def test_a_broken_message_among_many_stops_no_door_and_is_counted_alike(tmp_path):
    bag, messages = tmp_path / "bag", []
    for i in range(400):
        stamp = START + (i - (i == 300)) * STEP
        cdr = imu_message(stamp, "imu", [0.0, np.nan if i == 200 else 0.0, 0.1], [0.0, 0.0, 9.81])
        messages.append(cdr[:60] if i == 170 else cdr)
    with BagWriter(bag) as writer:
        for i, cdr in enumerate(messages):
            writer.write("/imu/data_raw", IMU.msgtype, cdr, START + i * STEP)
            if i % 20 == 0:
                writer.write("/fix", FIX.msgtype, fix_message(
                    START + i * STEP, "gnss", 47.0, 11.0, 600.0, np.eye(3)), START + i * STEP)
    info = through("info", bag, None)
    assert info.exit_code == INCOMPLETE and "1 messages cannot be decoded" in info.output
    result = through("process", bag, tmp_path / "out")
    assert result.exit_code == INCOMPLETE and "1 repeated stamp" in result.output
    why = {"cannot be decoded": 1, Verdict.NOT_FINITE.value: 1, Verdict.DUPLICATE.value: 1}
    expected = {node: {"imu/data_raw": why} for node in ("orientation_estimator", "smoother")}
    assert json.loads((tmp_path / "out" / "results.json").read_text())["left_out"] == expected
    assert find_left_out(bag, plan_pipeline(bag)) == (expected, [])
    for live in (OrientationStream(), SmootherStream()):
        for cdr in messages:
            live.take({"imu/data_raw": [cdr]})
        assert live.refused("imu/data_raw") == why
    with open_bag(bag) as reader:
        assert len(read_log(reader, "imu/data_raw")) == 399 and reader.damaged
    assert through("convert", bag, tmp_path / "copy").exit_code == 0    # its bytes as they are
    assert run("report", bag, "--out", tmp_path / "r.html").exit_code == INCOMPLETE
    exported = run("export", bag, tmp_path / "tables")
    assert exported.exit_code == INCOMPLETE and "1 messages cannot be decoded" in exported.output
    lost = []
    log, fix, remarks = read_topic(bag, "imu/data_raw", lost.append)    # of every calibration
    assert len(log) == 397 and len(fix) == 1 and len(remarks) == 2
    assert len(lost) == 1 and "1 messages cannot be decoded" in lost[0]
