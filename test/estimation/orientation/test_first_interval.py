"""``alignment.start``: what comes before the chosen interval says nothing of the attitude."""

import numpy as np
import pytest

from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.samples.logs import ImuLog, MagLog

RATE = 100
FIELD = np.array([0.0, 20e-6, -43e-6])     # x east, y north


@pytest.mark.parametrize("mode", ["causal", "smoothed"])
def test_the_attitude_is_that_of_the_chosen_interval(mode):
    """Carried with its x axis to the north and put down with x to the west, which no rate tells."""
    rng = np.random.default_rng(0)
    n, put_down = 6 * RATE, 3 * RATE
    stamp = 10**18 + np.arange(n) * (10**9 // RATE)
    yaw = np.where(np.arange(n) < put_down, 0.5 * np.pi, np.pi)
    mag = np.stack([np.cos(yaw) * FIELD[0] + np.sin(yaw) * FIELD[1],
                    np.cos(yaw) * FIELD[1] - np.sin(yaw) * FIELD[0], np.full(n, FIELD[2])], axis=1)
    gyr = rng.normal(0.0, 1e-3, (n, 3))
    acc = [0.0, 0.0, 9.81] + rng.normal(0.0, 0.02, (n, 3))
    acc[:put_down] += rng.normal(0.0, 3.0, (put_down, 3))
    estimator = OrientationEstimator(OrientationParams().replace(
        mode=mode, **{"alignment.start": 3.0, "alignment.duration": 0.5}))
    rows = estimator.run(ImuLog(stamp, gyr, acc),
                         MagLog(stamp, mag + rng.normal(0.0, 1e-7, (n, 3))))
    rows = np.concatenate([rows, estimator.finish()])
    assert rows["stamp"][0] >= stamp[put_down]
    x, y, z, w = rows["quat_world_imu"].T
    heading = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    off = np.abs(heading % (2.0 * np.pi) - np.pi)
    assert off.max() < np.radians(2.0)    # noise of .1 uT in 20; 90 deg with what came before
