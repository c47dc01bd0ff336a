"""When a ball stops: spins that end as drag, dry friction and a wall end them."""

import numpy as np
import pytest

from imu_fusion.samples.logs import ImuLog
from imu_fusion.samples.motion_span import find_motion

STOP, REST_RATE = 20.0, 0.02    # s, rad/s


def spin(kind, time):
    left = np.clip(STOP - time, 0.0, None)
    return {"drag": REST_RATE * np.exp(np.minimum((STOP - time) / 0.35, 5.5)),
            "slow drag": REST_RATE * np.exp(np.minimum(STOP - time, 5.5)),
            "friction": REST_RATE * (left > 0.0) + 2.0 * left,
            "wall": 5.0 * (left > 0.0)}[kind]


@pytest.mark.parametrize("rate", [100, 400])
@pytest.mark.parametrize("kind", ["drag", "slow drag", "friction", "wall"])
def test_a_spin_ends_where_it_is_down_to_the_level_of_rest(kind, rate):
    """Within .05 s, by a gyroscope whose samples have half of that level as noise."""
    rng = np.random.default_rng(3)
    time = np.arange(0.0, 35.0, 1.0 / rate)
    moving = spin(kind, time) * (time > 5.0)
    gyr = np.outer(moving, [0.6, 0.64, 0.48]) + 0.0105 * rng.standard_normal((len(time), 3))
    acc = [0.0, 0.0, 9.8] + (0.3 + moving[:, None]) * rng.standard_normal((len(time), 3))
    motion = find_motion(ImuLog((time * 1e9).astype(np.int64) + 10**18, gyr + 0.01, acc))
    assert time[motion.start] == pytest.approx(5.0, abs=0.05)
    assert time[motion.stop] == pytest.approx(STOP, abs=0.05)
    # What it rested at before is of the rest before.
    assert time[motion.rest_start] < 5.0 and np.abs(motion.gyr_bias - 0.01).max() < 2e-3


@pytest.mark.parametrize("quiet", [([0.0, 0.0, 2.9], 0.0), ([0.0, 0.0, 9.8], 1.5)],
                         ids=["flight", "steady spin"])
def test_what_is_quiet_in_mid_ride_is_no_rest(quiet):
    """In flight it feels its spin alone; a spin about the vertical leaves gravity as it is."""
    force, rate = quiet
    rng = np.random.default_rng(4)
    time = np.arange(0.0, 30.0, 0.01)
    moving, flies = (time > 5.0) & (time < 20.0), (time > 11.0) & (time < 12.0)
    shaken = moving & ~flies
    gyr = 0.005 * rng.standard_normal((len(time), 3)) + np.outer(shaken, [3.0, 0.0, 0.0])
    gyr[flies, 2] += rate
    acc = [0.0, 0.0, 9.8] + (0.1 + 4.0 * shaken[:, None]) * rng.standard_normal((len(time), 3))
    acc[flies] += force - np.array([0.0, 0.0, 9.8])
    motion = find_motion(ImuLog((time * 1e9).astype(np.int64), gyr, acc))
    assert time[motion.start] == pytest.approx(5.0, abs=0.05)
    assert time[motion.stop] == pytest.approx(20.0, abs=0.05)
    assert motion.begins_recording
