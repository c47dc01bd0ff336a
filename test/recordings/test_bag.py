"""Recordings: round trips, foreign readers, damage and refusals."""

import os
import sqlite3
import subprocess
import sys
import textwrap

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from imu_fusion.errors import BagError, TopicError
from imu_fusion.messages.convert import imu_message, mag_message
from imu_fusion.messages.layouts import IMU, MAG
from imu_fusion.messages.typestore import TYPES
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.logs import read_log
from imu_fusion.recordings.qos import qos_profile
from imu_fusion.recordings.repair import repair

START = 1_700_000_000_000_000_000
STEP = 5_000_000


def imu(i):
    return imu_message(START + i * STEP, "imu_link", [i, 0.0, 0.5], [0.0, 0.0, 9.81])


def write(directory, count=3000, **options):
    with BagWriter(directory, **options) as writer:
        for i in range(count):
            writer.write("/imu/data_raw", IMU.msgtype, imu(i), START + i * STEP + 1000,
                         START + i * STEP)
            if i % 3 == 0:
                writer.write("/imu/mag", MAG.msgtype,
                             mag_message(START + i * STEP, "imu_link", [2e-5, 0.0, -4e-5]),
                             START + i * STEP + 1500)
    return directory


def test_what_is_written_comes_back_in_order_of_log_time(tmp_path):
    bag = write(tmp_path / "bag", 300)
    with open_bag(bag) as reader:
        assert {t.name: (t.msgtype, t.count) for t in reader.topics.values()} == {
            "/imu/data_raw": (IMU.msgtype, 300), "/imu/mag": (MAG.msgtype, 100)}
        times = [log_time for _, _, log_time, _ in reader.messages()]
        assert times == sorted(times) and len(times) == 400
        assert (reader.start_time, reader.end_time) == (times[0], times[-1] + 1)
        assert not reader.warnings
        log = read_log(reader, "imu/data_raw")
        assert np.array_equal(log.gyr[:, 0], np.arange(300.0))
        assert log.stamp[7] == START + 7 * STEP
        part = list(reader.messages(["/imu/data_raw"], START + 10 * STEP, START + 20 * STEP))
        assert len(part) == 10


def test_other_readers_accept_it(tmp_path):
    bag = write(tmp_path / "bag", 300, compression="lz4")
    with AnyReader([bag]) as reader:  # checks metadata, definitions and RIHS01 hashes
        assert reader.message_count == 400
        connection, log_time, data = next(reader.messages())
        assert reader.deserialize(data, connection.msgtype).linear_acceleration.z == 9.81
    with open(bag / "bag_0.mcap", "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        rows = [(c.topic, m.log_time - m.publish_time, m.sequence)
                for _, c, m in reader.iter_messages(topics=["/imu/data_raw"])]
        assert rows[5] == ("/imu/data_raw", 1000, 5)


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_reads_recordings_of_other_writers(tmp_path, plugin):
    with Writer2(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/imu", IMU.msgtype, typestore=TYPES)
        for i in range(50):
            writer.write(connection, START + i * STEP, imu(i))
    with open_bag(tmp_path / "bag") as reader:
        assert read_log(reader, "/imu").gyr[49, 0] == 49.0
    (file,) = [p for p in (tmp_path / "bag").iterdir() if p.suffix in (".mcap", ".db3")]
    with open_bag(file) as reader:
        assert len(read_log(reader, "/imu")) == 50


def test_reads_ros1_recordings(tmp_path):
    noetic = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(tmp_path / "old.bag") as writer:
        connection = writer.add_connection("/imu", IMU.msgtype, typestore=noetic)
        for i in range(20):
            message = TYPES.deserialize_cdr(imu(i), IMU.msgtype)
            header = noetic.types["std_msgs/msg/Header"](
                seq=i, stamp=message.header.stamp, frame_id="imu_link")
            message.header = header
            writer.write(connection, START + i * STEP, noetic.serialize_ros1(message, IMU.msgtype))
    with open_bag(tmp_path / "old.bag") as reader:
        log = read_log(reader, "imu")
    assert np.array_equal(log.gyr[:, 0], np.arange(20.0)) and log.stamp[3] == START + 3 * STEP


def test_truncated_file_gives_all_complete_chunks_and_can_be_repaired(tmp_path):
    bag = write(tmp_path / "bag", 3000, chunk_size=65536)
    file = bag / "bag_0.mcap"
    whole = file.read_bytes()
    with open_bag(bag) as reader:
        expected = [cdr for *_, cdr in reader.messages(["/imu/data_raw"])]
    for part in (0.3, 0.7, 0.95):
        file.write_bytes(whole[:int(part * len(whole))])
        with open_bag(bag) as reader:
            assert "recovered" in reader.warnings[0]
            found = [cdr for *_, cdr in reader.messages(["/imu/data_raw"])]
            assert found == expected[:len(found)]
            # zstd-compressed equal chunks: at most one chunk of 65536 / 364 messages is open
            assert len(found) > part * 0.9 * len(expected) - 400
    (bag / "metadata.yaml").unlink()
    counts = repair(bag, tmp_path / "clean")
    with open_bag(tmp_path / "clean") as reader:
        assert not reader.warnings
        assert {t.name: t.count for t in reader.topics.values()} == counts
        assert reader.topics["/imu/data_raw"].count == len(found)


def test_damage_inside_a_chunk_is_reported_not_returned(tmp_path):
    bag = write(tmp_path / "bag", 2000, chunk_size=65536, compression="none")
    file = bag / "bag_0.mcap"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 0xFF
    file.write_bytes(data)
    (bag / "metadata.yaml").unlink()
    with open_bag(bag) as reader:
        log = read_log(reader, "/imu/data_raw")
        assert reader.damaged and "missing" in " ".join(reader.warnings)
    # One chunk is lost, at most: 65536 bytes of 386 each. What is there is what was written.
    assert 2000 - 171 <= len(log) < 2000 and (np.diff(log.gyr[:, 0]) >= 1).all()
    assert np.array_equal(log.stamp, START + log.gyr[:, 0].astype(np.int64) * STEP)


def test_kill_loses_at_most_the_open_chunk(tmp_path):
    script = textwrap.dedent(f"""
        import os, signal, sys
        sys.path.insert(0, {os.getcwd()!r})
        from test.recordings.test_bag import IMU, START, STEP, BagWriter, imu
        writer = BagWriter({str(tmp_path / 'bag')!r}, chunk_size=65536)
        for i in range(5000):
            writer.write("/imu/data_raw", IMU.msgtype, imu(i), START + i * STEP)
        os.kill(os.getpid(), signal.SIGKILL)
    """)
    subprocess.run([sys.executable, "-c", script], check=False, timeout=120)
    assert not (tmp_path / "bag" / "metadata.yaml").exists()
    with open_bag(tmp_path / "bag") as reader:
        # 364 bytes a message and 22 of record header: 170 messages fill a chunk
        assert 5000 - 171 <= reader.count < 5000


def test_full_disk_is_a_clear_error_and_what_was_written_stays(tmp_path):
    """A file size limit stands for the full disk: the same failing write()."""
    script = textwrap.dedent(f"""
        import resource, sys
        sys.path.insert(0, {os.getcwd()!r})
        from test.recordings.test_bag import IMU, START, STEP, BagWriter, imu, BagError
        writer = BagWriter({str(tmp_path / 'bag')!r}, chunk_size=65536, compression="none")
        resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, resource.RLIM_INFINITY))
        try:
            for i in range(5000):
                writer.write("/imu/data_raw", IMU.msgtype, imu(i), START + i * STEP)
        except BagError as error:
            print(error)
            writer.abandon()
    """)
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True,
                            timeout=120, check=False)
    assert "writing failed" in result.stdout and "stays readable" in result.stdout, result.stderr
    with open_bag(tmp_path / "bag") as reader:
        assert reader.count >= 5 * 169  # 400 kB hold six chunks of 65 kB, the last one cut


@pytest.mark.parametrize("make, words", [
    (lambda p: None, "no such file"),
    (lambda p: p.mkdir(), "without .mcap or .db3"),
    (lambda p: p.write_text("hello"), "not a recording"),
])
def test_what_is_no_recording_is_refused_by_name(tmp_path, make, words):
    path = tmp_path / "thing"
    make(path)
    with pytest.raises(BagError, match=words) as caught:
        open_bag(path)
    assert str(path) in str(caught.value)


def test_empty_and_garbage_files_are_refused(tmp_path):
    (tmp_path / "zero.mcap").touch()
    with pytest.raises(BagError, match="empty"):
        open_bag(tmp_path / "zero.mcap")
    for name in ("noise.mcap", "noise.db3", "noise.bag"):
        (tmp_path / name).write_bytes(np.random.default_rng(0).bytes(5000))
        with pytest.raises(BagError, match=name):
            open_bag(tmp_path / name)
    sqlite3.connect(tmp_path / "other.db3").execute("create table t (x)").connection.close()
    with pytest.raises(BagError):
        open_bag(tmp_path / "other.db3")


def test_a_recording_without_messages_opens_with_no_messages(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/imu/data_raw", IMU.msgtype, [qos_profile(5, "best_effort")])
    with open_bag(tmp_path / "bag") as reader:
        assert reader.count == 0 and list(reader.messages()) == []
        assert reader.topics["/imu/data_raw"].qos_profiles[0]["reliability"] == "best_effort"


def test_missing_topics_are_named_with_what_there_is(tmp_path):
    with open_bag(write(tmp_path / "bag", 3)) as reader:
        with pytest.raises(TopicError, match=r"no topic 'imu'.*/imu/mag"):
            reader.require("imu")
        with pytest.raises(TopicError, match="expected"):
            reader.require("/imu/mag", IMU.msgtype)


def test_writer_refuses_what_is_in_its_way(tmp_path):
    write(tmp_path / "bag", 3)
    with pytest.raises(BagError, match="not empty"):
        BagWriter(tmp_path / "bag")
    write(tmp_path / "bag", 5, overwrite=True)
    (tmp_path / "bag" / "thesis.txt").write_text("precious")
    with pytest.raises(BagError, match="other files"):
        BagWriter(tmp_path / "bag", overwrite=True)
    assert (tmp_path / "bag" / "thesis.txt").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["bag"]
    with pytest.raises(BagError, match="cannot be written"):
        BagWriter("/proc/imu_fusion/bag")
    with BagWriter(tmp_path / "other") as writer:
        writer.write("/a", IMU.msgtype, imu(0), START)
        with pytest.raises(BagError, match="not sensor_msgs/msg/MagneticField"):
            writer.write("/a", MAG.msgtype, imu(0), START)
        with pytest.raises(BagError, match="definition"):
            writer.write("/b", "nobody_msgs/msg/Thing", b"", START)
        with pytest.raises(BagError, match="absolute.*'/c'"):
            writer.write("c", IMU.msgtype, imu(0), START)


def test_the_file_itself_carries_rosbag2_s_metadata(tmp_path):
    """As rosbag2_storage_mcap writes it: what metadata.yaml says, below its first key."""
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/imu", IMU.msgtype, imu(0), START)
    said = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    with open(tmp_path / "bag" / "bag_0.mcap", "rb") as stream:
        (entry,) = make_reader(stream).iter_metadata()
    assert entry.name == "rosbag2"
    inside = yaml.safe_load(entry.metadata["serialized_metadata"])
    assert inside == said["rosbag2_bagfile_information"] and inside["message_count"] == 1
    qos = inside["topics_with_message_count"][0]["topic_metadata"]["offered_qos_profiles"][0]
    assert qos["lifespan"] == {"sec": 2**63 // 10**9, "nsec": (2**63 - 1) % 10**9}
