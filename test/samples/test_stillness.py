"""Rests told from steady rides."""

import numpy as np
import pytest
import scipy

from imu_fusion.samples.logs import ImuLog
from imu_fusion.samples.stillness import find_still

NOISE = 4e-4, 6e-3      # densities: what is stated, twice what the sensor has


def recorded(rate, time, shaking=None, gain=1.0):
    """A sensor of half the stated noise; ``shaking`` (t,) -> m/s^2."""
    rng = np.random.default_rng(1)
    t = np.arange(int(time * rate)) / rate
    gyr, acc = (gain * 0.5 * density * np.sqrt(rate) * rng.standard_normal((len(t), 3))
                for density in NOISE)
    acc[:, 2] += 9.8
    if shaking is not None:
        acc += shaking(t)[:, None]
    return ImuLog(np.round(1e9 * t).astype(np.int64), gyr + [0.01, -0.02, 0.0], acc)


@pytest.mark.parametrize("rate", [10.0, 30.0, 100.0, 150.0, 1000.0])
def test_a_sensor_that_lies_rests(rate):
    (rest,) = find_still(recorded(rate, 12.0), NOISE)
    assert rest.start == 0 and rest.stop > 11.0 * rate and rest.unrest < 1.6


def test_a_filter_of_the_sensor_is_no_ride():
    imu = recorded(400.0, 10.0, gain=2.0)
    b, a = scipy.signal.butter(2, 42.0 / 200.0)
    level = imu.acc.mean(axis=0)
    filtered = ImuLog(imu.stamp, scipy.signal.lfilter(b, a, imu.gyr - imu.gyr[0], axis=0),
                      level + scipy.signal.lfilter(b, a, imu.acc - level, axis=0))
    assert find_still(filtered, NOISE)


@pytest.mark.parametrize("shaking", [
    lambda t: 0.06 * np.sin(2.0 * np.pi * 1.5 * t),      # a car on its springs
    lambda t: 0.03 * np.sin(2.0 * np.pi * 0.7 * t),      # a hand, a cabin on its rope
    lambda t: 0.04 * (np.sin(2.0 * np.pi * 3.0 * t) + np.sin(2.0 * np.pi * 6.1 * t)),   # a lift
    lambda t: 0.8 * np.sin(2.0 * np.pi * 23.0 * t),      # an engine
    lambda t: -9.8 + 0.0 * t,                            # a fall
], ids=["car", "hand", "lift", "engine", "fall"])
def test_what_rides_does_not_rest(shaking):
    assert not find_still(recorded(100.0, 20.0, shaking), NOISE)


def test_a_louder_rest_is_a_ride():
    quiet, loud = recorded(100.0, 10.0, gain=0.4), recorded(100.0, 10.0, gain=1.8)
    imu = ImuLog(np.arange(2000) * 10_000_000, *(
        np.concatenate([getattr(log, name) for log in (quiet, loud)]) for name in ("gyr", "acc")))
    assert find_still(loud, NOISE)
    (rest,) = find_still(imu, NOISE)
    assert rest.start == 0 and rest.stop <= 1000


def test_a_turn_is_no_rest():
    imu = recorded(100.0, 20.0)
    imu.gyr[800:1400] += [0.0, 0.0, 0.1]
    assert [(r.start // 100, r.stop // 100) for r in find_still(imu, NOISE)] == [(0, 7), (14, 20)]
