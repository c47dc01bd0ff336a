"""State of the rigid-body model, and how it moves between samples (numba).

The state is the mean ``x`` (N,) with its covariance, and a quaternion that ``theta`` is relative
to: N = 18 + m for m measured channels, and three for each sensor's axes and position that may be
off. The members of ``x`` are those of :class:`Parts`, in this order; rows and columns of the
covariance are found by the offsets THETA to BIAS. Only the first 18 move.

alpha is a Matern process (or, with rate zero, an integrated Wiener process), the rate of a is a
Wiener process.
"""

import math
from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.acceleration_field.adaptation import factor
from imu_fusion.estimation.acceleration_field.params import AccelerationFieldParams
from imu_fusion.geometry.rotation import (
    quat_exp,
    quat_multiply,
    quat_normalize,
    quat_to_matrix,
    right_jacobian,
)
from imu_fusion.kernels import njit

# Where the members of Parts begin. theta, omega, alpha and jerk of an axis are a chain of
# integrators, as are acc and acc_rate.
THETA, OMEGA, ALPHA, JERK, ACC, ACC_RATE, BIAS = 0, 3, 6, 9, 12, 15, 18

# Gauss-Legendre rule on [0, 1]: exact for the degree that a chain of four integrators needs.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS


class Parts(NamedTuple):
    """Views of a mean, or of many (..., N): (..., 3) each, body axes."""

    theta: np.ndarray      # local attitude error, rad: q_true = quat * Exp(theta)
    omega: np.ndarray      # angular velocity, rad/s
    alpha: np.ndarray      # angular acceleration, rad/s^2
    jerk: np.ndarray       # its rate, rad/s^3
    acc: np.ndarray        # (specific force or) acceleration at the reference point, m/s^2
    acc_rate: np.ndarray   # its rate, m/s^3
    fixed: np.ndarray      # (..., N - 18) biases of the channels in their units, then mounting:
    #                        turns of axes, rad, and shifts of positions, m


class State(NamedTuple):
    """What the filter knows, changed in place."""

    x: np.ndarray      # (N,) mean, see Parts
    cov: np.ndarray    # (N, N)
    quat: np.ndarray   # (4,) world from body
    last: np.ndarray   # (1,) int64 ns, stamp of the last sample; negative before the first
    checks: np.ndarray   # (K,) CHECK of the accelerometers, see cross_check
    adaptation: np.ndarray   # (1,) ADAPTATION
    innovation: np.ndarray   # (m,) of the last sample, before it was used
    fitted: np.ndarray   # (m,) bool, channels whose fit is followed, see motion_watch
    error: np.ndarray    # (N, 3) of x, by errors of the first angular velocity, see wrong_start


class Step(NamedTuple):
    """The motion model over a step of ``dt`` (1,) s, see :func:`motion_step`; in place."""

    dt: np.ndarray
    chain: np.ndarray   # (4, 4)
    noise: np.ndarray   # (4, 4)


class Transition(NamedTuple):
    """The transition matrix F of the state, by what it consists of."""

    dt: float
    chain: np.ndarray   # (4, 4) of theta, omega, alpha and jerk of an axis
    turn: np.ndarray    # (3, 3) of theta: Exp(-phi)
    jac: np.ndarray     # (3, 3) right Jacobian of the rotation phi


@njit
def parts(x):
    """The :class:`Parts` of a mean (..., N)."""
    return Parts(x[..., THETA:OMEGA], x[..., OMEGA:ALPHA], x[..., ALPHA:JERK], x[..., JERK:ACC],
                 x[..., ACC:ACC_RATE], x[..., ACC_RATE:BIAS], x[..., BIAS:])


@njit
def _generate(v, rate):
    """Time derivative of the chain (angle, omega, alpha, jerk) v (4,), without noise."""
    return np.array([v[1], v[2], v[3], -rate * rate * v[2] - 2.0 * rate * v[3]])


@njit
def _propagate(v, rate, dt):
    """v (4,) after dt, by its Taylor series; for rate * dt up to one half."""
    total, term = v.copy(), v.copy()
    for k in range(1, 16):
        term = _generate(term, rate) * (dt / k)
        total = total + term
    return total


@njit
def motion_step(dt, rate):
    """Transition (4, 4) and unit-noise covariance (4, 4) of one axis over dt, exactly.

    The chain is angle, omega, alpha, jerk with ``jerk' = -rate^2 alpha - 2 rate jerk + noise``:
    alpha is a Matern process of smoothness 3/2; with rate 0 the jerk is a Wiener process. Short
    steps by quadrature, long ones by doubling them, so that any gap is fine.
    """
    doublings = 0
    while rate * dt > 0.5 * 2.0 ** doublings:
        doublings += 1
    h = dt / 2.0 ** doublings
    step = np.zeros((4, 4))
    for k in range(4):
        unit = np.zeros(4)
        unit[k] = 1.0
        step[:, k] = _propagate(unit, rate, h)
    noise = np.zeros((4, 4))
    for k in range(len(_NODES)):
        response = _propagate(np.array([0.0, 0.0, 0.0, 1.0]), rate, h * _NODES[k])
        noise += (h * _WEIGHTS[k]) * np.outer(response, response)
    for _ in range(doublings):
        noise = step @ noise @ step.T + noise
        step = step @ step
    return step, noise


def motion_spread(params: AccelerationFieldParams) -> np.ndarray:
    """Standard deviations (4,) of alpha, its rate, a and its rate where nothing is known of them:
    the processes of the model have run for a second. Wide, and free of a scale of its own."""
    _, noise = motion_step(1.0, params.motion.rate)
    jerk, acc = params.motion.jerk_density, params.motion.acceleration_rate_density
    return np.array([jerk * np.sqrt(noise[2, 2]), jerk * np.sqrt(noise[3, 3]),
                     acc + 10 * params.gravity, acc])


@njit
def mean_rotation(dt, chain, x):
    """Rotation vector (3,) over a step of the mean x, by the Magnus expansion to the fourth
    order (Iserles et al. 2000): the integral of the body rate and the commutator of its ends."""
    s = parts(x)
    integral = chain[0, 1] * s.omega + chain[0, 2] * s.alpha + chain[0, 3] * s.jerk
    last = s.omega + chain[1, 2] * s.alpha + chain[1, 3] * s.jerk
    return integral + (dt * dt / 12.0) * np.cross(s.omega, last)


@njit
def transition(dt, chain, phi):
    """The :class:`Transition` over a step that turns by the rotation vector phi (3,)."""
    return Transition(dt, chain, np.ascontiguousarray(quat_to_matrix(quat_exp(phi)).T),
                      right_jacobian(phi))


@njit
def multiply_transition(m, f):
    """m <- F m in place, m: (18 or more, c), f: Transition."""
    step, turn, jac = f.chain, f.turn, f.jac
    for c in range(m.shape[1]):
        t0, t1, t2 = m[THETA, c], m[THETA + 1, c], m[THETA + 2, c]
        d0 = (step[0, 1] * m[OMEGA, c] + step[0, 2] * m[ALPHA, c]
              + step[0, 3] * m[JERK, c])
        d1 = (step[0, 1] * m[OMEGA + 1, c] + step[0, 2] * m[ALPHA + 1, c]
              + step[0, 3] * m[JERK + 1, c])
        d2 = (step[0, 1] * m[OMEGA + 2, c] + step[0, 2] * m[ALPHA + 2, c]
              + step[0, 3] * m[JERK + 2, c])
        for i in range(3):
            m[THETA + i, c] = (turn[i, 0] * t0 + turn[i, 1] * t1 + turn[i, 2] * t2
                               + jac[i, 0] * d0 + jac[i, 1] * d1 + jac[i, 2] * d2)
            alpha, jerk = m[ALPHA + i, c], m[JERK + i, c]
            m[OMEGA + i, c] += step[1, 2] * alpha + step[1, 3] * jerk
            m[ALPHA + i, c] = step[2, 2] * alpha + step[2, 3] * jerk
            m[JERK + i, c] = step[3, 2] * alpha + step[3, 3] * jerk
            m[ACC + i, c] += f.dt * m[ACC_RATE + i, c]


@njit
def multiply_transition_transposed(m, f):
    """m <- F' m in place, m: (18 or more, c), f: Transition."""
    step, turn, jac = f.chain, f.turn, f.jac
    for c in range(m.shape[1]):
        t0, t1, t2 = m[THETA, c], m[THETA + 1, c], m[THETA + 2, c]
        for i in range(3):
            d = jac[0, i] * t0 + jac[1, i] * t1 + jac[2, i] * t2
            omega, alpha, jerk = m[OMEGA + i, c], m[ALPHA + i, c], m[JERK + i, c]
            m[THETA + i, c] = turn[0, i] * t0 + turn[1, i] * t1 + turn[2, i] * t2
            m[OMEGA + i, c] = omega + step[0, 1] * d
            m[ALPHA + i, c] = (step[0, 2] * d + step[1, 2] * omega + step[2, 2] * alpha
                               + step[3, 2] * jerk)
            m[JERK + i, c] = (step[0, 3] * d + step[1, 3] * omega + step[2, 3] * alpha
                              + step[3, 3] * jerk)
            m[ACC_RATE + i, c] += f.dt * m[ACC + i, c]


@njit
def predict(state, p, channels, step):
    """Move the State on by a Step, in place; returns the mean rotation (3,).

    p: record of the parameters, channels: (m,) CHANNEL.
    """
    x, cov = state.x, state.cov
    chain, dt = step.chain, step.dt[0]
    phi = mean_rotation(dt, chain, x)
    f = transition(dt, chain, phi)
    state.quat[:] = quat_normalize(quat_multiply(state.quat, quat_exp(phi)))
    for i in range(3):
        alpha, jerk = x[ALPHA + i], x[JERK + i]
        x[OMEGA + i] += chain[1, 2] * alpha + chain[1, 3] * jerk
        x[ALPHA + i] = chain[2, 2] * alpha + chain[2, 3] * jerk
        x[JERK + i] = chain[3, 2] * alpha + chain[3, 3] * jerk
        x[ACC + i] += dt * x[ACC_RATE + i]
    multiply_transition(cov, f)
    half = np.ascontiguousarray(cov[:BIAS, :BIAS].T)
    multiply_transition(half, f)
    put_symmetric(cov, half)
    add_motion_noise(cov, p, step, factor(state.adaptation[0].motion))
    for c in range(len(channels)):
        walk = channels[c].bias_walk
        cov[BIAS + c, BIAS + c] += walk * walk * dt
    return phi


@njit
def put_symmetric(cov, moving):
    """Complete a covariance (N, N) whose first 18 rows have been multiplied from the left: its
    first block is ``moving`` (18, 18) but for rounding, its columns are its rows. In place."""
    for i in range(BIAS):
        for j in range(i, BIAS):
            mean = 0.5 * (moving[i, j] + moving[j, i])
            cov[i, j] = mean
            cov[j, i] = mean
    for i in range(BIAS, len(cov)):
        for j in range(BIAS):
            cov[i, j] = cov[j, i]


@njit
def add_motion_noise(cov, p, step, wildness):
    """Add what the white noises of the motion do in a Step to the covariance, ``wildness`` times,
    in place."""
    dt = step.dt[0]
    jerk = wildness * p.motion.jerk_density * p.motion.jerk_density
    q = wildness * p.motion.acceleration_rate_density * p.motion.acceleration_rate_density
    for i in range(3):
        for k in range(4):
            for j in range(4):
                cov[THETA + 3 * k + i, THETA + 3 * j + i] += jerk * step.noise[k, j]
        cov[ACC + i, ACC + i] += q * dt ** 3 / 3.0
        cov[ACC + i, ACC_RATE + i] += 0.5 * q * dt * dt
        cov[ACC_RATE + i, ACC + i] += 0.5 * q * dt * dt
        cov[ACC_RATE + i, ACC_RATE + i] += q * dt


@njit
def gap_variance(omega, dt):
    """Variances (attitude, omega) that a gap adds: the body may have stopped or turned twice as
    fast, and turned to anywhere."""
    speed2 = omega[0] ** 2 + omega[1] ** 2 + omega[2] ** 2
    return min(speed2 * dt * dt, math.pi * math.pi), speed2


@njit
def reopen(x, cov, dt, spread):
    """After a gap: omega and attitude are held, wider by :func:`gap_variance`; accelerations and
    their rates are as unknown as at the start, with standard deviations ``spread`` (4,) of
    alpha, its rate, a and its rate; biases and mounting stay. In place."""
    turned, speed2 = gap_variance(x[OMEGA:ALPHA], dt)
    kept = cov[OMEGA:ALPHA, OMEGA:ALPHA].copy()
    cov[OMEGA:BIAS, :] = 0.0
    cov[:, OMEGA:BIAS] = 0.0
    cov[OMEGA:ALPHA, OMEGA:ALPHA] = kept
    for i in range(3):
        cov[THETA + i, THETA + i] += turned
        cov[OMEGA + i, OMEGA + i] += speed2
        for k in range(4):
            x[ALPHA + 3 * k + i] = 0.0
            cov[ALPHA + 3 * k + i, ALPHA + 3 * k + i] = spread[k] * spread[k]
