"""Steps on the manifold of states, and products with the transition matrix (numba).

The transition matrix F is never formed: its rows of velocity and attitude come from
:func:`.model.interval`, those of the position follow by the trapezoidal rule, and slow
states only decay.
"""

import math

from imu_fusion.kernels import njit

from imu_fusion.estimation.smoother.model import ATT, POS, VEL
from imu_fusion.geometry.rotation import (
    quat_conjugate, quat_exp, quat_log, quat_multiply, quat_normalize)


@njit
def boxplus(x, delta):
    """State x (n + 1,) moved by an error state delta (n,), in place."""
    x[6:10] = quat_normalize(quat_multiply(x[6:10], quat_exp(delta[ATT:ATT + 3])))
    for i in range(6):
        x[i] += delta[i]
    for i in range(9, len(delta)):
        x[i + 1] += delta[i]


@njit
def boxminus(a, b, out):
    """out (n,) with a = b [+] out, for states a, b (n + 1,)."""
    out[ATT:ATT + 3] = quat_log(quat_multiply(quat_conjugate(b[6:10]), a[6:10]))
    for i in range(6):
        out[i] = a[i] - b[i]
    for i in range(9, len(out)):
        out[i] = a[i + 1] - b[i + 1]


@njit
def propagate_rows(m, out, dt, decay, f_vel, f_att, columns):
    """out = F @ m for a matrix m (n, k)."""
    n, width = m.shape
    for i in range(3):
        for j in range(width):
            out[VEL + i, j] = m[VEL + i, j]
            out[ATT + i, j] = 0.0
        for c in columns:
            v, a = f_vel[i, c], f_att[i, c]
            for j in range(width):
                out[VEL + i, j] += v * m[c, j]
            if a != 0.0:
                for j in range(width):
                    out[ATT + i, j] += a * m[c, j]
        for j in range(width):
            out[POS + i, j] = m[POS + i, j] + 0.5 * dt * (m[VEL + i, j] + out[VEL + i, j])
    for i in range(9, n):
        for j in range(width):
            out[i, j] = decay[i] * m[i, j]


@njit
def propagate_cov(cov, work, dt, decay, f_vel, f_att, columns):
    """cov = F @ cov @ F.T for a symmetric matrix (n, n), in place and exactly symmetric.

    Slow states only decay, so that the rows of position, velocity and attitude are all that
    has to be multiplied. work: (n, n) scratch.
    """
    n = len(cov)
    for i in range(3):
        for j in range(n):
            work[VEL + i, j] = cov[VEL + i, j]
            work[ATT + i, j] = 0.0
    for c in columns:
        v0, v1, v2 = f_vel[0, c], f_vel[1, c], f_vel[2, c]
        a0, a1, a2 = f_att[0, c], f_att[1, c], f_att[2, c]
        for j in range(n):
            value = cov[c, j]
            work[VEL, j] += v0 * value
            work[VEL + 1, j] += v1 * value
            work[VEL + 2, j] += v2 * value
            work[ATT, j] += a0 * value
            work[ATT + 1, j] += a1 * value
            work[ATT + 2, j] += a2 * value
    for i in range(3):
        for j in range(n):
            work[POS + i, j] = cov[POS + i, j] + 0.5 * dt * (cov[VEL + i, j] + work[VEL + i, j])
    for i in range(9, n):
        if decay[i] != 1.0:
            for j in range(9, n):
                cov[i, j] *= decay[i]
                cov[j, i] *= decay[i]
    for i in range(3):
        for j in range(3):
            both = 0.0
            for c in columns:
                both += work[VEL + i, c] * f_att[j, c]
            cov[VEL + i, ATT + j] = cov[ATT + j, VEL + i] = both
            if j > i:
                continue
            vel, att = work[VEL + i, VEL + j], 0.0
            for c in columns:
                vel += work[VEL + i, c] * f_vel[j, c]
                att += work[ATT + i, c] * f_att[j, c]
            cov[VEL + i, VEL + j] = cov[VEL + j, VEL + i] = vel
            cov[ATT + i, ATT + j] = cov[ATT + j, ATT + i] = att
    # Positions follow by the trapezoidal rule from velocities before and after.
    for i in range(3):
        for j in range(3):
            cov[VEL + j, POS + i] = cov[POS + i, VEL + j] = (
                work[VEL + j, POS + i]
                + 0.5 * dt * (work[VEL + j, VEL + i] + cov[VEL + j, VEL + i]))
            cov[ATT + j, POS + i] = cov[POS + i, ATT + j] = (
                work[ATT + j, POS + i]
                + 0.5 * dt * (work[ATT + j, VEL + i] + cov[ATT + j, VEL + i]))
    for i in range(3):
        for j in range(i + 1):
            cov[POS + i, POS + j] = cov[POS + j, POS + i] = (
                work[POS + i, POS + j]
                + 0.5 * dt * (work[POS + i, VEL + j] + cov[POS + i, VEL + j]))
    for i in range(9):
        for j in range(9, n):
            cov[i, j] = cov[j, i] = decay[j] * work[i, j]


@njit
def adjoint_rows(m, out, dt, decay, f_vel, f_att, columns):
    """out = F.T @ m for a matrix m (n, k)."""
    n, width = m.shape
    for i in range(3):
        for j in range(width):
            out[POS + i, j] = m[POS + i, j]
            out[VEL + i, j] = m[VEL + i, j] + dt * m[POS + i, j]
            out[ATT + i, j] = 0.0
    for i in range(9, n):
        for j in range(width):
            out[i, j] = decay[i] * m[i, j]
    for i in range(3):
        for c in columns:
            v, a = f_vel[i, c], f_att[i, c]
            for j in range(width):
                out[c, j] += v * (m[VEL + i, j] + 0.5 * dt * m[POS + i, j])
            if a != 0.0:
                for j in range(width):
                    out[c, j] += a * m[ATT + i, j]


@njit
def interval_noise(q_acc, middle, dt, spread):
    """spread (3, 3): covariance of the velocity step in world axes."""
    for i in range(3):
        for j in range(3):
            spread[i, j] = dt * (middle[i, 0] * middle[j, 0] * q_acc[0]
                                 + middle[i, 1] * middle[j, 1] * q_acc[1]
                                 + middle[i, 2] * middle[j, 2] * q_acc[2])


@njit
def slow_noise(walk, rate, dt, factor):
    """Variance that a slow state gains; factor is its decay over dt."""
    return walk * dt if rate == 0.0 else 0.5 * walk / rate * (1.0 - factor * factor)


@njit
def apply_step(x, step, largest):
    """Move states x (m, n + 1) by deviations step (m, n), in place; ``largest`` (3,) grows to
    the largest change of position (m), velocity (m/s) and attitude (rad)."""
    for k in range(len(x)):
        boxplus(x[k], step[k])
        for b in range(3):
            size = math.sqrt(step[k, 3 * b] ** 2 + step[k, 3 * b + 1] ** 2
                             + step[k, 3 * b + 2] ** 2)
            largest[b] = max(largest[b], size)
