"""The simulated ball moves as mechanics has it, and does what the paper's ball did."""

import numpy as np
import pytest
from scipy.integrate import cumulative_simpson
from scipy.spatial.transform import Rotation

from imu_fusion.geometry.gravity import gravity_world
from imu_fusion.simulation.avalanche import ROWS_PER_SECOND, Avalanche, AvalancheParams
from imu_fusion.simulation.ball_sensors import LEVER_ARM, BallErrors, record_ball

STANDARD_GRAVITY = 9.80665


@pytest.fixture(scope="module")
def avalanche():
    return Avalanche()


@pytest.fixture(scope="module")
def motion(avalanche):
    return avalanche.motion


def test_forces_integrate_to_velocity_and_position(avalanche, motion):
    turn = Rotation.from_quat(motion.quat)
    gravity = np.array([gravity_world(p, avalanche.gravity) for p in motion.position[::50]])
    gravity = np.column_stack([np.interp(motion.time, motion.time[::50], g) for g in gravity.T])
    acc = (turn.apply(motion.force) + gravity
           - 2.0 * np.cross(avalanche.earth_rate, motion.vel))
    velocity = cumulative_simpson(acc, x=motion.time, axis=0, initial=0)
    # Forces have kinks where the ball touches the snow: some hundred, each of 1e-5 m/s.
    assert np.abs(velocity - motion.vel).max() < 3e-3
    position = cumulative_simpson(motion.vel, x=motion.time, axis=0, initial=0)
    assert np.abs(position + motion.position[0] - motion.position).max() < 1e-3


def test_rates_integrate_to_the_attitude(motion):
    turn = Rotation.from_quat(motion.quat)
    step = (turn[:-1].inv() * turn[1:]).as_rotvec() * ROWS_PER_SECOND
    middle = 0.5 * (motion.omega[1:] + motion.omega[:-1])
    assert np.abs(step - middle).max() < 5e-3    # trapezoid: dt^2 / 12 of 1e5 rad/s^3


def test_a_point_of_the_ball_feels_how_its_path_bends(avalanche, motion):
    near = slice(10 * ROWS_PER_SECOND, 19 * ROWS_PER_SECOND)
    path = motion.position_of(LEVER_ARM)[near]
    acc = np.diff(path, n=2, axis=0) * ROWS_PER_SECOND ** 2
    force = Rotation.from_quat(motion.quat[near]).apply(motion.specific_force(LEVER_ARM)[near])
    error = force[1:-1] - [0.0, 0.0, avalanche.gravity] - acc
    assert np.sqrt(np.mean(error ** 2)) < 0.05   # of 4 g that the lever arm makes


def test_it_does_what_the_papers_ball_did(avalanche, motion):
    """Section 3 and 4: 0.8 s of flight, impacts to almost 15 g, spin of some 35 rad/s, 220 m in
    the flow and 420 to 430 m in 70 s."""
    starts = [phase.start for phase in motion.phases]
    assert [phase.number for phase in motion.phases] == list(range(7))
    assert starts == sorted(starts)
    assert 0.7 < starts[3] - starts[2] < 1.2
    time, size = motion.time, np.linalg.norm(motion.force, axis=1)
    assert np.allclose(motion.force[time < 0], motion.force[0])
    assert np.allclose(size[time < 0], avalanche.gravity)
    assert size[(time > starts[2]) & (time < starts[3] - 1e-3)].max() == 0.0
    assert 10 < size.max() / STANDARD_GRAVITY < 18
    spin = np.linalg.norm(motion.omega, axis=1)
    assert 30 < spin[time < 9].max() < 40 and 30 < spin[time > 16].max() < 40
    assert 68 < starts[6] < 71.5
    path = np.cumsum(np.linalg.norm(motion.vel, axis=1)) / ROWS_PER_SECOND
    assert 190 < np.interp(16.0, time, path) < 250 and 380 < path[-1] < 480
    forward = motion.vel @ avalanche.slope_axes()[:, 0]
    assert 18 < forward.max() < 23


def test_it_follows_a_hump():
    """A terrain with a convexity, from its elevations: the ball never sinks deeper than snow
    gives, and flies off the hump no farther than its speed takes it."""
    avalanche = Avalanche(AvalancheParams(hump_height=6.0), np.random.default_rng(3))
    motion, rest = avalanche.motion, 10 * ROWS_PER_SECOND
    east, north, up = motion.position[rest:].T
    above = up - avalanche.elevation(east, north)
    assert above.min() > -0.3 and above.max() < 4.0
    plane = up + np.tan(np.radians(32.0)) * (east + north) / np.sqrt(2.0)
    assert plane.max() > 4.0
    # Its slope frame turns with the terrain.
    assert avalanche.slope_axes((30.0, 30.0, 0.0))[2, 2] > avalanche.slope_axes()[2, 2] + 0.03


def test_perfect_sensors_read_the_truth(avalanche, motion):
    log = record_ball(avalanche, np.random.default_rng(0), BallErrors.none())
    turn = Rotation.from_quat(motion.quat[log.rows])
    assert np.allclose(log.imu.acc, motion.specific_force(LEVER_ARM)[log.rows])
    assert np.allclose(log.imu.gyr, motion.omega[log.rows]
                       + turn.inv().apply(avalanche.earth_rate))
    assert np.allclose(turn.apply(log.mag.mag), log.field_world)
    assert np.allclose((log.imu.stamp - log.imu.stamp[0]) * 1e-9,
                       motion.time[log.rows] - motion.time[0], atol=1e-9)


def test_the_balls_sensors_err_as_said(avalanche, motion):
    log = record_ball(avalanche, np.random.default_rng(1))
    time = motion.time[log.rows]
    steps = np.diff(time)
    assert np.sum(steps > 0.1) == 1 and abs(steps.max() - 0.5) < 0.01
    # Clipped before the calibration: flat tops beside 6 rad/s, not at it.
    tops = np.abs(log.imu.gyr).max(axis=0)
    assert (tops > 5.8).all() and (tops < 6.3).all() and (np.abs(tops - 6.0) > 1e-3).any()
    true = np.abs(motion.omega[log.rows])
    clipped = (true > 6.0).any(axis=1)
    assert 0.08 < clipped[(time > 0) & (time < 9)].mean() < 0.35
    assert np.linalg.norm(log.acc_matrix - np.eye(3)) / 3.0 == pytest.approx(0.03, rel=0.6)
    still = time < 0
    expected = motion.force[0] @ log.acc_matrix.T + log.acc_bias
    assert np.allclose(log.imu.acc[still].mean(axis=0), expected, atol=0.05)
    norm = np.linalg.norm(log.mag.mag, axis=1)
    assert norm.std() > 3e-6
    # No fixes while it moves.
    fixes = (log.fix.stamp - log.imu.stamp[0]) * 1e-9 + motion.time[0]
    assert not ((fixes > 0) & (fixes < 71)).any() and len(fixes) > 40
