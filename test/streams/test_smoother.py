"""What a smoothed trajectory becomes as messages: covariances and results."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion import batch
from imu_fusion.errors import MessageError
from imu_fusion.evaluation.consistency import nees
from imu_fusion.messages.layouts import ODOMETRY
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.streams.smoother import ODOMETRY_TOPIC, RESULTS_TOPIC, results_value

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
    assert abs(jump["length"] - 98.74) < 4 * jump["length_sd"] < 0.5
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
