"""Damaged and hostile recordings: what is sound is read, what is lost is said, nothing else
happens. Broken files of each kind by the thousand: ``python -m benchmarks.fuzz``."""

import gzip
import json
import os
import random
import shutil
import sqlite3
import struct
import zipfile
import zlib
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from click.testing import CliRunner
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from benchmarks.fuzz import KINDS, mutated, outcome, write_db3, write_mcap, write_ros1
from imu_fusion.calibrate.files import read_topic
from imu_fusion.cli import cli
from imu_fusion.errors import INCOMPLETE, BagError
from imu_fusion.messages.convert import fix_message, imu_message, mag_message
from imu_fusion.messages.layouts import FIX, IMU, MAG
from imu_fusion.messages.typestore import TYPES
from imu_fusion.nodes.pipeline import find_left_out, plan_pipeline
from imu_fusion.recordings import mcap_records, ros1_storage
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.inspect import inspect_topics
from imu_fusion.recordings.logs import read_log
from imu_fusion.recordings.mcap_records import MAGIC
from imu_fusion.recordings.repair import repair
from imu_fusion.recordings.storage import DamageError
from imu_fusion.samples.guard import Verdict
from imu_fusion.streams.orientation import OrientationStream
from imu_fusion.streams.smoother import SmootherStream
from test.recordings.test_bag import START, STEP, imu, write

HOSTILE = Path(__file__).parents[3] / "shared" / "cases" / "hostile"
DOORS = ["info", "process", "convert", "repair"]


def run(*arguments):
    return CliRunner().invoke(cli, [str(a) for a in arguments])


def through(door, path, out):
    """One command on a recording; a traceback fails the test."""
    arguments = {"info": ["info", path], "process": ["process", path, out],
                 "convert": ["convert", path, out], "repair": ["info", path, "--repair", out]}
    result = run(*arguments[door])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def rows_of(path):
    with open_bag(path) as reader:
        return list(reader.messages()), reader


# What disks and cables do.

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


# Types of the recording itself.

def test_a_type_that_nobody_knows_hides_no_other(tmp_path):
    """rosgraph_msgs/Log is in every `rosbag record -a`, and not in ROS 2; its definition is."""
    noetic = get_typestore(Stores.ROS1_NOETIC)
    header = noetic.types["std_msgs/msg/Header"]
    time = noetic.types["builtin_interfaces/msg/Time"]
    log = noetic.types["rosgraph_msgs/msg/Log"]
    with Ros1Writer(tmp_path / "t.bag") as writer:
        imus = writer.add_connection("/imu", IMU.msgtype, typestore=noetic)
        logs = writer.add_connection("/rosout", "rosgraph_msgs/msg/Log", typestore=noetic)
        for i in range(50):
            message = TYPES.deserialize_cdr(imu(i), IMU.msgtype)
            stamp = message.header.stamp
            message.header = header(seq=i, stamp=stamp, frame_id="imu_link")
            writer.write(imus, START + i * STEP, noetic.serialize_ros1(message, IMU.msgtype))
            said = log(header=header(seq=i, stamp=time(sec=1, nanosec=i), frame_id=""), level=2,
                       name="/node", msg="hello", file="f.cpp", function="g", line=7,
                       topics=["/imu", "/rosout"])
            writer.write(logs, START + i * STEP, noetic.serialize_ros1(said, log.__msgtype__))
    for door in DOORS:
        assert through(door, tmp_path / "t.bag", tmp_path / door).exit_code == (
            0 if door != "process" else 1), door    # /imu is not imu/data_raw
    assert run("process", tmp_path / "t.bag", tmp_path / "out", "--remap",
               "imu/data_raw:=/imu").exit_code == 0
    with open_bag(tmp_path / "convert") as reader:
        assert len(read_log(reader, "/imu")) == 50
        text, _ = reader.definition("/rosout")
        types = get_typestore(Stores.ROS2_JAZZY)
        types.register({k: v for k, v in get_types_from_msg(
            text, "rosgraph_msgs/msg/Log").items() if k not in types.fielddefs})
        *_, cdr = list(reader.messages(["/rosout"]))[7]
        said = types.deserialize_cdr(cdr, "rosgraph_msgs/msg/Log")
        assert (said.msg, said.header.stamp.nanosec, said.topics) == ("hello", 7,
                                                                     ["/imu", "/rosout"])


def mcap(path, *records, end=True):
    """An MCAP file of records (opcode, content)."""
    records = [(1, struct.pack("<II", 0, 0)), *records, *([(15, bytes(4)), (2, bytes(20))] * end)]
    path.write_bytes(MAGIC + b"".join(struct.pack("<BQ", op, len(c)) + c for op, c in records)
                     + MAGIC * end)
    return path


def text(*words):
    return b"".join(struct.pack("<I", len(w)) + w for w in (w.encode() for w in words))


def schema(name, definition="", number=1, encoding="ros2msg"):
    return 3, struct.pack("<H", number) + text(name, encoding, definition)


def channel(topic, number=1, encoding="cdr"):
    return 4, struct.pack("<HH", number, number) + text(topic, encoding, "")


def message(cdr, number=1, log_time=START):
    return 5, struct.pack("<HIQQ", number, 0, log_time, log_time) + cdr


def chunk(compression, packed, size, crc=0):
    return 6, struct.pack("<QQQII", START, START, size, crc, len(compression)) + (
        compression.encode() + struct.pack("<Q", len(packed)) + packed)


def in_chunk(*records):
    content = b"".join(struct.pack("<BQ", op, len(c)) + c for op, c in records)
    return chunk("", content, len(content))


@pytest.mark.parametrize("definition", [
    "a/A x", "float64 " * 5000, "\0\xff", "float64[99999999999] x", "float64 x\n" * 3000,
    "string class\nint8 __init__"])
def test_definitions_are_handed_on_and_not_interpreted(tmp_path, definition):
    file = mcap(tmp_path / "t.mcap", schema("a/msg/A", definition), channel("/a"),
                message(b"\0\1\0\0" + bytes(40)), schema(IMU.msgtype, "", 2), channel("/imu", 2),
                message(imu(0), 2))
    assert through("info", file, None).exit_code == 0
    assert through("convert", file, tmp_path / "out").exit_code == 0
    with open_bag(tmp_path / "out") as reader:
        assert {t.name: t.count for t in reader.topics.values()} == {"/a": 1, "/imu": 1}


def test_other_encodings_are_named_and_not_called_damage(tmp_path):
    protobuf = [schema("foxglove.Log", "", 1, "protobuf"), channel("/log", 1, "protobuf"),
                message(b"\x08\x01")]
    only = through("info", mcap(tmp_path / "p.mcap", *protobuf), None)
    assert only.exit_code == 1 and "no topics of ROS 2" in only.output
    assert "/log (protobuf)" in only.output and "damaged" not in only.output
    beside = through("info", mcap(tmp_path / "q.mcap", *protobuf, schema(IMU.msgtype, "", 2),
                                  channel("/imu", 2), message(imu(0), 2)), None)
    assert beside.exit_code == 0 and "left out: /log (protobuf)" in beside.output


@pytest.mark.parametrize("name", ["", "/a\n/b", "/a\x1b[31m", "/a\u202eb"])
def test_names_that_are_none_are_not_shown_raw(tmp_path, name):
    file = mcap(tmp_path / "t.mcap", schema(IMU.msgtype), channel(name), message(imu(0)))
    result = through("info", file, None)
    assert result.exit_code == 1 and "\x1b" not in result.output and len(
        result.output.splitlines()) == 1


# Lengths.

def test_a_chunk_unpacks_within_a_bound_that_can_be_raised(tmp_path, monkeypatch):
    opcode, content = schema("a/msg/A", " " * 60_000_000, 2)
    unpacked = struct.pack("<BQ", opcode, len(content)) + content
    size = len(unpacked)
    for name, packed in (("zstd", zstandard.compress(unpacked)),
                         ("lz4", lz4.frame.compress(unpacked))):
        file = mcap(tmp_path / f"{name}.mcap", schema(IMU.msgtype), channel("/imu"),
                    message(imu(0)), chunk(name, packed, size))
        assert through("info", file, None).exit_code == 0
        monkeypatch.setenv("IMU_FUSION_MAX_CHUNK_MB", "50")
        result = through("info", file, None)
        assert result.exit_code == INCOMPLETE and "IMU_FUSION_MAX_CHUNK_MB" in result.output
        assert "--max-chunk-mb" in result.output
        assert run("--max-chunk-mb", "70", "info", file).exit_code == 0
        # What it says is not what it unpacks to.
        lying = mcap(tmp_path / "lying.mcap", schema(IMU.msgtype), channel("/imu"),
                     message(imu(0)), chunk(name, packed, 1000))
        assert "another size than the 1000 bytes" in through("info", lying, None).output
        monkeypatch.delenv("IMU_FUSION_MAX_CHUNK_MB")


def test_a_chunk_of_zeros_is_no_million_of_records(tmp_path):
    assert list(mcap_records.records(bytes(100))) == [(mcap_records.NONE, bytes(100))]
    with pytest.raises(DamageError):
        next(ros1_storage._records(bytes(100)))


@pytest.mark.parametrize("length", [0, 2**31 - 1, 2**32 - 1])
def test_lengths_inside_of_messages_are_not_believed(tmp_path, length):
    cdr = bytearray(imu(0))
    cdr[12:16] = struct.pack("<I", length)
    file = mcap(tmp_path / "t.mcap", schema(IMU.msgtype), channel("/imu"), message(bytes(cdr)),
                *(message(imu(i), log_time=START + i * STEP) for i in range(20)))
    result = through("info", file, None)
    assert result.exit_code == INCOMPLETE and "1 messages cannot be decoded" in result.output


# One rule for a broken message in every door.

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


def test_two_clocks_in_one_recording_are_told(tmp_path):
    """A magnetometer whose computer has not been told the time beside an Imu that has."""
    with BagWriter(tmp_path / "bag") as writer:
        for i in range(200):
            writer.write("/imu/data_raw", IMU.msgtype, imu_message(
                START + i * STEP, "imu", [0.0, 0.0, 0.1], [0.0, 0.0, 9.81]), START + i * STEP)
            writer.write("/imu/mag", MAG.msgtype, mag_message(
                100 * 10**9 + i * STEP, "imu", [2e-5, 0.0, -4e-5]), START + i * STEP)
    for door in ("info", "process"):
        result = through(door, tmp_path / "bag", tmp_path / "out")
        assert result.exit_code == 0
        assert "imu/mag: no sample lies within the Imu's time" in result.output


@pytest.mark.parametrize("log_time", [0, 1, 2**63, 2**64 - 1])
def test_log_times_at_the_ends_of_their_range(tmp_path, log_time):
    file = mcap(tmp_path / "t.mcap", schema(IMU.msgtype), channel("/imu"),
                message(imu(0), log_time=log_time), message(imu(1)))
    assert through("info", file, None).exit_code == 0
    assert through("convert", file, tmp_path / "out").exit_code == 0
    assert sorted(row[2] for row in rows_of(tmp_path / "out")[0]) == sorted([log_time, START])


def test_log_times_below_zero_are_zero(tmp_path):
    file = write_db3(tmp_path)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    before, _ = rows_of(file)
    with sqlite3.connect(file) as database:
        database.execute("update messages set timestamp = timestamp - ?", (START + STEP,))
    result = through("info", file, None)
    assert result.exit_code == 0 and "those below zero are read as zero" in result.output
    assert through("convert", file, tmp_path / "out").exit_code == 0
    after, _ = rows_of(tmp_path / "out")
    assert after[0][2] == 0 and [row[3] for row in after] == [row[3] for row in before]
    with open_bag(file) as reader:    # as the replayer asks for them
        assert len(list(reader.messages(None, reader.start_time, reader.end_time))) == len(before)


# rosbag2's metadata and compression.

def test_metadata_is_a_hint(tmp_path):
    bag = write(tmp_path / "bag", 30)
    good = (bag / "metadata.yaml").read_text()
    for content, words in (
            ("", "is not used"), ("[1]", "is not used"), ("a: &a [*a]", "contains itself"),
            ("[" * 3000, "is not used"), ("!!python/object/apply:os.system [x]", "is not used"),
            (good.replace("bag_0.mcap", "gone_0.mcap"), "gone_0.mcap, which is not there"),
            (good.replace("bag_0.mcap", "../../etc/passwd"), "passwd, which is not there")):
        (bag / "metadata.yaml").write_text(content)
        rows, reader = rows_of(bag)
        assert len(rows) == 40 and words in " ".join(reader.warnings) and not reader.damaged
    for content in (good, good.replace("message_count: 30", "message_count: 99999999999999999999"),
                    good.replace("depth: 10", "depth: deep")):
        (bag / "metadata.yaml").write_text(content)
        rows, reader = rows_of(bag)
        assert len(rows) == 40 and not reader.warnings
    (bag / "metadata.yaml").write_text(good)
    shutil.copy(bag / "bag_0.mcap", bag / "bag_1.mcap")
    rows, reader = rows_of(bag)
    assert len(rows) == 40 and "bag_1.mcap is not named" in reader.warnings[0]


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


@pytest.mark.parametrize("make, name", [
    (lambda f: write_mcap(f, "zstd"), "t.bag"), (write_db3, "t.mcap"), (write_ros1, "t.bag.active"),
    (lambda f: write_mcap(f, "none"), "recording")])
def test_the_first_bytes_say_what_a_file_is(tmp_path, make, name):
    file = make(tmp_path)
    before, _ = rows_of(file)
    after, reader = rows_of(file.rename(tmp_path / name))
    assert after == before and not reader.damaged
    (tmp_path / "t.zst").write_bytes(zstandard.compress((tmp_path / name).read_bytes()))
    assert rows_of(tmp_path / "t.zst")[0] == before


def test_what_is_compressed_otherwise_is_told_how_to_unpack(tmp_path):
    file = write_mcap(tmp_path, "none")
    (tmp_path / "t.mcap.gz").write_bytes(gzip.compress(file.read_bytes()))
    (tmp_path / "t.mcap.zstd").write_bytes(zstandard.compress(b"no recording"))
    with zipfile.ZipFile(tmp_path / "whole.zip", "w") as archive:
        archive.write(file, "t.csv")
    (tmp_path / "t.zip").write_bytes((tmp_path / "whole.zip").read_bytes()[:-30])
    for name, words in (("t.mcap.gz", "gzip -d"), ("t.mcap.zstd", "not an MCAP file"),
                        ("t.zip", "cut off")):
        result = through("info", tmp_path / name, None)
        assert result.exit_code == 1 and words in result.output
        assert f"{tmp_path / name}:" in result.output    # and not the unpacked copy


def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path):
    bag = write(tmp_path / "bag", 30)
    (bag / "metadata.yaml").unlink()
    before, _ = rows_of(bag)
    for name in ("metadata.yaml", "bag_1.mcap"):
        os.mkfifo(bag / name)
        assert rows_of(bag)[0] == before
    (tmp_path / "loop.mcap").symlink_to(tmp_path / "loop.mcap")
    for path in (bag / "bag_1.mcap", Path("/dev/null"), tmp_path / "loop.mcap"):
        for door in DOORS:
            assert through(door, path, tmp_path / "out").exit_code == 1
    assert not (tmp_path / "out").exists()


# Definitions that contradict each other.

@pytest.mark.parametrize("again", [
    (4, struct.pack("<HH", 1, 1) + text("/other", "cdr", "")), schema(MAG.msgtype)])
def test_a_number_that_is_used_again_is_no_sample_of_the_first(tmp_path, again):
    """In a chunk and outside of them, with a summary that knows the last one only, and without."""
    head, one, two = (schema(IMU.msgtype), channel("/imu")), message(imu(0)), message(
        imu(1), log_time=START + STEP)
    for file in (mcap(tmp_path / "a.mcap", *head, one, again, two),
                 mcap(tmp_path / "b.mcap", in_chunk(*head, one), in_chunk(again, two))):
        rows, reader = rows_of(file)
        assert [row[3] for row in rows if row[0] == "/imu"] == [imu(0)]
        assert reader.damaged and "is defined anew" in " ".join(reader.warnings)


def test_a_topic_whose_type_is_not_in_the_file_is_said_to_be_lost(tmp_path):
    file = mcap(tmp_path / "t.mcap", schema(IMU.msgtype), channel("/imu"), message(imu(0)),
                (4, struct.pack("<HH", 2, 99) + text("/mag", "cdr", "")), message(b"", 2))
    result = through("info", file, None)
    assert result.exit_code == INCOMPLETE
    assert "the type of topic /mag (schema 99) is not in the file; 1 messages" in result.output


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


# Databases.

def test_a_database_that_was_cut_off_is_read_up_to_the_cut(tmp_path):
    file = write_db3(tmp_path)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    before, _ = rows_of(file)
    data = file.read_bytes()
    file.write_bytes(data[:len(data) // 2])
    after, reader = rows_of(file)
    assert reader.damaged and set(after) < set(before) and len(after) > 0.3 * len(before)


def test_a_log_of_a_killed_recorder_is_used_and_nothing_is_written_beside(tmp_path):
    source = sqlite3.connect(write_db3(tmp_path))
    (tmp_path / "x").mkdir()
    database = sqlite3.connect(tmp_path / "x" / "x.db3", isolation_level=None)
    database.execute("pragma journal_mode = wal")
    database.execute("pragma wal_autocheckpoint = 0")
    for statement in source.iterdump():
        if statement.startswith(("BEGIN", "CREATE", "INSERT", "COMMIT")):
            database.execute(statement)
    for name in ("x.db3", "x.db3-wal"):
        (tmp_path / name).write_bytes((tmp_path / "x" / name).read_bytes())
    assert rows_of(tmp_path / "x.db3")[0] == rows_of(tmp_path / "bag")[0]
    for left in tmp_path.glob("x.db3-*"):
        left.unlink()
    result = through("info", tmp_path / "x.db3", None)
    assert result.exit_code == 1 and "x.db3-wal" in result.output
    assert not list(tmp_path.glob("x.db3-*"))
    database.close()


def test_what_a_database_only_claims_is_neither_waited_for_nor_passed_over(tmp_path):
    file = write_db3(tmp_path)
    with sqlite3.connect(file) as database:
        database.execute("update messages set topic_id = 77 where id % 3 = 0")
        database.execute("update messages set data = 'text' where id = 10")
    result = through("info", file, None)
    assert result.exit_code == INCOMPLETE
    assert "160 messages are of a topic (77)" in result.output and "no bytes" in result.output
    with sqlite3.connect(file) as database:
        database.execute("alter table messages rename to others")
        database.execute("create view messages as with recursive c(x) as (select 1 union all "
                         "select x + 1 from c) select x as id, 1 as topic_id, x as timestamp, "
                         "x'00' as data from c")
    result = through("info", file, None)
    assert result.exit_code == 1 and "no tables" in result.output


@pytest.mark.parametrize("plugin", list(StoragePlugin))
@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.FILE,
                                  CompressionMode.MESSAGE])
def test_every_compression_of_rosbag2(tmp_path, plugin, mode):
    writer = Ros2Writer(tmp_path / "bag", version=8, storage_plugin=plugin)
    if mode is not CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/imu", IMU.msgtype, typestore=TYPES)
        for i in range(50):
            writer.write(connection, START + i * STEP, imu(i))
    with open_bag(tmp_path / "bag") as reader:
        assert read_log(reader, "/imu").gyr[49, 0] == 49.0 and not reader.warnings


# Every mutation is answered: a few of each kind here, thousands by benchmarks/fuzz.py.

@pytest.mark.parametrize("kind", KINDS)
def test_mutations_are_read_or_refused(tmp_path, kind):
    make, read = KINDS[kind]
    file = make(tmp_path)
    data = file.read_bytes()
    rng = random.Random(f"quick {kind}")
    assert outcome(read, file) == "read"
    for _ in range(40):
        broken, done = mutated(data, rng, file.suffix)
        file.write_bytes(broken)
        assert outcome(read, file) in ("read", "refused"), done


@pytest.mark.skipif(not HOSTILE.exists(), reason="the collection is not there")
@pytest.mark.parametrize("file", sorted(
    p for folder in ("fuzz/*", "natural", "hand") for p in HOSTILE.glob(f"{folder}/*")
    if p.suffix != ".txt"), ids=lambda p: f"{p.parent.name}/{p.name}")
def test_every_collected_file_is_read_or_refused_in_a_line(tmp_path, file):
    for door in ("info", "convert"):
        result = through(door, file, tmp_path / door)
        if result.exit_code == 1:
            (line,) = [t for t in result.output.splitlines() if t.startswith("imu_fusion: ")]
            assert file.name in line or file.parent.name in line


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


def test_info_holds_samples_and_not_messages(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for i in range(30):
            writer.write("/blob", "std_msgs/msg/String", bytes(100), START + i * STEP)
    with open_bag(tmp_path / "bag") as reader:
        (report,) = inspect_topics(reader)
    assert report.count == 30 and not report.stamped
    assert np.array_equal(report.stamp, START + np.arange(30) * STEP)


def test_what_is_no_database_or_no_bag_is_refused_by_name(tmp_path):
    sqlite3.connect(tmp_path / "other.db3").execute("create table t (x)").connection.close()
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V1.2\n" + bytes(50))
    for name, words in (("other.db3", "no recording of rosbag2"), ("old.bag", "format 2.0")):
        with pytest.raises(BagError, match=words) as caught:
            open_bag(tmp_path / name)
        assert name in str(caught.value)
