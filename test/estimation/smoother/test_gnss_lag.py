"""Lags of whole seconds are found where forces and turns tell them, and nowhere else."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.smoother.gnss_lag import find_lag
from imu_fusion.estimation.smoother.result import SAMPLE
from imu_fusion.samples.logs import VelocityLog

RATE = 100
OUTAGES = ((2.5, 5.0), (7.0, 10.5))


def tumbling(seed, lag=0.0):
    """Thirteen seconds down a slope, tumbling at 5 rad/s: samples as smoothed, velocities at 10 Hz
    with outages, late by ``lag``."""
    rng = np.random.default_rng(seed)
    time = np.arange(13 * RATE) / RATE
    pull = np.column_stack([np.interp(time, 0.5 * np.arange(28), size * rng.standard_normal(28))
                            for size in (3.0, 3.0, 2.0)])
    samples = np.zeros(len(time), SAMPLE)
    samples["stamp"] = 10**18 + np.round(time * 1e9).astype(np.int64)
    samples["gyr"] = 3.0 * np.column_stack([np.sin(f * time + seed) for f in (1.1, 0.7, 1.6)])
    turn, quat = Rotation.identity(), []
    for step in Rotation.from_rotvec(samples["gyr"] / RATE):
        quat.append(turn.as_quat())
        turn = turn * step
    samples["quat_world_imu"] = quat
    samples["acc"] = Rotation.from_quat(quat).inv().apply(pull + [0.0, 0.0, 9.81])
    vel = np.array([8.0, 8.0, -7.0]) + np.cumsum(pull, axis=0) / RATE
    rows = np.arange(0, len(time), 10)
    rows = rows[[not any(a <= t < b for a, b in OUTAGES) for t in time[rows]]]
    vel = vel[rows] + 0.05 * rng.standard_normal((len(rows), 3))
    return samples, VelocityLog(samples["stamp"][rows] + round(lag * 1e9), vel,
                                np.zeros((len(rows), 3, 3)))


@pytest.mark.parametrize("seed", range(12))
def test_outages_and_tumbling_are_no_lag(seed):
    assert find_lag(*tumbling(seed)) == 0.0


def test_a_lag_of_a_tumbling_body_is_still_found():
    assert [find_lag(*tumbling(seed, 1.5)) for seed in (0, 1)] == pytest.approx([1.5] * 2, abs=0.1)
