"""Motion of the body from one Imu sample to the next, and its derivatives (numba).

Between two samples the mean of their rates and forces holds. The position follows from
the velocities by the trapezoidal rule, so its derivative needs no storage of its own.
"""

import math

import numpy as np

from imu_fusion.estimation.smoother.records import INTERVAL
from imu_fusion.estimation.smoother.state import (
    ACC_BIAS,
    ATT,
    GYR_BIAS,
    POS,
    SLOW,
    VEL,
    StateBlocks,
    attitude,
    slow,
)
from imu_fusion.geometry.gravity import gravity_world
from imu_fusion.geometry.rotation import (
    quat_exp,
    quat_multiply,
    quat_normalize,
    quat_to_matrix,
    right_jacobian,
)
from imu_fusion.kernels import njit


@njit
def cross(a, b):
    """Cross product of two vectors, as a tuple."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@njit
def put_cross_matrix(m, v, scale, out, column):
    """out[:, column:column + 3] = scale * m @ [v]x, for m, out with three rows."""
    for i in range(3):
        out[i, column] = scale * (m[i, 1] * v[2] - m[i, 2] * v[1])
        out[i, column + 1] = scale * (m[i, 2] * v[0] - m[i, 0] * v[2])
        out[i, column + 2] = scale * (m[i, 0] * v[1] - m[i, 1] * v[0])


@njit
def put_decay(dt, model, step, n):
    """The factors of the n - 9 slow states over dt s, into a record of STEP."""
    for i in range(SLOW, n):
        rate = model.decay_rate[i]
        step.decay[i] = 1.0 if rate == 0.0 else math.exp(-rate * dt)


@njit
def carry(x, interval, model, step):
    """Carry a state over an interval; fills the step in, but for decay, lever arm and spread.

    The rotation of the Earth enters as a known rate and the Coriolis acceleration; their
    own derivatives (1e-4 per second) are left out of the transition.

    Args:
        x: state (n + 1,).
        interval, model, step: records of INTERVAL, MODEL, STEP; ``step.decay`` is read.
    """
    dt, x_next = interval.dt, step.x_next
    step.dt = dt
    _correct(x, interval, model, step)
    start = quat_to_matrix(attitude(x))
    for i in range(3):
        for j in range(3):
            step.rate[i] -= start[j, i] * model.earth_rate[j]
            step.rotation[i, j] = start[i, j]
        step.turn[i] = step.rate[i] * dt
    half = quat_exp(step.turn, 0.5)
    half_turn = quat_to_matrix(half)
    middle = step.middle
    g = gravity_world(x[POS:POS + 3], model.gravity)
    for i in range(3):
        for j in range(3):
            middle[i, j] = (start[i, 0] * half_turn[0, j] + start[i, 1] * half_turn[1, j]
                            + start[i, 2] * half_turn[2, j])
        a, b = (i + 1) % 3, (i + 2) % 3
        coriolis = 2.0 * (model.earth_rate[a] * x[VEL + b] - model.earth_rate[b] * x[VEL + a])
        step.acc_world[i] = (middle[i, 0] * step.force[0] + middle[i, 1] * step.force[1]
                            + middle[i, 2] * step.force[2] + (g[i] - coriolis))
        x_next[POS + i] = x[POS + i] + dt * (x[VEL + i] + 0.5 * dt * step.acc_world[i])
        x_next[VEL + i] = x[VEL + i] + dt * step.acc_world[i]
    x_next[ATT:ATT + 4] = quat_normalize(quat_multiply(quat_multiply(attitude(x), half), half))
    for i in range(SLOW, len(x) - 1):
        x_next[i + 1] = step.decay[i] * slow(x, i)
    _differentiate(interval, half_turn, model, step)


@njit
def _correct(x, interval, model, step):
    """Rate and specific force of an interval less their errors; the Earth's rate is in it yet."""
    blocks = model.blocks
    for i in range(3):
        step.rate[i] = interval.gyr[i] - slow(x, GYR_BIAS + i)
        step.force[i] = interval.acc[i] - slow(x, ACC_BIAS + i)
    if blocks.gyr_scale >= 0:
        for i in range(3):
            step.rate[i] += slow(x, blocks.gyr_scale + i) * interval.gyr[i]
    if blocks.acc_matrix >= 0:
        for i in range(3):
            for j in range(3):
                step.force[i] += slow(x, blocks.acc_matrix + 3 * i + j) * interval.acc[j]


@njit
def _differentiate(interval, half_turn, model, step):
    """Rows of velocity and attitude of the transition matrix; entries that no block uses stay
    zero."""
    dt, blocks = interval.dt, model.blocks
    f_vel, f_att, middle = step.f_vel, step.f_att, step.middle
    # Attitude: Exp(-turn) of the old error, and the right Jacobian of the rate's.
    jacobian = right_jacobian(step.turn)
    # Velocity: the error of the attitude in the middle is that of the start, turned by half.
    lever = step.lever
    put_cross_matrix(middle, (step.force[0], step.force[1], step.force[2]), -dt, lever, 0)
    for i in range(3):
        for j in range(3):
            f_att[i, ATT + j] = (half_turn[j, 0] * half_turn[0, i]
                                 + half_turn[j, 1] * half_turn[1, i]
                                 + half_turn[j, 2] * half_turn[2, i])
            f_att[i, GYR_BIAS + j] = -dt * jacobian[i, j]
            f_vel[i, ATT + j] = (lever[i, 0] * half_turn[j, 0] + lever[i, 1] * half_turn[j, 1]
                                 + lever[i, 2] * half_turn[j, 2])
            f_vel[i, GYR_BIAS + j] = -0.5 * dt * lever[i, j]
            f_vel[i, ACC_BIAS + j] = -dt * middle[i, j]
    if blocks.gyr_scale >= 0:
        for j in range(3):
            for i in range(3):
                f_att[i, blocks.gyr_scale + j] = dt * jacobian[i, j] * interval.gyr[j]
                f_vel[i, blocks.gyr_scale + j] = 0.5 * dt * lever[i, j] * interval.gyr[j]
    if blocks.acc_matrix >= 0:
        for j in range(3):
            for i in range(3):
                for r in range(3):
                    f_vel[r, blocks.acc_matrix + 3 * i + j] = dt * middle[r, i] * interval.acc[j]


def columns_of(blocks: StateBlocks) -> list[int]:
    """Error indices that velocity and attitude of the next sample depend on, besides the
    velocity: those of MODEL."""
    columns = list(range(ATT, ACC_BIAS + 3))
    for first, width in ((blocks.acc_matrix, 9), (blocks.gyr_scale, 3)):
        if first >= 0:
            columns += range(first, first + width)
    return columns


def intervals_of(steps: np.ndarray, means: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Intervals (N - 1,) of INTERVAL from steps dt (N - 1,) s, means of rates and forces
    (N - 1, 6) and their variance densities (N - 1, 6)."""
    intervals = np.empty(len(steps), INTERVAL)
    intervals["dt"] = steps
    intervals["gyr"], intervals["acc"] = means[:, :3], means[:, 3:]
    intervals["gyr_noise"], intervals["acc_noise"] = noise[:, :3], noise[:, 3:]
    return intervals
