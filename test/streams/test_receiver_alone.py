"""A recording of a receiver alone, through the doors: process, report, AvaFrame's table."""

import csv

import numpy as np
import pytest
from click.testing import CliRunner

from imu_fusion.cli import cli
from imu_fusion.messages.convert import fix_message, imu_message, velocity_message
from imu_fusion.messages.layouts import ODOMETRY
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.logs import decoded_blocks
from imu_fusion.report.trajectory_data import read_result
from test.estimation.smoother.test_receiver_alone import descent, recorded


@pytest.fixture(scope="module")
def processed(tmp_path_factory):
    """A recording without an Imu, and what process makes of it."""
    folder = tmp_path_factory.mktemp("alone")
    write(folder / "bag", recorded(np.random.default_rng(8)))
    result = CliRunner().invoke(cli, ["process", str(folder / "bag"), str(folder / "out"),
                                      "--report"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return folder, result.output


def write(bag, logs, imu_topic=None):
    fix, velocity = logs
    with BagWriter(bag) as writer:
        for i, stamp in enumerate(fix.stamp.tolist()):
            for topic, msgtype, cdr in (
                    ("/fix", "sensor_msgs/msg/NavSatFix", fix_message(
                        stamp, "gnss", fix.latitude_deg[i], fix.longitude_deg[i], fix.height[i],
                        fix.cov_enu[i])),
                    ("/fix_velocity", "geometry_msgs/msg/TwistWithCovarianceStamped",
                     velocity_message(stamp, "gnss", velocity.vel_world[i],
                                      velocity.cov_world[i]))):
                writer.write(topic, msgtype, cdr, stamp)
            if imu_topic:
                writer.write(imu_topic, "sensor_msgs/msg/Imu",
                             imu_message(stamp, "imu_link", [0.0] * 3, [0.0, 0.0, 9.8]), stamp)


def test_the_attitude_is_said_to_be_unknown(processed):
    folder, output = processed
    assert "no Imu samples" in output
    with open_bag(folder / "out") as bag:
        assert bag.find("smoother/imu") is None
        (block, *rest) = decoded_blocks(bag, bag.require("smoother/odometry").name, ODOMETRY)
        assert not rest and set(block.frame_ids) == {"world"}
        result, remarks, why = read_result(bag)
    values, stamp = block.values, block.stamp
    assert (values[:, ODOMETRY["orientation"]] == [0.0, 0.0, 0.0, 1.0]).all()
    pose, twist = (values[:, ODOMETRY[name]].reshape(-1, 6, 6)
                   for name in ("pose_covariance", "twist_covariance"))
    assert pose[:, 3, 3].min() > np.pi ** 2
    # The twist is in the axes of the world, and as certain as the velocity.
    _, vel = descent((stamp - 10**18) * 1e-9)
    error = values[:, ODOMETRY["linear"]] - vel
    assert np.sqrt(np.mean(error ** 2)) < 0.3 and np.sqrt(np.median(twist[:, 0, 0])) < 0.5
    # A report of the recording reads what process had.
    assert not why and any("no Imu samples" in remark for remark in remarks)
    assert result.acc_density > 0.0
    assert np.allclose(result.samples["vel_world"], values[:, ODOMETRY["linear"]])
    assert np.allclose(result.samples["cov_velocity"], twist[:, :3, :3])
    report = (folder / "out" / "report.html").read_text()
    assert "Before and after" in report and "Attitude of the trajectory" not in report


def test_avaframe_reads_it(processed):
    folder, _ = processed
    done = CliRunner().invoke(cli, ["avaframe", str(folder / "out"), str(folder / "ball.csv")])
    assert done.exit_code == 0, done.output
    with open(folder / "ball.csv") as stream:
        rows = list(csv.DictReader(stream))
    fastest = max(float(row["velocityMag"]) for row in rows)
    assert fastest == pytest.approx(20.0 * np.sqrt(1.25), abs=0.5)


def test_an_imu_of_another_name_is_asked_for(tmp_path):
    fix, velocity = recorded(np.random.default_rng(8))
    write(tmp_path / "bag", (fix[:20], velocity[:20]), "/camera/imu")
    done = CliRunner().invoke(cli, ["process", str(tmp_path / "bag"), str(tmp_path / "out")])
    assert done.exit_code == 1 and "--remap imu/data_raw:=/camera/imu" in done.output
