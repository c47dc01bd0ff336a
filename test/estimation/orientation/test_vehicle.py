"""Tilt on vehicles, which keep their accelerations longer than a hand."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.orientation.estimator import OrientationParams
from imu_fusion.parameters.file import load
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate
from test.estimation.orientation.errors import tilt_errors_deg
from test.estimation.orientation.test_estimator import make

CONFIG = Path(__file__).parents[3] / "config"
VEHICLE = load(CONFIG / "orientation_vehicle.yaml")["orientation_estimator"]
PHONE_GRADE = {"sensor": VEHICLE["sensor"]}


def on_a_vehicle(seed):
    """Speeds of some 10 m/s that last for some 10 s, sensors drawn from the preset."""
    p = OrientationParams.from_mapping(VEHICLE).sensor
    rng = np.random.default_rng(seed)
    sensors = Sensors(
        gyr_density=p.gyro_noise_density, acc_density=p.acc_noise_density,
        gyr_bias=tuple(rng.normal(0, p.gyro_bias_sd, 3)), gyr_walk=p.gyro_bias_walk,
        gyr_matrix=np.eye(3) + rng.normal(0, p.gyro_scale_sd, (3, 3)),
        acc_bias=tuple(rng.normal(0, p.acc_bias_sd, 3)))
    motion = Tumbling(seed=seed, rate_sd=0.1, frequencies=(0.01, 0.05), travel_sd=60.0, rest=5.0)
    imu, _, truth, _ = simulate(motion, 200.0, rate=50.0, sensors=sensors, seed=seed)
    return imu, truth


@pytest.mark.parametrize("told, mode", [
    (VEHICLE, "causal"), (PHONE_GRADE, "causal"), (PHONE_GRADE, "smoothed")])
def test_tilt_on_a_vehicle_is_as_good_as_stated(told, mode):
    """Told of the motion, or finding out. Errors last for tens of seconds: one vehicle's mean
    scatters by 0.6, that of ten by 0.2; bounds are three of these."""
    ratios = []
    for seed in range(10):
        imu, truth = on_a_vehicle(seed)
        rows = make({"mode": mode, **told}).run(imu)
        world = Rotation.from_quat(rows["quat_world_imu"]).as_matrix()
        cov = world @ rows["cov_attitude"] @ world.transpose(0, 2, 1)
        variance = np.degrees(1) ** 2 * (cov[:, 0, 0] + cov[:, 1, 1])
        ratios.append((tilt_errors_deg(rows, truth) ** 2 / variance).mean())
    assert 0.4 < np.mean(ratios) < 1.6
