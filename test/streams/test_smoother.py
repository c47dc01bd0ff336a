"""What a smoothed trajectory becomes as messages: covariances and results."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from imu_fusion import batch
from imu_fusion.errors import MessageError, ParameterError
from imu_fusion.evaluation.consistency import nees
from imu_fusion.messages.layouts import ODOMETRY
from imu_fusion.messages.typestore import TYPES
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.streams.smoother_messages import ODOMETRY_TOPIC, RESULTS_TOPIC, results_value
from imu_fusion.streams.smoother_params import Frames, SmoothingParams

ROOT = Path(__file__).parent.parent.parent


@pytest.fixture(scope="module")
def processed(tmp_path_factory):
    out = tmp_path_factory.mktemp("jump") / "out"
    batch.process(ROOT / "bags" / "jump_simulated", out, ROOT / "config" / "jump_simulated.yaml",
                  without=["orientation_estimator"])
    return out


def test_results_of_a_jump_are_in_the_recording_and_beside_it(processed):
    found = json.loads((processed / "results.json").read_text())["smoother"]
    with open_bag(processed) as reader:
        ((_, msgtype, _, cdr),) = reader.messages([f"/{RESULTS_TOPIC}"])
    assert msgtype == "diagnostic_msgs/msg/DiagnosticArray" and results_value(cdr) == found
    jump = found["jump"]
    assert found["converged"] and found["remarks"] == []
    # Where positions are, and where the antenna is beside it.
    assert found["point"] == "imu_link" and found["antenna"] == [0.0, 0.0, 0.0]
    # That of the profile, .1 m, is in it.
    assert abs(jump["length"] - 98.74) < 4 * jump["length_sd"] < 0.6 and jump["length_sd"] > 0.1
    for name in ("in_run_speed", "takeoff_speed", "takeoff_angle", "flight_time", "landing_speed"):
        value = jump.get(name, jump.get(f"{name}_deg"))
        assert 0 < jump.get(f"{name}_sd", jump.get(f"{name}_sd_deg")) < 0.01 * abs(value)
    with pytest.raises(MessageError, match="cannot be read"):
        results_value(b"nonsense")


def test_odometry_errs_as_its_covariances_say(processed):
    """The twist is in the sensor's axes: an attitude that is off by 0.3 deg turns 30 m/s by
    0.15 m/s, ten times the error of the velocity itself."""
    with open_bag(processed) as reader:
        rows = [ODOMETRY.decode(cdr) for _, _, _, cdr in reader.messages([f"/{ODOMETRY_TOPIC}"])]
    with open_bag(ROOT / "bags" / "jump_simulated") as reader:
        truth = read_log(reader, "reference/pose")
        gyr = read_log(reader, "imu/data_raw").gyr
    stamp = np.array([row[0] for row in rows])
    assert np.array_equal(stamp, truth.stamp)
    values = np.array([row[2] for row in rows])
    true = Rotation.from_quat(truth.quat_world_imu)
    seconds = (stamp - stamp[0]) * 1e-9
    vel_world = np.gradient(truth.position_world, seconds, axis=0)
    error = values[:, ODOMETRY["linear"]] - true.inv().apply(vel_world)
    cov = values[:, ODOMETRY["twist_covariance"]].reshape(-1, 6, 6)
    # The difference quotient of the truth is wrong at the impact. One run: its errors go together.
    assert 0.3 < np.median(nees(error, cov[:, :3, :3])) < 9.0
    fast = np.linalg.norm(vel_world, axis=1) > 25.0
    assert np.sqrt(cov[fast, 0, 0] + cov[fast, 1, 1] + cov[fast, 2, 2]).mean() > 0.05
    # Rates: the noise of a sample stays in them (0.0175 rad/s).
    assert np.allclose(np.sqrt(cov[:, 3, 3]), 0.0175, rtol=0.05)
    assert abs(np.std(np.diff(gyr[:400] - values[:400, ODOMETRY["angular"]], axis=0))) < 1e-6


@pytest.fixture(scope="module")
def named(tmp_path_factory):
    """The jump with the names that REP 105 gives frames, and with /tf."""
    folder = tmp_path_factory.mktemp("named")
    given = yaml.safe_load((ROOT / "config" / "jump_simulated.yaml").read_text())
    given["smoother"]["ros__parameters"] |= {
        "frame.world": "map", "frame.body": "base_link", "publish_tf": True, "path_rate": 5.0,
        "surface.file": "oberstdorf_hs106"}
    (folder / "p.yaml").write_text(yaml.safe_dump({"smoother": given["smoother"]}))
    batch.process(ROOT / "bags" / "jump_simulated", folder / "out", folder / "p.yaml",
                  without=["orientation_estimator"])
    with open_bag(folder / "out") as reader:
        return {topic: [(log_time, TYPES.deserialize_cdr(cdr, info.msgtype))
                        for *_, log_time, cdr in reader.messages([topic])]
                for topic, info in reader.topics.items()}


def test_frames_are_called_as_the_parameters_say(named):
    for topic, world, child in (("/smoother/odometry", "map", "base_link"),
                                ("/smoother/pose", "map", None), ("/smoother/path", "map", None),
                                ("/smoother/results", "map", None), ("/smoother/fix", "base_link",
                                                                     None),
                                ("/smoother/imu", "base_link", None)):
        for _, message in named[topic]:
            assert message.header.frame_id == world
            assert child is None or message.child_frame_id == child
    assert {p.header.frame_id for p in named["/smoother/path"][0][1].poses} == {"map"}


def test_transforms_poses_and_path_are_the_odometry(named):
    def numbers(pose, at="position", turn="orientation"):
        return [getattr(getattr(pose, part), axis) for part, axes in ((at, "xyz"), (turn, "xyzw"))
                for axis in axes]

    poses = {stamp: numbers(m.pose.pose) for stamp, m in named["/smoother/odometry"]}
    covs = {stamp: m.pose.covariance.tolist() for stamp, m in named["/smoother/odometry"]}
    transforms = {}
    for stamp, message in named["/tf"]:
        (one,) = message.transforms
        assert (one.header.frame_id, one.child_frame_id) == ("map", "base_link")
        assert one.header.stamp.sec * 10 ** 9 + one.header.stamp.nanosec == stamp
        transforms[stamp] = numbers(one.transform, "translation", "rotation")
    assert transforms == poses
    shown = [(stamp, numbers(m.pose.pose), m.pose.covariance.tolist())
             for stamp, m in named["/smoother/pose"]]
    assert shown == [(stamp, poses[stamp], covs[stamp]) for stamp, _, _ in shown]
    assert np.allclose(np.diff([stamp for stamp, _, _ in shown]), 2e8)
    assert [numbers(p.pose) for p in named["/smoother/path"][0][1].poses] == [
        pose for _, pose, _ in shown]


@pytest.mark.parametrize("frame, words", [
    ({"world": "/map"}, "frame.world.*'/map'.*leading slash"), ({"world": ""}, "frame.world"),
    ({"world": "base_link", "body": "base_link"}, "two names")])
def test_names_that_tf2_would_refuse_are_refused(frame, words):
    with pytest.raises(ParameterError, match=words):
        SmoothingParams(frame=Frames(**frame))
