"""Products with the transition matrix, noise of an interval, steps of whole trajectories (numba).

``step`` and ``model`` are records of STEP and MODEL.

The transition matrix F is never formed: its rows of velocity and attitude come from
:func:`.motion.carry`, those of the position follow by the trapezoidal rule, and slow
states only decay.
"""

import math

import numpy as np

from imu_fusion.estimation.smoother.state import ATT, POS, SLOW, VEL, boxplus
from imu_fusion.kernels import njit


@njit
def propagate_rows(m, out, step, model):
    """out = F @ m for a matrix m (n, k)."""
    n, width = m.shape
    dt, f_vel, f_att = step.dt, step.f_vel, step.f_att
    for i in range(3):
        for j in range(width):
            out[VEL + i, j] = m[VEL + i, j]
            out[ATT + i, j] = 0.0
        for e in range(model.n_columns):
            c = model.columns[e]
            v, a = f_vel[i, c], f_att[i, c]
            for j in range(width):
                out[VEL + i, j] += v * m[c, j]
            if a != 0.0:
                for j in range(width):
                    out[ATT + i, j] += a * m[c, j]
        for j in range(width):
            out[POS + i, j] = m[POS + i, j] + 0.5 * dt * (m[VEL + i, j] + out[VEL + i, j])
    for i in range(SLOW, n):
        for j in range(width):
            out[i, j] = step.decay[i] * m[i, j]


@njit
def adjoint_rows(m, out, step, model):
    """out = F.T @ m for a matrix m (n, k)."""
    n, width = m.shape
    dt, f_vel, f_att = step.dt, step.f_vel, step.f_att
    for i in range(3):
        for j in range(width):
            out[POS + i, j] = m[POS + i, j]
            out[VEL + i, j] = m[VEL + i, j] + dt * m[POS + i, j]
            out[ATT + i, j] = 0.0
    for i in range(SLOW, n):
        for j in range(width):
            out[i, j] = step.decay[i] * m[i, j]
    for i in range(3):
        for e in range(model.n_columns):
            c = model.columns[e]
            v, a = f_vel[i, c], f_att[i, c]
            for j in range(width):
                out[c, j] += v * (m[VEL + i, j] + 0.5 * dt * m[POS + i, j])
            if a != 0.0:
                for j in range(width):
                    out[c, j] += a * m[ATT + i, j]


@njit
def propagate_cov(cov, work, step, model):
    """cov = F @ cov @ F.T for a symmetric matrix (n, n), in place and exactly symmetric.

    Slow states only decay, so that the rows of position, velocity and attitude are all that
    has to be multiplied. work: (n, n) scratch.
    """
    n, decay = len(cov), step.decay
    _fast_rows(cov, work, step, model)
    for i in range(SLOW, n):
        if decay[i] != 1.0:
            for j in range(SLOW, n):
                cov[i, j] *= decay[i]
                cov[j, i] *= decay[i]
    _velocity_attitude_cov(cov, work, step, model)
    _position_cov(cov, work, step.dt)
    for i in range(SLOW):
        for j in range(SLOW, n):
            cov[i, j] = cov[j, i] = decay[j] * work[i, j]


@njit
def _fast_rows(cov, work, step, model):
    """Rows of position, velocity and attitude of F @ cov, into work."""
    n, dt, f_vel, f_att = len(cov), step.dt, step.f_vel, step.f_att
    for i in range(3):
        for j in range(n):
            work[VEL + i, j] = cov[VEL + i, j]
            work[ATT + i, j] = 0.0
    for e in range(model.n_columns):
        c = model.columns[e]
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


@njit
def _velocity_attitude_cov(cov, work, step, model):
    """Blocks of velocity and attitude of F @ cov @ F.T, from work = F @ cov."""
    f_vel, f_att = step.f_vel, step.f_att
    for i in range(3):
        for j in range(3):
            both = 0.0
            for e in range(model.n_columns):
                c = model.columns[e]
                both += work[VEL + i, c] * f_att[j, c]
            cov[VEL + i, ATT + j] = cov[ATT + j, VEL + i] = both
            if j > i:
                continue
            vel, att = work[VEL + i, VEL + j], 0.0
            for e in range(model.n_columns):
                c = model.columns[e]
                vel += work[VEL + i, c] * f_vel[j, c]
                att += work[ATT + i, c] * f_att[j, c]
            cov[VEL + i, VEL + j] = cov[VEL + j, VEL + i] = vel
            cov[ATT + i, ATT + j] = cov[ATT + j, ATT + i] = att


@njit
def _position_cov(cov, work, dt):
    """Blocks of the position: it follows by the trapezoidal rule from the velocities before
    (work = F @ cov) and after (cov)."""
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


@njit
def put_spread(acc_noise, step):
    """``step.spread`` of variance densities acc_noise (3,) in the axes in the middle."""
    middle = step.middle
    for i in range(3):
        for j in range(3):
            step.spread[i, j] = step.dt * (middle[i, 0] * middle[j, 0] * acc_noise[0]
                                           + middle[i, 1] * middle[j, 1] * acc_noise[1]
                                           + middle[i, 2] * middle[j, 2] * acc_noise[2])


@njit
def slow_noise(i, step, model):
    """Variance that the slow state i gains over a step."""
    rate, walk, decay = model.decay_rate[i], model.walk[i], step.decay[i]
    return walk * step.dt if rate == 0.0 else 0.5 * walk / rate * (1.0 - decay * decay)


@njit
def add_noise(cov, gyr_noise, step, model):
    """Add to cov (n, n) what is unknown of an interval: variance densities of the rate (3,), the
    spread of the velocity, the walks of the slow states."""
    dt, spread = step.dt, step.spread
    for i in range(3):
        cov[ATT + i, ATT + i] += gyr_noise[i] * dt
        for j in range(3):
            cov[VEL + i, VEL + j] += spread[i, j]
            cov[POS + i, VEL + j] += 0.5 * dt * spread[i, j]
            cov[VEL + i, POS + j] += 0.5 * dt * spread[i, j]
            cov[POS + i, POS + j] += 0.25 * dt * dt * spread[i, j]
    for i in range(SLOW, len(cov)):
        cov[i, i] += slow_noise(i, step, model)


@njit
def apply_step(x: np.ndarray, step: np.ndarray, largest: np.ndarray) -> None:
    """Move states x (m, n + 1) by deviations step (m, n), in place; ``largest`` (3,) grows to
    the largest change of position (m), velocity (m/s) and attitude (rad)."""
    for k in range(len(x)):
        boxplus(x[k], step[k])
        for b in range(3):
            size = math.sqrt(step[k, 3 * b] ** 2 + step[k, 3 * b + 1] ** 2
                             + step[k, 3 * b + 2] ** 2)
            largest[b] = max(largest[b], size)
