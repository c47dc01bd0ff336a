"""Rotation kernels against scipy and their defining properties."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from imu_fusion.geometry import rotation as rot

ROUNDING = 1e-14  # a few float64 roundings of numbers of order one


def random_quats(n=50, seed=1):
    return Rotation.random(n, random_state=seed).as_quat()


def vectors_of_all_sizes(seed=2):
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    angles = np.concatenate([[0.0], 10.0 ** np.linspace(-12, 0, 30), np.linspace(1, 3.1, 9)])
    return directions * angles[:, None]


def test_product_and_matrix_follow_scipy():
    p, q = random_quats(seed=3), random_quats(seed=4)
    for a, b in zip(p, q):
        product = Rotation.from_quat(a) * Rotation.from_quat(b)
        np.testing.assert_allclose(rot.quat_to_matrix(rot.quat_multiply(a, b)),
                                   product.as_matrix(), atol=ROUNDING)


def test_rotate_is_active_and_inverse_undoes_it():
    quarter_turn_about_up = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    east = np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(rot.quat_rotate(quarter_turn_about_up, east), [0, 1, 0],
                               atol=ROUNDING)
    for q, v in zip(random_quats(), np.random.default_rng(5).normal(size=(50, 3))):
        np.testing.assert_allclose(rot.quat_rotate(q, v), Rotation.from_quat(q).apply(v),
                                   atol=10 * ROUNDING)
        np.testing.assert_allclose(rot.quat_rotate_inverse(q, rot.quat_rotate(q, v)), v,
                                   atol=10 * ROUNDING)


def test_exponential_is_that_of_the_skew_matrix():
    for phi in vectors_of_all_sizes():
        np.testing.assert_allclose(rot.quat_to_matrix(rot.quat_exp(phi)),
                                   expm(rot.skew(phi)), atol=20 * ROUNDING)


def test_logarithm_undoes_exponential_with_relative_precision():
    for phi in vectors_of_all_sizes():
        for sign in (1.0, -1.0):  # q and -q are one rotation
            np.testing.assert_allclose(rot.quat_log(sign * np.array(rot.quat_exp(phi))), phi,
                                       rtol=1e-11, atol=1e-300)


@pytest.mark.parametrize("axis", range(3))
def test_matrix_to_quat_at_half_turns(axis):
    for angle in (np.pi, np.pi - 1e-9, 2.0):
        phi = np.zeros(3)
        phi[axis] = angle
        m = Rotation.from_rotvec(phi).as_matrix()
        np.testing.assert_allclose(rot.quat_to_matrix(rot.quat_from_matrix(m)), m,
                                   atol=10 * ROUNDING)


def test_right_jacobian_is_the_derivative_of_the_exponential():
    step = 1e-6
    for phi in vectors_of_all_sizes():
        jacobian = rot.right_jacobian(phi)
        for i in range(3):
            d = np.zeros(3)
            d[i] = step
            # central difference: error of order step^2, rounding of order 1e-16 / step
            forward = np.array(rot.quat_log(rot.quat_multiply(
                rot.quat_conjugate(rot.quat_exp(phi - d)), rot.quat_exp(phi + d))))
            np.testing.assert_allclose(jacobian[:, i], forward / (2 * step), atol=1e-9)


def test_roll_pitch_yaw_are_those_of_rep_103():
    for q in random_quats(seed=6):
        yaw, pitch, roll = Rotation.from_quat(q).as_euler("ZYX")
        np.testing.assert_allclose(rot.quat_to_rpy(q), [roll, pitch, yaw], atol=1e-12)
    nose_down = np.array([0.0, np.sin(0.25), 0.0, np.cos(0.25)])
    np.testing.assert_allclose(rot.quat_to_rpy(nose_down), [0.0, 0.5, 0.0], atol=ROUNDING)
