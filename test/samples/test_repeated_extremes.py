"""The range of a sensor from single samples at it."""

import numpy as np
import pytest

from imu_fusion.samples.flat_tops import ACC_FLOOR
from imu_fusion.samples.repeated_extremes import range_shown

LIMIT, STEP = 176.5, 176.5 / 2 ** 13


def blows(rng, size=60.0):
    """Forces (n, 3) of a body that is hit at every twentieth sample, by more along x."""
    forces = rng.standard_normal((4000, 3)) + [0.0, 0.0, 9.8]
    forces[::20] += size * rng.standard_normal((200, 3)) * [1.5, 1.0, 0.3]
    return STEP * np.round(forces / STEP)


def test_equal_largest_forces_are_the_end_of_the_range():
    forces = np.clip(blows(np.random.default_rng(1)), -LIMIT, LIMIT - STEP)
    assert np.count_nonzero(np.abs(forces[:, 0]) > 176.4) > 5
    found = range_shown(forces, ACC_FLOOR)
    assert found[0] == pytest.approx(LIMIT, rel=1e-3)
    assert np.isinf(found[2])


@pytest.mark.parametrize("seed", range(20))
def test_largest_forces_that_differ_are_none(seed):
    assert np.isinf(range_shown(blows(np.random.default_rng(seed)), ACC_FLOOR)).all()


def test_what_a_coarse_converter_repeats_and_what_stands_still_is_none():
    rng = np.random.default_rng(2)
    assert np.isinf(range_shown(np.round(blows(rng) / 2.0) * 2.0, ACC_FLOOR)).all()
    held = blows(rng)
    held[100:110] = 200.0, 3.0, 4.0    # a driver that repeats a sample
    assert np.isinf(range_shown(held, ACC_FLOOR)).all()
    assert np.isinf(range_shown(np.tile([0.0, 0.0, 9.8], (100, 1)), ACC_FLOOR)).all()
    assert np.isinf(range_shown(np.empty((0, 3)), ACC_FLOOR)).all()
