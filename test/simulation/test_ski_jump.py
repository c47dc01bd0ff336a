"""The simulated jump is consistent motion on the given hill."""

import numpy as np
import pytest
from scipy.integrate import cumulative_simpson
from scipy.spatial.transform import Rotation

from imu_fusion.simulation.jump_sensors import EPOCH, PhoneErrors, period_means, record
from imu_fusion.simulation.noise import gauss_markov
from imu_fusion.simulation.noise_gnss import GnssErrors, gnss_errors
from imu_fusion.simulation.ski_jump import JumpParams, SkiJump
from imu_fusion.surfaces.file import load_surface


@pytest.fixture(scope="module")
def jump():
    """With the sensor exactly on the profile, where nothing is said."""
    return SkiJump(load_surface("oberstdorf_hs106"), JumpParams(wobble=0.0))


@pytest.fixture(scope="module")
def fine(jump):
    return jump.at(np.arange(3, 24, 0.001))


def test_acceleration_integrates_to_velocity_and_position(jump, fine):
    # Simpson's rule jumps where the acceleration does (joints of the hill, contact): each of
    # the dozen jumps of up to 20 m/s^2 costs up to half a step.
    v = cumulative_simpson(fine.acc_world, x=fine.time, axis=0, initial=0)
    assert np.abs(v - fine.vel_world).max() < 0.02
    smooth = (fine.time > jump.t_takeoff + 0.01) & (fine.time < jump.t_touchdown - 0.01)
    t, a, v, p = (x[smooth] for x in (fine.time, fine.acc_world, fine.vel_world,
                                      fine.position_world))
    # In the air nothing jumps: Simpson's rule at 1 ms is exact to rounding of the truth.
    assert np.abs(cumulative_simpson(a, x=t, axis=0, initial=0) - (v - v[0])).max() < 1e-7
    assert np.abs(cumulative_simpson(v, x=t, axis=0, initial=0) - (p - p[0])).max() < 1e-7


def test_rates_integrate_to_the_attitude(fine):
    r = Rotation.from_quat(fine.quat_world_imu)
    turn = (r[:-1].inv() * r[1:]).as_rotvec() / 0.001
    middle = 0.5 * (fine.omega_imu[1:] + fine.omega_imu[:-1])
    error = np.sort(np.abs(turn - middle).max(axis=1))
    # Trapezoid at 1 ms: second derivative of the rate (some 400 rad/s^3) times dt^2 / 12. Where
    # the slope under the skis ends to bend or begins to, the rate steps by up to v / R = 0.25
    # rad/s: where the table begins, on landing, at both ends of the transition.
    assert error[:-4].max() < 1e-4
    assert error.max() < 0.5 * 0.25


def test_arm_follows_the_jumper(jump):
    """Upper arm from shoulder to elbow: forward, right, down."""
    def arm(t):
        motion = jump.at([t])
        x_axis = Rotation.from_quat(motion.quat_world_imu).apply([1.0, 0.0, 0.0])
        return jump.hill.to_hill(x_axis)[0], jump.hill.to_hill(motion.vel_world)[0]

    on_bar, _ = arm(1.0)
    assert on_bar[2] > 0.8 and on_bar[0] < 0.0              # hangs, the hands behind
    in_run, velocity = arm(jump.t_start + 3.0)
    assert in_run @ velocity < -0.95 * np.linalg.norm(velocity)  # back along the skis
    air, velocity = arm(0.5 * (jump.t_takeoff + jump.t_touchdown))
    cosine = -air @ velocity / np.linalg.norm(velocity)
    assert np.cos(np.radians(60)) < cosine < np.cos(np.radians(20))  # back, at an angle to the air
    telemark, _ = arm(jump.t_touchdown + 0.7)
    assert telemark[1] > 0.9                                # the right arm to the right
    standing, _ = arm(26.0)
    assert standing[2] > 0.9                                # hangs


def test_motion_stays_on_the_hill(jump, fine):
    in_run, lateral, landing = jump.hill.constraints()
    before = fine.time < jump.t_takeoff - jump.params.push_duration
    assert np.abs(in_run.evaluate(fine.position_world[before])[0]).max() < 1e-9
    assert np.abs(lateral.evaluate(fine.position_world[before])[0]).max() < 1e-9
    rest = fine.time > jump.t_touchdown + 1.0
    assert np.abs(landing.evaluate(fine.position_world[rest])[0]).max() < 1e-6
    air = (fine.time > jump.t_takeoff + 0.3) & (fine.time < jump.t_touchdown)
    assert landing.evaluate(fine.position_world[air])[0].min() > 0
    edge = jump.hill.to_hill(jump.at([jump.t_takeoff]).position_world)[0]
    assert abs(edge[0]) < 1e-6
    touch = jump.hill.to_hill(jump.at([jump.t_touchdown]).position_world)[0]
    assert abs(touch[0] - jump.x_touchdown) < 1e-9
    assert 80 < jump.length < 110  # a plausible jump on this hill


def test_a_wobble_is_random_motion_against_the_skis(jump, fine):
    shaken = SkiJump(jump.hill, JumpParams(wobble=0.03)).shaken(np.random.default_rng(1))
    motion = shaken.at(fine.time)
    off = jump.hill.to_hill(motion.position_world - fine.position_world)
    ground = (fine.time > jump.t_start) & (fine.time < jump.t_takeoff)
    ground |= fine.time > jump.t_touchdown
    # Twenty sines over 15 s, faded at the ends: the spread scatters by a third.
    assert np.all(np.abs(off[ground][:, 1:].std(axis=0) / 0.03 - 1) < 0.35)
    assert (off[~ground] == 0.0).all() and np.abs(off[:, 0]).max() < 1e-12  # rounding
    assert np.abs(np.corrcoef(off[ground][:, 1:].T)[0, 1]) < 0.6
    other = shaken.shaken(np.random.default_rng(2)).at(fine.time)
    assert np.abs(other.position_world - motion.position_world).max() > 0.03
    # The difference from the motion without it is smooth: Simpson's rule at 1 ms is exact to
    # rounding. A wrong derivative would leave centimetres.
    for derivative, value in (("vel_world", "position_world"), ("acc_world", "vel_world")):
        rate, change = (getattr(motion, name) - getattr(fine, name)
                        for name in (derivative, value))
        summed = cumulative_simpson(rate, x=fine.time, axis=0, initial=0)
        assert np.abs(summed - (change - change[0])).max() < 1e-6


def test_samples_add_up_over_steps_of_the_force(jump):
    # The force steps at the start, at the edge and on landing; some sample in the middle of it.
    period, means, values = 0.01, [], []
    for event in (jump.t_start, jump.t_takeoff, jump.t_touchdown):
        times = round(event, 2) + period * np.arange(-5, 6)
        motion = jump.at(times)
        first, last = jump.at([times[0] - 0.5 * period, times[-1] + 0.5 * period]).vel_world
        turn = Rotation.from_quat(motion.quat_world_imu)
        fall = np.array([0.0, 0.0, -jump.gravity])

        def missed(force):
            return np.linalg.norm(first + period * (turn.apply(force) + fall).sum(axis=0) - last)

        # A step of 15 m/s^2 is placed to half a millisecond, and the sensor turns by 0.01 rad
        # in a period under that force.
        means.append(missed(period_means(jump, times, period)[1]))
        values.append(missed(jump.specific_force(motion)))
    assert max(means) < 0.01
    assert max(values) > 0.02  # what the means are for: half a period of 5.6 m/s^2 at the start


def test_energy_of_the_in_run(jump):
    # Drop of 36.8 m gives 26.9 m/s without losses; friction and drag take some of it.
    edge = jump.at([jump.t_takeoff - 0.2])
    speed = np.linalg.norm(edge.vel_world[0])
    start = jump.at([0.0]).position_world[0]
    drop = start[2] - edge.position_world[0, 2]
    limit = np.sqrt(2 * jump.gravity * drop)
    assert 0.9 * limit < speed < limit


def test_sensors_at_rest(jump):
    quiet = PhoneErrors(gyr_sd=0, acc_sd=0, mag_sd=0, gyr_bias_sd=0, acc_bias_sd=0,
                        mag_bias_sd=0, mag_scale_sd=0)
    exact = GnssErrors(position_sd=(0, 0, 0), velocity_sd=(0, 0, 0))
    r = record(jump, np.random.default_rng(0), quiet, exact)
    first = Rotation.from_quat(r.motion.quat_world_imu[0])
    up = first.apply(r.imu.acc[0])
    assert np.allclose(up, [0, 0, jump.gravity], atol=1e-3)  # the plumb line turns with place
    north = first.apply(r.mag.mag[0])
    # Central Europe: some 21 uT to the north, 43 uT down, declination a few degrees east.
    assert 19e-6 < north[1] < 23e-6 and -46e-6 < north[2] < -40e-6 and 0 < north[0] < 3e-6
    enu = jump.hill.origin.to_enu(r.fix.latitude_deg, r.fix.longitude_deg, r.fix.height)
    t = (r.fix.stamp - EPOCH) * 1e-9
    assert np.abs(enu - jump.at(t).position_world).max() < 1e-6
    assert np.abs(r.velocity.vel_world - jump.at(t).vel_world).max() < 1e-6


def test_gnss_errors_have_the_stated_statistics():
    rng = np.random.default_rng(3)
    times = np.arange(40000) * 0.1
    e = gauss_markov(times, [2.0], 5.0, rng)[:, 0]
    # 4000 s hold 400 independent stretches: the variance is known to some 7 %.
    assert abs(e.std() / 2.0 - 1) < 0.1
    assert abs(np.corrcoef(e[:-50], e[50:])[0, 1] - np.exp(-1)) < 0.15
    position, velocity = gnss_errors(times, GnssErrors(outlier_share=0.08), rng)
    far = np.abs(position / [3, 3, 5]).max(axis=1) > 4.5
    # An outlier of 10 sd exceeds 4.5 sd on one of three axes in 95 %: 1 - (2 Phi(.45) - 1)^3.
    assert 0.065 < far.mean() < 0.085
    assert np.allclose(np.median(np.abs(velocity), axis=0) / 0.6745 / [0.1, 0.1, 0.3], 1.05,
                       atol=0.05)
