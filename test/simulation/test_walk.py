"""The simulated walk agrees with itself, and its sensors with the walk."""

import numpy as np
import pytest

from imu_fusion.geometry.gravity import normal_gravity
from imu_fusion.simulation.noise_gnss import GnssErrors
from imu_fusion.simulation.walk import FRAME, Walk, WalkErrors, record

NONE = WalkErrors(gyr_noise_density=0.0, acc_noise_density=0.0, gyr_bias_sd=0.0, acc_bias_sd=0.0,
                  scale_sd=0.0, axes_sd=0.0, mag_noise_sd=0.0, mag_bias_sd=0.0,
                  gnss=GnssErrors(position_sd=(0.0,) * 3, velocity_sd=(0.0,) * 3),
                  lever_arm=(0.1, 0.2, 0.5))


@pytest.fixture(scope="module")
def walk():
    return Walk(40.0, np.random.default_rng(5))


@pytest.fixture(scope="module")
def recorded(walk):
    return record(walk, np.random.default_rng(6), NONE)


def test_rates_are_the_turning_of_the_attitude(walk):
    t, h = np.linspace(1.0, 39.0, 400), 1e-4
    turned = (walk.attitude(t - h).inv() * walk.attitude(t + h)).as_rotvec() / (2.0 * h)
    assert np.abs(turned - walk.rate(t)).max() < 1e-5    # rad/s: of the difference, h^2


def test_force_and_gravity_are_the_acceleration(walk, recorded):
    """At the Imu's own place, with the attitude of the walk: the second derivative by hand."""
    t, h = (recorded.imu.stamp - recorded.imu.stamp[0]) * 1e-9, 1e-3
    inside = slice(200, -200)
    acc = ((walk.position(t + h) - 2.0 * walk.position(t) + walk.position(t - h)) / h ** 2)[inside]
    felt = walk.attitude(t).apply(recorded.imu.acc)[inside]
    felt[:, 2] -= normal_gravity(FRAME.latitude_deg, FRAME.height)
    assert np.abs(felt - acc).max() < 1e-3


def test_velocities_are_those_of_the_antenna(recorded):
    place = FRAME.to_enu(recorded.fix.latitude_deg, recorded.fix.longitude_deg,
                         recorded.fix.height)
    step = np.diff(place, axis=0) * 5.0
    # Steps of .2 s against the mean of both ends: sway of some cm, twice a second.
    assert np.abs(step - 0.5 * (recorded.velocity.vel_world[1:]
                                + recorded.velocity.vel_world[:-1])).mean() < 0.1
    assert 1.2 < np.median(np.linalg.norm(step[40:, :2], axis=1)) < 1.6    # m/s


def test_iron_bends_the_field_by_what_is_asked(walk, recorded):
    bent = record(walk, np.random.default_rng(6), NONE.replace(iron=8e-6))
    off = bent.mag.mag - recorded.mag.mag
    assert np.sqrt(np.mean(off ** 2)) == pytest.approx(8e-6, rel=0.5)    # a walk of ten lengths
