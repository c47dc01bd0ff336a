"""Lags of whole seconds are found where forces and turns tell them, and nowhere else."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.smoother.gnss_lag import find_lags
from imu_fusion.estimation.smoother.result import SAMPLE
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.logs import FixLog, VelocityLog

RATE = 100
FRAME = LocalFrame(47.0, 11.0, 600.0)
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
    samples, velocity = tumbling(seed)
    assert find_lags(samples, FRAME, None, velocity) == (0.0, 0.0)


def test_a_lag_of_a_tumbling_body_is_still_found():
    for seed in (0, 1):
        samples, velocity = tumbling(seed, 1.5)
        assert find_lags(samples, FRAME, None, velocity) == pytest.approx([1.5] * 2, abs=0.1)


def winding(seed, fixes=0.0, velocities=0.0):
    """A minute on a winding road: samples as smoothed, fixes good to 2 cm and velocities at 5 Hz,
    late by so much."""
    rng = np.random.default_rng(seed)
    time = np.arange(60 * RATE) / RATE
    pull = np.column_stack([np.interp(time, 2.0 * np.arange(32), size * rng.standard_normal(32))
                            for size in (1.5, 1.5, 0.1)])
    vel = np.array([8.0, 3.0, 0.0]) + np.cumsum(pull, axis=0) / RATE
    place = np.cumsum(vel, axis=0) / RATE
    samples = np.zeros(len(time), SAMPLE)
    samples["stamp"] = 10**18 + np.round(time * 1e9).astype(np.int64)
    samples["quat_world_imu"][:, 3] = 1.0
    samples["acc"] = pull + [0.0, 0.0, 9.81]
    rows = np.arange(0, len(time), 20)
    zero, stamp = np.zeros((len(rows), 3, 3)), samples["stamp"][rows]
    fix = FixLog(stamp + round(fixes * 1e9), *FRAME.to_geodetic(
        place[rows] + 0.02 * rng.standard_normal((len(rows), 3))), zero, np.zeros(len(rows)))
    velocity = VelocityLog(stamp + round(velocities * 1e9),
                           vel[rows] + 0.05 * rng.standard_normal((len(rows), 3)), zero)
    return samples, FRAME, fix, velocity


@pytest.mark.parametrize("late", [(0.0, 0.0), (1.2, 1.2), (-2.0, 0.0), (0.0, 2.0), (3.0, 1.0)])
def test_fixes_and_velocities_have_clocks_of_their_own(late):
    for seed in range(3):
        assert find_lags(*winding(seed, *late)) == pytest.approx(late, abs=0.11)


def test_fixes_alone_tell_a_lag():
    for late in (0.0, 18.0):
        samples, frame, fix, _ = winding(3, late)
        assert find_lags(samples, frame, fix, None) == pytest.approx([late] * 2, abs=0.11)
