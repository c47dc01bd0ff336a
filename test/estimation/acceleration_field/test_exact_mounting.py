"""A rig that is as described loses nothing by the doubt that it may be off (Magill 1965)."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.exact_mounting import ask, change_of, make_exact
from imu_fusion.estimation.acceleration_field.misfit import widening
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
    Initial,
)
from imu_fusion.estimation.acceleration_field.start import given_start, rest_start
from imu_fusion.simulation.rigid_body_impact import PAPER_AXES, PAPER_POSITIONS, simulate

CENTRE = PAPER_POSITIONS.mean(axis=0)
PARAMS = AccelerationFieldParams(gravity=9.8, initial=Initial(
    mode="given", angular_velocity=(5.0, 5.0, 5.0), angular_velocity_sd=0.05,
    orientation_sd=0.002))
NOISE, BIAS = 0.3, 0.1    # m/s^2
EXACT = {"position_sd": 0.0, "axes_sd": 0.0, "scale_sd": 0.0}


@pytest.fixture(scope="module")
def motion():
    return simulate(duration=1.0)    # falls for half of it


def sensors(**mounting):
    return [AccelerometerParams(position=tuple(place), axes=tuple(axes.ravel()), bias_sd=BIAS,
                                noise_density=NOISE / 1000 ** 0.5, **mounting)
            for place, axes in zip(PAPER_POSITIONS - CENTRE, PAPER_AXES)]


def felt(motion, seed, off=0.0):
    """Readings (n, 4, 3), of a rig that is ``off`` times 1 mm, 2 deg and 1 % off."""
    rng = np.random.default_rng(seed)
    places = PAPER_POSITIONS + off * 1e-3 * rng.standard_normal((4, 3))
    axes = np.array([axes @ Rotation.from_rotvec(off * 0.035 * rng.standard_normal(3)).as_matrix().T
                     for axes in PAPER_AXES])
    readings = motion.readings(places, axes) * (1 + off * 0.01 * rng.standard_normal((1, 4, 3)))
    return readings + rng.normal(0, BIAS, (1, 4, 3)) + rng.normal(0, NOISE, readings.shape)


def result(motion, readings, rig, **params):
    """(rms error, mean normalised error squared) of the specific force, and the estimator."""
    estimator = AccelerationFieldEstimator(PARAMS.replace(**params), rig)
    rows = estimator.run(motion.stamp, readings)[50:]
    error = motion.specific_force_body(CENTRE)[50:] - rows["specific_force"]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(rows["cov_specific_force"]), error)
    return np.sqrt(np.mean(error ** 2)), nees.mean(), estimator


@pytest.mark.parametrize("mode", ["causal", "smoothed"])
def test_a_rig_as_described_is_estimated_as_if_that_were_known(motion, mode):
    seeds = range(4)
    doubted = [result(motion, felt(motion, seed), sensors(), mode=mode) for seed in seeds]
    known = [result(motion, felt(motion, seed), sensors(**EXACT), mode=mode) for seed in seeds]
    assert np.mean([error for error, _, _ in doubted]) == pytest.approx(
        np.mean([error for error, _, _ in known]), rel=0.03)
    # It stays cautious: what all sensors have in common, no reading tells.
    assert np.mean([nees for _, nees, _ in doubted]) < 3.0


@pytest.mark.parametrize("off", [0.1, 0.3, 1.0])
def test_a_rig_that_is_off_is_found_out_and_what_is_stated_is_honest(motion, off):
    """A tenth of the defaults is 0.1 mm, 0.2 deg and 0.1 %."""
    found = [result(motion, felt(motion, seed, off), sensors()) for seed in range(6)]
    assert all(estimator._filter.share_of_exact == 0.0 for _, _, estimator in found)
    honest = np.mean([nees for _, nees, _ in found])
    assert honest < 4.5
    exact = [result(motion, felt(motion, seed, off), sensors(**EXACT)) for seed in range(6)]
    assert np.mean([nees for _, nees, _ in exact]) > 1.5 * honest    # the hypothesis itself is not


def test_the_start_of_an_exact_rig_is_that_of_the_other_given_so(motion):
    known, doubted = (AccelerationFieldEstimator(PARAMS, sensors(**mounting)).array
                      for mounting in (EXACT, {}))
    still = np.array([axes @ [0.3, -0.2, 9.78] for axes in PAPER_AXES]).reshape(1, 12)
    still = still + np.random.default_rng(0).normal(0.0, NOISE, (500, 12))
    for start in (given_start, lambda params, array: rest_start(params, array, still)):
        expected = start(PARAMS, known)
        got = start(PARAMS, doubted)
        exact = make_exact(doubted)
        ask(exact, got.x, got.cov)
        change = change_of(exact, got.cov)
        turn = (Rotation.from_quat(got.quat) * Rotation.from_rotvec(change[:3])).inv()
        assert (turn * Rotation.from_quat(expected.quat)).magnitude() < 2e-3
        assert np.allclose((got.x[:18] + change)[3:], expected.x[3:18], atol=2e-3)


def test_what_is_no_constant_of_a_sensor_widens_what_is_stated(motion):
    """An accelerometer 3 ms late: its biases and mounting take that as well as they can."""
    late = []
    for seed in range(4):
        readings = felt(motion, seed)
        readings[3:, 0] = readings[:-3, 0].copy()
        _, nees, estimator = result(motion, readings, sensors())
        late.append(nees)
        assert widening(estimator._filter.state.x, estimator.array.channels) > 4.0
    assert np.mean(late) < 10.0    # several times as much without it


@pytest.mark.parametrize("off, mounting", [(0.0, {}), (1.0, {}), (0.0, EXACT)])
def test_nothing_is_widened_by_what_was_said_of_the_sensors(motion, off, mounting):
    """With an exact mounting a sensor has three constants, of which chance makes more."""
    for seed in range(8):
        _, _, estimator = result(motion, felt(motion, seed, off), sensors(**mounting))
        assert widening(estimator._filter.state.x, estimator.array.channels) == 1.0
