"""Kinds of recordings: what a file is, how it is packed, and which types and encodings it has."""

import gzip
import os
import sqlite3
import struct
import zipfile
from pathlib import Path

import pytest
import zstandard
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from benchmarks.fuzz import write_db3, write_mcap, write_ros1
from imu_fusion.errors import INCOMPLETE, BagError
from imu_fusion.messages.convert import imu_message, mag_message
from imu_fusion.messages.layouts import IMU, MAG
from imu_fusion.messages.typestore import TYPES
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.logs import read_log
from test.recordings.doors import DOORS, rows_of, run, through
from test.recordings.raw_mcap import channel, mcap, message, schema, text
from test.recordings.test_bag import START, STEP, imu, write


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


def test_what_is_no_database_or_no_bag_is_refused_by_name(tmp_path):
    sqlite3.connect(tmp_path / "other.db3").execute("create table t (x)").connection.close()
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V1.2\n" + bytes(50))
    for name, words in (("other.db3", "no recording of rosbag2"), ("old.bag", "format 2.0")):
        with pytest.raises(BagError, match=words) as caught:
            open_bag(tmp_path / name)
        assert name in str(caught.value)


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


def test_a_topic_whose_type_is_not_in_the_file_is_said_to_be_lost(tmp_path):
    file = mcap(tmp_path / "t.mcap", schema(IMU.msgtype), channel("/imu"), message(imu(0)),
                (4, struct.pack("<HH", 2, 99) + text("/mag", "cdr", "")), message(b"", 2))
    result = through("info", file, None)
    assert result.exit_code == INCOMPLETE
    assert "the type of topic /mag (schema 99) is not in the file; 1 messages" in result.output


def test_other_encodings_are_named_and_not_called_damage(tmp_path):
    protobuf = [schema("foxglove.Log", "", 1, "protobuf"), channel("/log", 1, "protobuf"),
                message(b"\x08\x01")]
    only = through("info", mcap(tmp_path / "p.mcap", *protobuf), None)
    assert only.exit_code == 1 and "no topics of ROS 2" in only.output
    assert "/log (protobuf)" in only.output and "damaged" not in only.output
    beside = through("info", mcap(tmp_path / "q.mcap", *protobuf, schema(IMU.msgtype, "", 2),
                                  channel("/imu", 2), message(imu(0), 2)), None)
    assert beside.exit_code == 0 and "left out: /log (protobuf)" in beside.output


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
