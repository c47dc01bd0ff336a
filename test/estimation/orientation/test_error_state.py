"""The algebra of the fusion filter: predictions, updates and their adjoints."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from imu_fusion.estimation.orientation import clipped_rate
from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation.params import OrientationParams, kernel_parameters
from imu_fusion.estimation.orientation.state import STATE


def random_prediction(rng, states):
    """A PREDICTION of numbers that mean nothing."""
    move = np.zeros(1, es.PREDICTION)[0]
    for name in es.PREDICTION.names:
        if name != "states":
            move[name] = rng.normal(size=es.PREDICTION[name].shape)
    move["states"] = states
    return move


@pytest.mark.parametrize("states", [es.CLIPPED_RATE, es.N])
def test_prediction_and_its_adjoint_against_dense_algebra(states):
    rng = np.random.default_rng(2)
    move = random_prediction(rng, states)
    a, b = rng.normal(size=(2, es.N))
    assert es.move_error(move, a) @ b == pytest.approx(a @ es.move_adjoint(move, b))

    transition = np.stack([es.move_error(move, unit) for unit in np.eye(es.N)], axis=1)
    noise = np.diag(move["noise"].copy())
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
    time, steps, acc_time = 0.02, 4000, 0.04
    move = np.zeros(1, es.PREDICTION)[0]
    move["time"], move["states"], move["local_field_keep"] = time, es.N, 1.0
    move["acc_bias_keep"] = 1.0
    move["rotation"] = move["clipped_rotation"] = rotation * time
    move["rotation_gyr"] = (rotation[:, :, None] * gyr * time).reshape(3, 9)
    move["force"] = force * time
    move["stays_clipped"] = 1.0
    par = kernel_parameters(OrientationParams.from_mapping({"fusion.angular_acc_time": acc_time}))
    gain = clipped_rate.gain(par[0], time)
    move["acc_keep"] = math.exp(-time / acc_time)
    move["rate_gain"] = gain
    move["rate_mean"] = acc_time * (1.0 - gain / time)

    start = rng.normal(size=es.N)
    error = start.copy()
    for _ in range(steps):
        rate = np.zeros(es.N)
        rate[es.ATTITUDE:es.GYRO_BIAS] = rotation @ (
            error[es.GYRO_SCALE:es.VELOCITY].reshape(3, 3) @ gyr
            - error[es.GYRO_BIAS:es.GYRO_SCALE] + error[es.CLIPPED_RATE:es.ANGULAR_ACC])
        rate[es.VELOCITY:es.POSITION] = (-np.cross(force, error[es.ATTITUDE:es.GYRO_BIAS])
                                         - rotation @ error[es.ACC_BIAS:es.MAG_LAG])
        rate[es.POSITION:es.FIELD] = error[es.VELOCITY:es.POSITION]
        rate[es.CLIPPED_RATE:es.ANGULAR_ACC] = error[es.ANGULAR_ACC:]
        rate[es.ANGULAR_ACC:] = -error[es.ANGULAR_ACC:] / acc_time
        error += rate * time / steps
    moved = es.move_error(move, start)
    # Euler's error, 2e-5. A block takes the attitude error at its start for that of the whole: it
    # grows by 0.19 here, half of which acts on the velocity.
    assert moved[:es.VELOCITY] == pytest.approx(error[:es.VELOCITY], abs=5e-5)
    assert moved[es.POSITION:] == pytest.approx(error[es.POSITION:], abs=5e-5)
    assert moved[es.VELOCITY:es.POSITION] == pytest.approx(
        error[es.VELOCITY:es.POSITION], abs=0.1 * np.abs(force).max() * time)


def test_clipped_rate_against_the_matrix_exponential():
    """Singer's process over a step, short and long ones, from its differential equation."""
    par = kernel_parameters(OrientationParams.from_mapping(
        {"fusion.angular_acc_sd": 200.0, "fusion.angular_acc_time": 0.04}))[0]
    rate = 1.0 / 0.04
    dynamics = np.array([[0.0, 1.0], [0.0, -rate]])        # clipped rate, angular acceleration
    driven = np.diag([0.0, 2.0 * rate * 200.0 ** 2])
    for time in (1e-5, 3.9e-4, 4.1e-4, 0.002, 0.05, 0.5):
        # Van Loan (1978): transition and noise are blocks of one exponential.
        blocks = expm(np.block([[dynamics, driven], [np.zeros((2, 2)), -dynamics.T]]) * time)
        transition = blocks[:2, :2]
        noise = blocks[:2, 2:] @ transition.T
        assert clipped_rate.gain(par, time) == pytest.approx(transition[0, 1], rel=1e-9)
        # The series leaves out three quarters of a hundredth, at most.
        assert clipped_rate.noise(par, time) == pytest.approx((noise[1, 1], noise[0, 0]),
                                                              rel=8e-3)


def sparse_row():
    """A ROW of three columns, and the same dense."""
    row = np.zeros(1, es.ROW)[0]
    row["count"] = 3
    row["index"][:3] = 1, 5, 20
    row["coefficient"][:3] = 0.5, -1.0, 2.0
    row["residual"], row["variance"] = 0.7, 0.3
    h = np.zeros(es.N)
    h[[1, 5, 20]] = 0.5, -1.0, 2.0
    return row, h


def test_update_and_its_adjoint_against_dense_algebra():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(es.N, es.N))
    cov = root @ root.T
    row, h = sparse_row()
    total = h @ cov @ h + 0.3
    gain = cov @ h / total
    tape = np.zeros(1, es.TAPE)
    tape["prediction"]["states"] = es.N
    updated, error = cov.copy(), np.zeros(es.N)
    es.update(updated, error, es.N, row, tape)
    assert error == pytest.approx(gain * 0.7)
    assert updated == pytest.approx(cov - np.outer(gain, h @ cov))

    adjoint, information = rng.normal(size=es.N), rng.normal(size=(es.N, es.N))
    information = information + information.T
    back = np.eye(es.N) - np.outer(gain, h)
    expected = back.T @ adjoint + h * 0.7 / total
    expected_information = back.T @ information @ back + np.outer(h, h) / total
    es.unupdate(tape[0], 0, adjoint, information)
    assert adjoint == pytest.approx(expected)
    assert information == pytest.approx(expected_information)


def test_a_tape_that_is_full_says_so():
    row, _ = sparse_row()
    tape = np.zeros(1, es.TAPE)
    cov, error = np.eye(es.N), np.zeros(es.N)
    for _ in range(es.MAX_UPDATES):
        es.update(cov, error, es.N, row, tape)
    with pytest.raises(IndexError, match="MAX_UPDATES"):
        es.update(cov, error, es.N, row, tape)


def test_the_error_state_is_that_of_the_nominal_state():
    """Every part of the error state but the attitude has its field, of the same size."""
    parts = ["gyro_bias", "gyro_scale", "velocity", "position", "field", "local_field",
             "mag_offset", "acc_bias", "mag_lag", "mag_matrix", "clipped_rate", "angular_acc"]
    at = 3
    for name in parts:
        assert getattr(es, name.upper()) == at, name
        at += math.prod(STATE[name].shape)
    assert at == es.N
