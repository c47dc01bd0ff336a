"""The equations of Fang et al. (2020) and their derivatives, for :mod:`.extended_rts`.

State (40), parameters (42) and inputs (41), state equations (44)-(46), outputs (48)-(50),
constraints (51), discretisation (7)-(9). Where the print errs: the covariance prediction (13)
is ``Phi P Phi' + Gamma Q Gamma'``, and the last term of (45) is ``- w x v``.

Frames are those of the paper: position in the hill frame N (x forward, z down), velocity in
body axes, quaternion (w, x, y, z) of the body against north-east-down (O); magnetic
quantities in microtesla.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from imu_fusion.estimation.smoother.measurements.registry import FIX, VELOCITY
from imu_fusion.geometry.rotation import skew
from imu_fusion.surfaces.hill import Hill

#: Where a state x (22,) has position, velocity, quaternion and the errors of gyroscope,
#: accelerometer, magnetometer (bias, scale); its size.
R, V, Q = slice(0, 3), slice(3, 6), slice(6, 10)
DW, DA, DM, DS = slice(10, 13), slice(13, 16), slice(16, 19), slice(19, 22)
SIZE = 22
_SERIES = 10    # terms of (7)-(9): the next is w^10 / 10!, 1e-11 where w = |rate| dt is 0.35
_EYE = np.eye(3)
ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def to_ned(q: np.ndarray) -> np.ndarray:
    """M_BO transposed (47), without normalisation, as the derivatives need it."""
    w, v = q[0], q[1:]
    return (w * w - v @ v) * _EYE + 2.0 * v[:, None] * v + 2.0 * w * skew(v)


def d_to_ned(q: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Derivative (3, 4) of M_BO' u by q."""
    w, v = q[0], q[1:]
    out = np.empty((3, 4))
    out[:, 0] = w * u + skew(v) @ u
    out[:, 1:] = (v @ u) * _EYE + v[:, None] * u - u[:, None] * v - w * skew(u)
    return 2.0 * out


def _d_to_body(q, u):
    """Derivative (3, 4) of M_BO u by q."""
    conjugate = q * [1.0, -1.0, -1.0, -1.0]
    return d_to_ned(conjugate, u) * [1.0, -1.0, -1.0, -1.0]


def rate_matrix(q: np.ndarray) -> np.ndarray:
    """The matrix of (46), (4, 3)."""
    w, x, y, z = q
    return np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]])


def discretise(a: np.ndarray, f: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Phi (7) and Gamma (9) of an interval by their series; with B for F, (8).

    Args:
        a: (n, n) derivative of the state equations by the state. f: (n, k) by the noise. dt: s.

    Returns:
        (n, n), (n, k).
    """
    term = np.eye(len(a))
    phi, gamma = term.copy(), dt * term
    for i in range(1, _SERIES):
        term = term @ a * (dt / i)
        phi += term
        gamma += term * (dt / (i + 1))
    return phi, gamma @ f


@dataclass(frozen=True)
class Model:
    """State, output and constraint equations (44)-(51) and their derivatives.

    ``axes`` (3, 3): R_hill_world. ``gravity_ned`` (3,) m/s^2, ``field_ned`` (3,) microtesla.
    ``hill``: Hill or None. A state x (22,) is position, velocity, quaternion (40) and the
    biases of gyroscope, accelerometer, magnetometer and its scale errors (42).
    """

    axes: np.ndarray
    gravity_ned: np.ndarray
    field_ned: np.ndarray
    hill: Hill | None = None

    @cached_property
    def to_hill(self) -> np.ndarray:
        """M_NO (31), (3, 3)."""
        return self.axes @ ENU_NED

    def rate(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """The state equations (44)-(46) for inputs u (6,); parameters stand still (22)."""
        omega, force = u[:3] - x[DW], u[3:] - x[DA]
        turn = to_ned(x[Q])
        rate = np.zeros(SIZE)
        rate[R] = self.to_hill @ (turn @ x[V])
        rate[V] = force + turn.T @ self.gravity_ned - skew(omega) @ x[V]
        rate[Q] = 0.5 * rate_matrix(x[Q]) @ omega
        return rate

    def jacobians(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of :meth:`rate`: A (22, 22) by the state, F (22, 6) by the noise (43)."""
        omega = u[:3] - x[DW]
        a, f = np.zeros((SIZE, SIZE)), np.zeros((SIZE, 6))
        a[R, V] = self.to_hill @ to_ned(x[Q])
        a[R, Q] = self.to_hill @ d_to_ned(x[Q], x[V])
        a[V, V] = -skew(omega)
        a[V, Q] = _d_to_body(x[Q], self.gravity_ned)
        a[V, DW] = -skew(x[V])
        a[V, DA] = -_EYE
        a[6, 7:10], a[7:10, 6], a[7:10, 7:10] = -omega, omega, -skew(omega)
        a[Q, Q] *= 0.5
        a[Q, DW] = -0.5 * rate_matrix(x[Q])
        f[:, :3], f[:, 3:] = a[:, DW], a[:, DA]
        return a, f

    def predict(self, x: np.ndarray, cov: np.ndarray, u0: np.ndarray, u1: np.ndarray, dt: float,
                q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Equations (12), (13): Runge-Kutta with inputs that go linearly from u0 to u1.

        Args:
            x, cov: filtered state (22,) and covariance (22, 22). u0, u1: (6,) rad/s, m/s^2.
            dt: s. q: (6,) variances of one sample of the inputs.

        Returns:
            State, covariance, Phi.
        """
        a, f = self.jacobians(x, u0)
        phi, gamma = discretise(a, f, dt)
        middle = 0.5 * (u0 + u1)
        k1 = self.rate(x, u0)
        k2 = self.rate(x + 0.5 * dt * k1, middle)
        k3 = self.rate(x + 0.5 * dt * k2, middle)
        k4 = self.rate(x + dt * k3, u1)
        return (x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4),
                phi @ cov @ phi.T + (gamma * q) @ gamma.T, phi)

    def output(self, kind: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Reading of a kind (FIX, VELOCITY, MAG) as predicted (3,) by (48)-(50) and its
        derivative (3, 22): m in the hill frame, m/s north-east-down, microtesla in body axes."""
        h = np.zeros((3, SIZE))
        if kind == FIX:
            h[:, R] = _EYE
            return x[R], h
        turn = to_ned(x[Q])
        if kind == VELOCITY:
            h[:, V], h[:, Q] = turn, d_to_ned(x[Q], x[V])
            return turn @ x[V], h
        scale, body = 1.0 + x[DS], turn.T @ self.field_ned
        h[:, Q] = scale[:, None] * _d_to_body(x[Q], self.field_ned)
        h[:, DM], h[:, DS] = _EYE, np.diag(body)
        return scale * body + x[DM], h

    def constraints(self, x: np.ndarray, names: Sequence[str]) -> dict[str, tuple]:
        """The norm and those of the hill's constraints that are named, (51): name -> (value,
        derivative (22,)), m, of the quaternion without unit."""
        norm = np.linalg.norm(x[Q])
        h = np.zeros(SIZE)
        h[Q] = x[Q] / norm
        rows = {"norm": (norm - 1.0, h)}
        for name in names:
            h = np.zeros(SIZE)
            if name == "in_run_lateral":
                h[1] = 1.0
                rows[name] = (x[1], h)
                continue
            if self.hill is None:
                raise ValueError(f"constraint {name} is one of a hill")
            profile = self.hill.in_run if name == "in_run" else self.hill.landing
            z, slope, _ = profile(x[0])
            h[0], h[2] = -slope, 1.0
            rows[name] = (x[2] - z, h)
        return rows
