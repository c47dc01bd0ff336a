"""Where an acceleration field starts: given, or found while the body is still.

A start is the mean x (18 + m,), the covariance and the quaternion of the state that
:mod:`imu_fusion.estimation.acceleration_field.kernel` describes.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.acceleration_field.kernel import (ACC, ALPHA, BIAS, OMEGA,
                                                             motion_step)
from imu_fusion.geometry.rotation import skew

# How well the still body's kinematic acceleration is known to be zero, m/s^2.
_STILL_SD = 1e-3


def given_start(params, layout):
    """Start from ``initial.orientation`` and ``initial.angular_velocity``; the accelerations are
    unknown and become known with the first sample. Returns (x, cov, quat)."""
    m = len(layout.density)
    x = np.zeros(BIAS + m)
    x[OMEGA:OMEGA + 3] = params.initial__angular_velocity
    sd = np.concatenate([
        np.full(3, params.initial__orientation_sd), np.full(3, params.initial__angular_velocity_sd),
        np.repeat(motion_spread(params), 3), layout.bias_sd])
    return x, np.diag(sd ** 2), normalized(params.initial__orientation)


def motion_spread(params):
    """Standard deviations (4,) of alpha, its rate, a and its rate where nothing is known of them:
    the processes of the model have run for a second. Wide, and free of a scale of its own."""
    _, noise = motion_step(1.0, params.motion__rate)
    jerk, acc = params.motion__jerk_density, params.motion__acceleration_rate_density
    return np.array([jerk * np.sqrt(noise[2, 2]), jerk * np.sqrt(noise[3, 3]),
                     acc + 10 * params.gravity, acc])


def rest_start(params, layout, readings):
    """Start from the readings (n, m) of a still body: tilt, zero rate, biases.

    The heading is that of ``initial.orientation``, with no uncertainty: the world is named by
    it. For accelerometers that report coordinate acceleration the whole orientation is given.
    Returns (x, cov, quat); the part of the biases that cannot be told from the tilt stays
    uncertain, correlated with it.
    """
    m = len(layout.density)
    x, cov, quat = given_start(params, layout)
    x[OMEGA:OMEGA + 3] = 0.0
    still = np.r_[0:OMEGA, ALPHA:ACC, ACC + 3:BIAS]
    cov[still, :] = 0.0
    cov[:, still] = 0.0
    seen = np.isfinite(readings) & (np.abs(readings) < layout.range)
    number = seen.sum(axis=0)
    use = number > 0
    mean = np.where(seen, readings, 0.0).sum(axis=0)[use] / number[use]
    rows = np.zeros((m, BIAS + m))
    rows[:, BIAS:] = np.eye(m)
    acc = ~layout.is_gyro
    rows[acc, ACC:ACC + 3] = layout.direction[acc]
    rows[acc, ALPHA:ALPHA + 3] = np.cross(layout.lever[acc], layout.direction[acc])
    rows[layout.is_gyro, OMEGA:OMEGA + 3] = layout.direction[layout.is_gyro]
    variance = ((params.noise_scale * layout.density[use]) ** 2 * params.sample_rate
                / number[use])
    x, cov = _update(x, cov, rows[use], mean, np.diag(variance))
    constraint = np.zeros((3, BIAS + m))
    constraint[:, ACC:ACC + 3] = np.eye(3)
    target = np.zeros(3)
    if layout.specific_force:
        up = x[ACC:ACC + 3] / np.linalg.norm(x[ACC:ACC + 3])
        quat = _level(up, quat)
        target = params.gravity * up
        # Tilt unknown to a radian, heading known.
        cov[:3, :3] = np.eye(3) - np.outer(up, up)
        constraint[:, :3] = -skew(target)
    x, cov = _update(x, cov, constraint, target, np.eye(3) * _STILL_SD ** 2)
    quat = (Rotation.from_quat(quat) * Rotation.from_rotvec(x[:3])).as_quat()
    x[:3] = 0.0
    return x, cov, quat


def is_still(params, layout, readings):
    """Whether every channel of ``readings`` (n, m) varies by less than ``initial.still_sd``
    (accelerometers) or ``initial.angular_velocity_sd`` plus noise (gyroscope)."""
    seen = np.where(np.abs(readings) < layout.range, readings, np.nan)
    use = np.isfinite(seen).sum(axis=0) > 1
    if not np.any(use):
        return False
    noise = params.noise_scale * layout.density * np.sqrt(params.sample_rate)
    limit = np.where(layout.is_gyro, params.initial__angular_velocity_sd,
                     params.initial__still_sd) + 2 * noise
    return bool(np.all(np.nanstd(seen[:, use], axis=0) < limit[use]))


def normalized(quat):
    """A quaternion (4,) scaled to unit length."""
    quat = np.asarray(quat, dtype=float)
    return quat / np.linalg.norm(quat)


def _level(up, quat):
    """The orientation nearest to ``quat`` in which the body direction ``up`` points up."""
    pointing = Rotation.from_quat(quat).apply(up)
    axis = np.cross(pointing, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    # Upside down, every horizontal axis is as near as any other.
    axis = axis / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
    turn = Rotation.from_rotvec(axis * np.arctan2(sine, pointing[2]))
    return (turn * Rotation.from_quat(quat)).as_quat()


def _update(x, cov, rows, reading, noise):
    total = rows @ cov @ rows.T + noise
    # Least squares, since precise sensors without biases make the total singular in float64.
    gain = np.linalg.lstsq(total, rows @ cov, rcond=1e-13)[0].T
    x = x + gain @ (reading - rows @ x)
    reduce = np.eye(len(x)) - gain @ rows
    return x, reduce @ cov @ reduce.T + gain @ noise @ gain.T
