"""Tables for other programs: what the recording holds, in the units that the header names."""

import csv

import numpy as np
import pytest
from click.testing import CliRunner

from imu_fusion import cli
from imu_fusion.errors import BagError
from imu_fusion.messages.convert import fix_message, imu_message, pose_message
from imu_fusion.messages.layouts import ACCEL, ODOMETRY, TWIST
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.export import export
from imu_fusion.recordings.logs import read_log

START = 1_700_000_000_123_456_789
HALF = np.sqrt(0.5)


@pytest.fixture
def bag(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for k in range(3):
            stamp = START + 500_000_000 * k
            writer.write("/imu/data", "sensor_msgs/msg/Imu", imu_message(
                stamp, "imu_link", (0.0, 0.0, 0.1), None if k == 2 else (0.0, 0.0, 9.81),
                (0.0, 0.0, HALF, HALF), np.diag([1e-4, 1e-4, 4e-4])), stamp)
            writer.write("/fix", "sensor_msgs/msg/NavSatFix", fix_message(
                stamp, "gnss", 47.5, 8.25, 400.5, None, -1 if k == 1 else 0), stamp)
            writer.write("/reference/pose", "geometry_msgs/msg/PoseStamped", pose_message(
                stamp, "world", (0.0, 0.0, 0.0, 1.0), (k, 2.0, 3.0)), stamp)
            writer.write("/smoother/odometry", ODOMETRY.msgtype, ODOMETRY.encode(
                stamp, "world", np.arange(ODOMETRY.size, dtype=float), "body"), stamp)
            writer.write("/acceleration_field/accel", ACCEL.msgtype, ACCEL.encode(
                stamp, "body", np.r_[1.0:7.0, np.diag(np.arange(6.0) ** 2).ravel()]), stamp)
            writer.write("/imu/gyro_bias", TWIST.msgtype, TWIST.encode(
                stamp, "imu_link", np.r_[0.0, 0.0, 0.0, 0.01, 0.02, 0.03,
                                         np.diag([0, 0, 0, 1e-6, 4e-6, 9e-6]).ravel()]), stamp)
            writer.write("/text", "std_msgs/msg/String", b"\0\1\0\0\2\0\0\0a\0", stamp)
    return tmp_path / "bag"


def table(path):
    with open(path) as stream:
        return list(csv.DictReader(stream))


def test_rows_are_the_messages_and_the_header_names_units(bag, tmp_path):
    counts = export(bag, tmp_path / "out")
    assert counts["imu_data.csv"] == 3 and "text.csv" not in counts
    rows = table(tmp_path / "out" / "imu_data.csv")
    assert [row["stamp [ns]"] for row in rows] == [str(START + 500_000_000 * k) for k in range(3)]
    assert rows[1]["time [s]"] == "0.500000000"
    assert float(rows[0]["yaw [deg]"]) == pytest.approx(90.0)
    assert float(rows[0]["sd_orientation_world_z [deg]"]) == pytest.approx(np.degrees(0.02))
    assert float(rows[0]["specific_force_z [m/s^2]"]) == 9.81
    assert rows[2]["specific_force_z [m/s^2]"] == ""    # absent
    fixes = table(tmp_path / "out" / "fix.csv")
    assert fixes[0]["height [m]"] == "400.5" and fixes[0]["sd_up [m]"] == ""    # unknown
    bias = table(tmp_path / "out" / "imu_gyro_bias.csv")
    assert [float(bias[0][name]) for name in ("gyro_bias_y [rad/s]", "sd_gyro_bias_z [rad/s]")] == (
        pytest.approx([0.02, 0.003]))
    odometry = table(tmp_path / "out" / "smoother_odometry.csv")
    assert float(odometry[0]["position_z [m]"]) == 2.0
    assert float(odometry[0]["sd_position_y [m]"]) == pytest.approx(np.sqrt(7.0 + 7.0))
    assert float(odometry[0]["velocity_body_x [m/s]"]) == 43.0
    (first, *_) = table(tmp_path / "out" / "acceleration_field_accel.csv")
    assert [float(first[f"{name}_z [{unit}]"]) for name, unit in (
        ("acceleration", "m/s^2"), ("sd_acceleration", "m/s^2"),
        ("angular_acceleration", "rad/s^2"), ("sd_angular_acceleration", "rad/s^2"))] == [
            3.0, 2.0, 6.0, 5.0]
    assert first["sd_acceleration_x [m/s^2]"] == ""    # zero: unknown


def test_trajectories_and_tracks_are_read_by_others(bag, tmp_path):
    export(bag, tmp_path / "out")
    lines = (tmp_path / "out" / "reference_pose.tum").read_text().splitlines()
    assert lines[2] == "1700000000.623456789 1 2 3 0 0 0 1"
    with open_bag(tmp_path / "out" / "fix.gpx") as reader:    # our own reader of GPX
        log = read_log(reader, "fix")
    assert len(log) == 2 and list(log.stamp - START) == [-789, 999_999_211]    # no fix: no point
    assert log.latitude_deg[0] == 47.5


def test_what_cannot_be_exported_leaves_nothing(bag, tmp_path):
    (tmp_path / "there").mkdir()
    for arguments, words in (((bag, tmp_path / "there"), "exists already"),
                             ((bag, tmp_path / "new", ["/text"]), "no topic that can be a table")):
        with pytest.raises(BagError, match=words):
            export(*arguments)
    result = CliRunner().invoke(cli.cli, ["export", str(bag), str(tmp_path / "new"), "--topic",
                                          "/nothing"])
    assert result.exit_code == 1 and "no topic '/nothing'" in result.output
    assert sorted(f.name for f in tmp_path.iterdir()) == ["bag", "there"]
