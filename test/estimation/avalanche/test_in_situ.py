"""Calibration by the terrain: what goes in comes out, and the traps of the printed equations."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.errors import CalibrationError
from imu_fusion.estimation.avalanche.dead_reckoning import BallSamples, dead_reckon
from imu_fusion.estimation.avalanche.in_situ import Constraint, calibrate_in_situ, sweep

G = 9.802
MATRIX = np.eye(3) + np.array([[.02, -.031, .012], [.018, -.03, .025], [-.022, .008, .034]])
BIAS, DRIFT = np.array([.25, -.4, .3]), np.array([-.2, .1, .15])
NORMAL = np.array([-.37, -.38, .848]) / np.linalg.norm([-.37, -.38, .848])
LEVER_ARM = (.012, -.031, -.012)


def tumbling_on_the_slope(matrix=MATRIX, bias=BIAS, drift=(0.0, 0.0, 0.0), n=900, seed=0):
    """Samples of a body that tumbles and moves exactly along a plane; what its accelerometer
    reports is such that ``matrix @ reported + bias + tau drift`` is the force."""
    rng = np.random.default_rng(seed)
    time = np.arange(n) / 150.0
    rate = np.cumsum(rng.standard_normal((n, 3)), axis=0) * .25
    quat = np.empty((n, 4))
    turn = Rotation.from_rotvec([.3, .2, .1])
    for i in range(n):
        quat[i] = turn.as_quat()
        turn = turn * Rotation.from_rotvec(rate[i] / 150.0)
    along = np.linalg.svd(NORMAL[None])[2][1:]
    acc = np.cumsum(rng.standard_normal((n, 2)), axis=0) @ along
    force = Rotation.from_quat(quat).inv().apply(acc + [0.0, 0.0, G])
    gained = rate[np.minimum(np.arange(n) + 1, n - 1)] - rate[np.maximum(np.arange(n) - 1, 0)]
    alpha = gained * 75.0
    alpha[[0, -1]] *= 2.0
    force += np.cross(alpha, LEVER_ARM) + np.cross(rate, np.cross(rate, LEVER_ARM))
    tau = np.linspace(0.0, 1.0, n)[:, None]
    reported = (force - bias - tau * drift) @ np.linalg.inv(matrix).T
    return BallSamples(time, quat, reported, rate, LEVER_ARM), np.abs(acc @ NORMAL).max()


@pytest.mark.parametrize("level", ["position", "velocity"])
@pytest.mark.parametrize("model, bias, drift", [(1, 0 * BIAS, 0 * DRIFT), (2, BIAS, 0 * DRIFT),
                                                (3, BIAS, DRIFT)])
def test_what_was_wrong_is_found(level, model, bias, drift):
    samples, off = tumbling_on_the_slope(bias=bias, drift=drift)
    assert off < 1e-10
    found = calibrate_in_situ(samples, Constraint(NORMAL, G, level, model, rho=0.0))
    assert found.matrix == pytest.approx(MATRIX, abs=1e-5)
    assert found.bias == pytest.approx(bias, abs=1e-4)
    assert found.drift == pytest.approx(drift, abs=1e-4)
    assert found.violation < 1e-6


def test_a_transposed_matrix_and_the_signs_of_eq_31_leave_the_slope():
    samples, _ = tumbling_on_the_slope()
    found = calibrate_in_situ(samples, Constraint(NORMAL, G, rho=0.0))

    def off(calibration):
        track = dead_reckon(calibration.apply(samples), G)
        return np.sqrt(np.mean((track.position @ NORMAL) ** 2))

    assert off(found) < 1e-6
    assert off(replace(found, matrix=found.matrix.T)) > 0.5
    assert off(replace(found, bias=-found.bias)) > 0.5


def test_the_position_is_told_by_it():
    """The constraint looks along the normal; the calibration mends all directions."""
    samples, _ = tumbling_on_the_slope()
    truth, _ = tumbling_on_the_slope(matrix=np.eye(3), bias=0 * BIAS)
    found = calibrate_in_situ(samples, Constraint(NORMAL, G, rho=0.0))
    true, before, after = (dead_reckon(s, G).position for s in (
        truth, samples, found.apply(samples)))
    assert np.abs(before - true).max() > 5.0
    assert np.abs(after - true).max() < 1e-3


def test_objective_and_violation_grow_with_rho():
    """Whatever the data: the paper's smallest minimum at rho = 1 (Fig. 14) cannot be."""
    samples, _ = tumbling_on_the_slope()
    found = sweep(samples, Constraint(NORMAL, G), np.logspace(-4, 2, 13))
    assert np.all(np.diff([f.objective for f in found]) > 0)
    assert np.all(np.diff([f.violation for f in found]) > 0)
    assert np.all(np.diff([f.condition for f in found]) < 0)
    assert found[0].condition < found[0].condition_constraint


def test_rest_tells_norm_and_tilt():
    """The first attitude is found from the force that is calibrated: as wrong as that, all
    attitudes are. With (30) and realignment both come out."""
    samples, _ = tumbling_on_the_slope()
    field = Rotation.from_quat(samples.quat[0]).inv().apply([0.0, 0.45, -0.9])
    still = np.linalg.inv(MATRIX) @ (
        Rotation.from_quat(samples.quat[0]).inv().apply([0.0, 0.0, G]) - BIAS)
    # The attitude that the uncalibrated force shows at rest, all others after it.
    up = still / np.linalg.norm(still)
    east = np.cross(field, up) / np.linalg.norm(np.cross(field, up))
    wrong = Rotation.from_matrix(np.array([east, np.cross(up, east), up]))
    turn = wrong * Rotation.from_quat(samples.quat[0]).inv()
    assert np.degrees(turn.magnitude()) > 1.0
    tilted = replace(samples, quat=(turn * Rotation.from_quat(samples.quat)).as_quat())
    constraint = Constraint(NORMAL, G, rho=1e-6, rest_force=still)
    found = calibrate_in_situ(tilted, constraint, realign=field)
    left = Rotation.from_quat(found.apply(tilted).quat[0]) * Rotation.from_quat(
        samples.quat[0]).inv()
    assert np.degrees(left.magnitude()) < 0.01
    assert found.matrix == pytest.approx(MATRIX, abs=1e-4)
    printed = calibrate_in_situ(tilted, replace(constraint, rest_force=None))
    assert np.abs(printed.matrix - MATRIX).max() > 5 * np.abs(found.matrix - MATRIX).max()


@pytest.mark.parametrize("wrong", [dict(level="height"), dict(model=4), dict(rho=-1.0)])
def test_what_it_does_not_know_is_refused(wrong):
    with pytest.raises(CalibrationError, match="in situ"):
        Constraint(NORMAL, G, **wrong)


def test_too_little_is_refused():
    samples, _ = tumbling_on_the_slope(n=20)
    with pytest.raises(CalibrationError, match="20 samples"):
        calibrate_in_situ(samples, Constraint(NORMAL, G))
    with pytest.raises(CalibrationError, match="force at rest"):
        calibrate_in_situ(tumbling_on_the_slope()[0], Constraint(NORMAL, G), realign=NORMAL)


@pytest.mark.parametrize("seed", [10, 13])
def test_realignment_does_not_run_away_from_wrong_attitudes(seed):
    """Attitudes that wander by tens of degrees: full steps leave 18 and 30 m."""
    samples, _ = tumbling_on_the_slope(seed=seed)
    wander = .2 * np.cumsum(np.random.default_rng(seed).standard_normal((len(samples.time), 3)),
                            axis=0)
    samples = replace(samples, quat=(Rotation.from_rotvec(wander)
                                     * Rotation.from_quat(samples.quat)).as_quat())
    rest = samples.force[0] * G / np.linalg.norm(samples.force[0])
    field = Rotation.from_quat(samples.quat[0]).inv().apply([1.0, 21.0, -43.0])
    found = calibrate_in_situ(samples, Constraint(NORMAL, G, rest_force=rest), field)
    assert found.violation < 3.0
