"""Circles and laps: rates and accelerations belong to attitudes and positions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.simulation.going_round import Circles, Swing, Walk
from imu_fusion.simulation.rotation import GRAVITY

TIME = np.arange(0.0, 20.0, 0.005)


@pytest.mark.parametrize(
    "motion", [Circles(1, leans=True), Circles(2, rate=-0.7), Walk(3), Swing(5)],
    ids=["leaning", "level", "walk", "swing"])
def test_rates_and_accelerations_are_those_of_the_motion(motion):
    quat, rate, place, acceleration = motion.truth(TIME)
    turn, step = Rotation.from_quat(quat), TIME[1]
    found = (turn[:-1].inv() * turn[1:]).as_rotvec() / step
    assert found == pytest.approx(0.5 * (rate[:-1] + rate[1:]), abs=1e-3)
    second = np.diff(place, 2, axis=0) / step ** 2
    assert second == pytest.approx(acceleration[1:-1], abs=0.05)
    still = motion.rest - 0.1 > TIME
    assert np.ptp(place[still], axis=0).max() < 1e-9 and np.abs(rate[still]).max() < 1e-9


@pytest.mark.parametrize("rate", [0.8, -0.8])
def test_who_leans_into_a_circle_feels_a_larger_gravity_from_where_it_was_at_rest(rate):
    """As on a scooter, whose rider's weight stays in the plane of its wheels."""
    motion = Circles(4, radius=4.0, rate=rate, leans=True, sway=0.0)
    quat, rates, place, acceleration = motion.truth(TIME)
    force = Rotation.from_quat(quat).inv().apply(acceleration + [0.0, 0.0, GRAVITY])
    late = TIME > 10.0
    inwards = 0.8 ** 2 * 4.0
    assert force[late] == pytest.approx(
        np.tile(force[0] / GRAVITY * np.hypot(GRAVITY, inwards), (late.sum(), 1)), abs=1e-3)
    assert np.linalg.norm(rates[late], axis=1) == pytest.approx(0.8, abs=1e-6)
    assert np.linalg.norm(place, axis=1) == pytest.approx(4.0)


def test_a_swing_pulls_along_its_rope():
    motion = Swing(6, twist=0.0)
    quat, _, _, acceleration = motion.truth(TIME)
    force = Rotation.from_quat(quat).inv().apply(acceleration + [0.0, 0.0, GRAVITY])
    along = force @ force[0] / GRAVITY
    # Its push, that which makes it swing further, is across, and small.
    assert np.linalg.norm(force - along[:, None] * force[0] / GRAVITY, axis=1).max() < 1.5
    assert along.max() > 1.1 * GRAVITY
