"""Inspection of whole recordings: what is in them and what looks wrong is told per topic."""

from pathlib import Path

import numpy as np
import pytest

from imu_fusion.messages.convert import imu_message, mag_message
from imu_fusion.messages.layouts import VECTOR3
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.inspect import inspect_topics

BAGS = Path(__file__).resolve().parents[2] / "bags"
START = 1_700_000_000_000_000_000


def inspect(path):
    with open_bag(path) as reader:
        return {row.topic: row for row in inspect_topics(reader)}


def test_a_real_flight_is_described():
    rows = inspect(BAGS / "px4_plane")
    imu, mag = rows["/imu/data_raw"], rows["/imu/mag"]
    assert imu.count == 13656
    assert imu.rate == pytest.approx(136.5, abs=0.1)
    assert any("214 gaps" in note for note in imu.notes)
    (field,) = mag.ranges
    assert field.unit == "µT" and 20 < field.low < field.high < 100
    assert {f.kind for row in rows.values() for f in row.findings} == {"gap"}


def test_units_and_topics_without_a_log_are_told(tmp_path):
    rng = np.random.default_rng(0)
    with BagWriter(tmp_path / "bag") as writer:
        for i in range(300):
            stamp = START + i * 10_000_000
            acc = [0.0, 0.0, 1.0] + rng.normal(0, 0.01, 3)
            writer.write("/imu", "sensor_msgs/msg/Imu",
                         imu_message(stamp, "imu", rng.normal(0, 0.01, 3), acc), stamp)
            writer.write("/mag", "sensor_msgs/msg/MagneticField",
                         mag_message(stamp, "imu", [0.2, 0.0, -0.4] + rng.normal(0, 0.01, 3)),
                         stamp)
        for i in range(10):
            # Stamped 0.1 s apart, all received at once: header stamps count.
            stamp = START + i * 100_000_000
            writer.write("/wind", "geometry_msgs/msg/Vector3Stamped",
                         VECTOR3.encode(stamp, "world", [1, 2, 3]), START)
        writer.write("/flag", "std_msgs/msg/Bool", b"\x00\x01\x00\x00\x01", START)
        writer.add_topic("/never", "sensor_msgs/msg/Imu")
    rows = inspect(tmp_path / "bag")
    assert any("gravity in g," in note for note in rows["/imu"].notes)
    assert any("in gauss," in note for note in rows["/mag"].notes)
    assert rows["/wind"].rate == pytest.approx(10)
    assert rows["/flag"].rate is None and rows["/flag"].count == 1
    assert rows["/never"].count == 0 and rows["/never"].longest_gap is None


def test_bytes_that_are_not_the_message_are_told(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/imu", "sensor_msgs/msg/Imu", b"\x00\x01\x00\x00\x01\x02", START)
    (finding,) = inspect(tmp_path / "bag")["/imu"].findings
    assert finding.kind == "type" and finding.text.startswith("/imu")


def test_a_long_recording_is_looked_at_in_stretches(tmp_path):
    """Of a real flight what is counted is the same; what is found says where."""
    whole = inspect(BAGS / "px4_plane")
    with open_bag(BAGS / "px4_plane") as reader:
        for row in inspect_topics(reader, 4000):
            other = whole[row.topic]
            assert (row.count, row.longest_gap) == (other.count, other.longest_gap)
            assert row.rate == (other.rate and pytest.approx(other.rate))
            assert (row.timing.repeated, row.timing.backwards) == (
                other.timing.repeated, other.timing.backwards)
            assert row.ranges == other.ranges
    with BagWriter(tmp_path / "bag") as writer:
        for i in range(300):
            stamp = START + i * 10_000_000
            writer.write("/imu", "sensor_msgs/msg/Imu", imu_message(
                stamp, "imu", [np.nan if i == 250 else 0.01 * i, 0, 0], [0, 0, 9.81]), stamp)
    with open_bag(tmp_path / "bag") as reader:
        (row,) = inspect_topics(reader, 100)
    (text,) = (f.text for f in row.findings if f.kind == "nan")
    assert text.endswith("(in 1 of 3 stretches of the recording, the first of them from stamp "
                         f"{START + 200 * 10_000_000} on)")


def test_info_holds_samples_and_not_messages(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for i in range(30):
            writer.write("/blob", "std_msgs/msg/String", bytes(100), START + i * 5_000_000)
    with open_bag(tmp_path / "bag") as reader:
        (report,) = inspect_topics(reader)
    assert report.count == 30 and not report.stamped
    assert np.array_equal(report.stamp, START + np.arange(30) * 5_000_000)
