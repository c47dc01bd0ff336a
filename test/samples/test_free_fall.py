"""Free fall: throws worked out by hand."""

import numpy as np
import pytest

from imu_fusion.samples.free_fall import force_at, free_falls

RATE, GRAVITY = 150.0, 9.8


def test_a_spinning_body_falls_where_its_centre_feels_nothing():
    """At 30 rad/s a sensor 35 mm off the centre feels 3.2 g all the time."""
    time = np.arange(0.0, 3.0, 1.0 / RATE)
    rate = np.outer(np.where(time < 2.5, 30.0 + 4.0 * time, 40.0), [0.0, 0.0, 1.0])
    change = np.gradient(rate, time, axis=0)
    arm = np.array([0.035, 0.0, 0.0])
    thrown = (time >= 1.0) & (time < 1.8)
    centre = np.where(thrown[:, None], 0.0, [0.0, 0.0, GRAVITY])
    felt = centre + np.cross(change, arm) + np.cross(rate, np.cross(rate, arm))
    assert not free_falls(time, felt, GRAVITY)
    (fall,) = free_falls(time, force_at(-arm, time, felt, rate), GRAVITY)
    assert time[[fall.start, fall.end]] == pytest.approx([1.0, 1.8], abs=0.01)


def test_a_short_hop_is_none_and_a_gap_ends_a_fall():
    time = np.arange(0.0, 3.0, 1.0 / RATE)
    force = np.tile([0.0, 0.0, GRAVITY], (len(time), 1))
    force[(time >= 0.5) & (time < 0.6)] = 0.0
    force[(time >= 1.0) & (time < 2.0)] = 0.0
    (fall,) = free_falls(time, force, GRAVITY)
    kept = (time < 1.4) | (time >= 1.6)
    before, after = free_falls(time[kept], force[kept], GRAVITY)
    assert time[kept][[before.start, before.end, after.start, after.end]] == pytest.approx(
        [1.0, 1.4, 1.6, 2.0], abs=0.01)
    assert time[[fall.start, fall.end]] == pytest.approx([1.0, 2.0], abs=0.01)
