"""A body on rails, level all the way: it rests, rides, rests again."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.estimation.smoother.attempt import Given, Model, attempt
from imu_fusion.estimation.smoother.noise_fit import fit_noise
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.logs import FixLog, ImuLog, VelocityLog

RATE, GRAVITY = 50.0, 9.8
FRAME = LocalFrame(47.0, 11.0, 800.0)
PARAMS = SmootherParams(gravity=GRAVITY, maximum_likelihood="off").replace(**{
    "rest.found": True, "sensor.gyro_noise_density": 2e-4, "sensor.acc_noise_density": 4e-3,
    "sensor.acc_bias_sd": 0.02, "sensor.gyro_bias_sd": 2e-3,
    "initial.position": (47.0, 11.0, 800.0), "initial.position_sd": 0.1,
    "initial.attitude_sd": 0.02})


def ride(*legs, seed=0, speed=0.0):
    """ImuLog, true speeds (n,) and ways (n,) to the east. legs: (s, m/s^2)."""
    rng = np.random.default_rng(seed)
    acc = np.concatenate([np.full(round(t * RATE), a) for t, a in legs])
    speeds = speed + np.concatenate([[0.0], np.cumsum(0.5 * (acc[1:] + acc[:-1]))]) / RATE
    ways = np.concatenate([[0.0], np.cumsum(0.5 * (speeds[1:] + speeds[:-1]))]) / RATE
    force = np.column_stack([acc, np.zeros(len(acc)), np.full(len(acc), GRAVITY)])
    force += 2e-3 * np.sqrt(RATE) * rng.standard_normal(force.shape) + 0.01 * rng.standard_normal(3)
    gyr = 1e-4 * np.sqrt(RATE) * rng.standard_normal(force.shape) + 1e-3 * rng.standard_normal(3)
    stamp = np.round(1e9 / RATE * np.arange(len(acc))).astype(np.int64)
    return ImuLog(stamp, gyr, force), speeds, ways


def smoothed(imu, found=True, **logs):
    return Smoother(PARAMS.replace(**{"rest.found": found})).run(
        imu, initial_quat=Rotation.identity().as_quat(), **logs)


def test_a_body_that_rests_has_no_velocity():
    """After a ride of 20 s with nothing but its start known: where it has come to is told better,
    and what is stated is kept."""
    imu, speeds, ways = ride((4, 0), (2, 2.0), (16, 0.0), (2, -2.0), (4, 0))
    imu.acc[300:1100, 0] += 0.1 * np.sin(8.0 * imu.stamp[300:1100] * 1e-9)     # it is shaken
    with_rests, without = smoothed(imu), smoothed(imu, found=False)
    assert [(round(r.first * 1e-9), round(r.last * 1e-9)) for r in with_rests.rests] == [
        (0, 4), (24, 28)] and not without.rests
    errors, sds = [], []
    for result in (with_rests, without):
        s = result.samples
        errors.append(s["position_world"][-1, 0] - ways[-1])
        sds.append(np.sqrt(s["cov_position"][-1, 0, 0]))
        assert np.all(np.abs(s["vel_world"][:, 0] - speeds) < 4.0 * np.sqrt(
            s["cov_velocity"][:, 0, 0]) + 1e-3)
    assert abs(errors[0]) < min(3.0 * sds[0], abs(errors[1])) and sds[0] < 0.2 * sds[1]
    assert np.linalg.norm(with_rests.samples["vel_world"][-150:], axis=1).max() < 0.01


def test_noise_is_fitted_to_readings_alone():
    """A velocity of zero that nobody read is likelier the surer it is said to be."""
    imu, _, _ = ride((4, 0), (1, 0.5), (1, -0.5), (2, 0))
    given = Given(imu, None, None, None, None, Rotation.identity().as_quat())
    found = attempt(given, Model(PARAMS), None)
    assert found.result.rests
    assert not fit_noise(found.problem, Model(PARAMS)).noise


def test_a_smooth_ride_after_a_rest_is_none():
    """A lift as quiet as its rest: it cannot have stopped, as its start says. Where nothing says
    which of both is the rest, none is."""
    imu, speeds, _ = ride((4, 0), (1.5, 1.0), (8, 0.0))
    result = Smoother(PARAMS.replace(**{"initial.speed_sd": 0.01})).run(
        imu, initial_quat=Rotation.identity().as_quat())
    assert len(result.rests) == 1 and 3e9 < result.rests[0].last < 4e9
    s = result.samples[-1]
    assert abs(s["vel_world"][0] - speeds[-1]) < 3.0 * np.sqrt(s["cov_velocity"][0, 0]) < 1.0
    doubtful = smoothed(imu)
    assert not doubtful.rests and doubtful.samples["cov_velocity"][-1, 0, 0] > 10.0 ** 2


@pytest.mark.parametrize("told", ["fix", "velocity"])
def test_where_the_receiver_says_that_it_moves_it_does_not_rest(told):
    imu, _, ways = ride((10, 0), speed=5.0)
    assert smoothed(imu).rests       # nothing else tells
    every = slice(0, None, 10)
    east = np.column_stack([ways, 0.0 * ways, 0.0 * ways])[every]
    stamp, cov = imu.stamp[every], np.tile(np.eye(3), (len(east), 1, 1))
    log = (FixLog(stamp, *FRAME.to_geodetic(east), cov, np.zeros(len(east))) if told == "fix" else
           VelocityLog(stamp, np.tile([5.0, 0.0, 0.0], (len(east), 1)), 0.01 * cov))
    result = smoothed(imu, **{told: log})
    assert not result.rests
    assert result.samples["vel_world"][-1, 0] == pytest.approx(5.0, abs=0.3)


def test_a_recording_that_begins_in_motion_is_smoothed_from_its_last_rest():
    imu, _, _ = ride((2, 3.0), (2, -3.0), (4, 0), (2, 2.0), (3, 0))
    imu.acc[:200] += np.random.default_rng(1).standard_normal((200, 3))       # carried
    imu.acc[400:] += 4.0 * np.random.default_rng(2).standard_normal((250, 3))
    result = Smoother(PARAMS.replace(**{"initial.speed_sd": 0.01})).run(
        imu, initial_quat=Rotation.identity().as_quat())
    assert 200 <= result.left_out <= 310 and result.left_out + len(result.samples) == len(imu)
    assert any("begins in motion" in text for text in result.remarks())
    chosen = Smoother(PARAMS.replace(**{"initial.start": 6.0})).run(
        imu, initial_quat=Rotation.identity().as_quat())
    assert chosen.samples["stamp"][0] == 6_000_000_000 and chosen.left_out == 300
    assert not any("begins in motion" in text for text in chosen.remarks())


def test_what_is_stated_of_rests_counts():
    imu, _, _ = ride((3, 0), (1, 1.0), (1, -1.0), (1.6, 0))
    few = Smoother(PARAMS.replace(**{"rest.shortest": 2.0})).run(
        imu, initial_quat=Rotation.identity().as_quat())
    assert len(smoothed(imu).rests) == 2 and len(few.rests) == 1
    loose = Smoother(PARAMS.replace(**{"rest.velocity_sd": 0.1})).run(
        imu, initial_quat=Rotation.identity().as_quat())
    sds = [np.sqrt(r.samples["cov_velocity"][20, 0, 0]) for r in (smoothed(imu), loose)]
    assert sds[0] < 0.01 < sds[1] < 0.1
