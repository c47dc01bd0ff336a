"""The algebra of the fusion filter: predictions, updates and their adjoints."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation import fusion
from imu_fusion.estimation.orientation.params import OrientationParams


@pytest.mark.parametrize("states", [es.EXCESS, es.N])
def test_prediction_and_its_adjoint_against_dense_algebra(states):
    rng = np.random.default_rng(2)
    move = rng.normal(size=es.MOVE_SIZE)
    move[es.MOVE_STATES] = states
    a, b = rng.normal(size=(2, es.N))
    assert es.move_error(move, a) @ b == pytest.approx(a @ es.move_adjoint(move, b))

    transition = np.stack([es.move_error(move, unit) for unit in np.eye(es.N)], axis=1)
    noise = np.diag(move[es.MOVE_NOISE:])
    noise[states:] = 0.0
    cov = (root := rng.normal(size=(es.N, es.N))) @ root.T
    predicted, information = cov.copy(), cov.copy()
    es.predict(predicted, move)
    es.predict_information(information, move)
    assert predicted == pytest.approx(transition @ cov @ transition.T + noise)
    assert information == pytest.approx(transition.T @ cov @ transition)


def test_prediction_is_the_flow_of_the_error():
    """The equations at the head of the module, integrated in small steps."""
    rng = np.random.default_rng(5)
    rotation, gyr, force = rng.normal(size=(3, 3)), rng.normal(size=3), rng.normal(size=3)
    time, steps, surge_time = 0.02, 4000, 0.04
    move = np.zeros(es.MOVE_SIZE)
    move[es.MOVE_TIME], move[es.MOVE_STATES], move[es.MOVE_LOCAL_KEEP] = time, es.N, 1.0
    move[es.MOVE_ROTATION:es.MOVE_SCALE] = (rotation * time).ravel()
    move[es.MOVE_SCALE:es.MOVE_FORCE] = (rotation[:, :, None] * gyr * time).ravel()
    move[es.MOVE_FORCE:es.MOVE_EXCESS] = force * time
    move[es.MOVE_EXCESS:es.MOVE_LOCAL_KEEP] = (rotation * time).ravel()
    move[es.MOVE_EXCESS_KEEP:es.MOVE_SURGE_KEEP] = 1.0
    par = np.zeros(fusion.P_SIZE)
    fusion.pack(par, OrientationParams(surge_time=surge_time))
    gain = fusion._surge_gain(par, time)
    move[es.MOVE_SURGE_KEEP] = math.exp(-time / surge_time)
    move[es.MOVE_SURGE_GAIN] = gain
    move[es.MOVE_SURGE_MEAN] = surge_time * (1.0 - gain / time)

    start = rng.normal(size=es.N)
    error = start.copy()
    for _ in range(steps):
        rate = np.zeros(es.N)
        rate[es.ATT:es.BIAS] = rotation @ (error[es.SCALE:es.VEL].reshape(3, 3) @ gyr
                                           - error[es.BIAS:es.SCALE] + error[es.EXCESS:es.SURGE])
        rate[es.VEL:es.POS] = (-np.cross(force, error[es.ATT:es.BIAS])
                               - rotation @ error[es.ACC_BIAS:es.LAG])
        rate[es.POS:es.FIELD] = error[es.VEL:es.POS]
        rate[es.EXCESS:es.SURGE] = error[es.SURGE:]
        rate[es.SURGE:] = -error[es.SURGE:] / surge_time
        error += rate * time / steps
    moved = es.move_error(move, start)
    # Euler's error, 2e-5. A block takes the attitude error at its start for that of the whole: it
    # grows by 0.19 here, half of which acts on the velocity.
    assert moved[:es.VEL] == pytest.approx(error[:es.VEL], abs=5e-5)
    assert moved[es.POS:] == pytest.approx(error[es.POS:], abs=5e-5)
    assert moved[es.VEL:es.POS] == pytest.approx(error[es.VEL:es.POS],
                                                 abs=0.1 * np.abs(force).max() * time)


def test_surge_against_the_matrix_exponential():
    """Singer's process over a step, short and long ones, from its differential equation."""
    par = np.zeros(fusion.P_SIZE)
    fusion.pack(par, OrientationParams(surge_sd=200.0, surge_time=0.04))
    rate = 1.0 / 0.04
    dynamics = np.array([[0.0, 1.0], [0.0, -rate]])        # excess, surge
    driven = np.diag([0.0, 2.0 * rate * 200.0 ** 2])
    for time in (1e-5, 3.9e-4, 4.1e-4, 0.002, 0.05, 0.5):
        # Van Loan (1978): transition and noise are blocks of one exponential.
        blocks = expm(np.block([[dynamics, driven], [np.zeros((2, 2)), -dynamics.T]]) * time)
        transition = blocks[:2, :2]
        noise = blocks[:2, 2:] @ transition.T
        assert fusion._surge_gain(par, time) == pytest.approx(transition[0, 1], rel=1e-9)
        # The series leaves out three quarters of a hundredth, at most.
        assert fusion._surge_noise(par, time) == pytest.approx((noise[1, 1], noise[0, 0]),
                                                               rel=8e-3)


def test_update_and_its_adjoint_against_dense_algebra():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(es.N, es.N))
    cov = root @ root.T
    index = np.array([1, 5, 20])
    coefficient = np.array([0.5, -1.0, 2.0])
    h = np.zeros(es.N)
    h[index] = coefficient
    total = h @ cov @ h + 0.3
    gain = cov @ h / total
    tape = np.zeros(es.TAPE_SIZE)
    updated, error = cov.copy(), np.zeros(es.N)
    es.update(updated, error, es.N, index, coefficient, 0.7, 0.3, tape)
    assert error == pytest.approx(gain * 0.7)
    assert updated == pytest.approx(cov - np.outer(gain, h @ cov))

    adjoint, information = rng.normal(size=es.N), rng.normal(size=(es.N, es.N))
    information = information + information.T
    back = np.eye(es.N) - np.outer(gain, h)
    expected = back.T @ adjoint + h * 0.7 / total
    expected_information = back.T @ information @ back + np.outer(h, h) / total
    es.unupdate(tape[es.TAPE_OP:es.TAPE_OP + es.OP_SIZE], adjoint, information, es.N)
    assert adjoint == pytest.approx(expected)
    assert information == pytest.approx(expected_information)
