"""Where an acceleration field starts: given, or found while the body is still."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.estimation.acceleration_field.adaptation import ADAPTATION
from imu_fusion.estimation.acceleration_field.cross_check import (
    CHECK,
    cross_check,
    make_workspace,
)
from imu_fusion.estimation.acceleration_field.kernel_params import kernel_params
from imu_fusion.estimation.acceleration_field.measurement import linearise
from imu_fusion.estimation.acceleration_field.motion_model import (
    ACC,
    ACC_RATE,
    ALPHA,
    BIAS,
    OMEGA,
    THETA,
    State,
    motion_spread,
    parts,
)
from imu_fusion.estimation.acceleration_field.params import AccelerationFieldParams
from imu_fusion.estimation.acceleration_field.sensor_array import SensorArray
from imu_fusion.geometry.rotation import skew

# How well the still body's kinematic acceleration is known to be zero, m/s^2.
_STILL_SD = 1e-3
_LARGEST_BIAS = 0.35    # rad/s (20 deg/s): no gyroscope has more
_SWAY = 0.15            # rad/s from the first half to the last: a hand does not sway faster
_STRANGE = 0.2          # of gravity, that scales and a calibration may miss it by
_SURELY = 4.0           # standard deviations
_UNNOTICED = 3.0        # standard deviations of the square of a rate that is not refuted


class Start(NamedTuple):
    """The state before the first sample, see :mod:`.motion_model`."""

    x: np.ndarray      # (N,)
    cov: np.ndarray    # (N, N)
    quat: np.ndarray   # (4,) world from body
    about: np.ndarray  # (3,) rad/s: the largest turn, in body axes, that a body taken for still may
    #                    make unnoticed; 0 where none was


def given_start(params: AccelerationFieldParams, array: SensorArray) -> Start:
    """Start from ``initial.orientation`` and ``initial.angular_velocity``; the accelerations are
    unknown and become known with the first sample."""
    initial = params.initial
    mounting = array.mounting_covariance()
    moving = BIAS + len(array.channels)
    x = np.zeros(moving + len(mounting))
    parts(x).omega[:] = initial.angular_velocity
    sd = np.concatenate([
        np.full(3, initial.orientation_sd), np.full(3, initial.angular_velocity_sd),
        np.repeat(motion_spread(params), 3), array.channels["bias_sd"]])
    cov = np.zeros((len(x), len(x)))
    cov[:moving, :moving] = np.diag(sd ** 2)
    cov[moving:, moving:] = mounting
    return Start(x, cov, normalized(initial.orientation), np.zeros(3))


def rest_start(params: AccelerationFieldParams, array: SensorArray,
               readings: np.ndarray) -> Start:
    """Start from the readings (n, m) of a still body: tilt, zero rate, biases.

    The heading is that of ``initial.orientation``, with no uncertainty: the world is named by
    it. For accelerometers that report coordinate acceleration the whole orientation is given.
    The part of the biases that cannot be told from the tilt stays uncertain, correlated with it.
    """
    channels = array.channels
    x, cov, quat, about = given_start(params, array)
    parts(x).omega[:] = 0.0
    still = np.r_[THETA:OMEGA, ALPHA:ACC, ACC_RATE:BIAS]
    cov[still, :] = 0.0
    cov[:, still] = 0.0
    seen = np.isfinite(readings)
    number = seen.sum(axis=0)
    with np.errstate(invalid="ignore"):
        mean = np.where(seen, readings, 0.0).sum(axis=0) / number
    use = _agreeing(params, array, Start(x, cov, quat, about), mean)
    rows = _still_rows(array, mean, use, len(x))
    variance = ((params.noise_scale * channels["density"][use]) ** 2 * params.sample_rate
                / number[use])
    if array.specific_force and not np.any(channels["is_gyro"] & use):
        about = _unnoticed(channels[use], rows[use], mean[use], cov, variance)
    x, cov = _update(x, cov, rows[use], mean[use], np.diag(variance))
    constraint = np.zeros((3, len(x)))
    constraint[:, ACC:ACC_RATE] = np.eye(3)
    target = np.zeros(3)
    if array.specific_force:
        acc = parts(x).acc
        up = acc / np.linalg.norm(acc)
        quat = _level(up, quat)
        target = params.gravity * up
        # Tilt unknown to a radian, heading known.
        cov[THETA:OMEGA, THETA:OMEGA] = np.eye(3) - np.outer(up, up)
        constraint[:, THETA:OMEGA] = -skew(target)
    x, cov = _update(x, cov, constraint, target, np.eye(3) * _STILL_SD ** 2)
    return folded(x, cov, quat, about)


def _unnoticed(channels, rows, mean, cov, variance):
    """The largest turn (3,) rad/s about the vertical, in body axes, that does not contradict what
    the CHANNELs (m,) of a still body measure: ``mean`` (m,), by ``rows`` of a state of mean 0."""
    force = np.linalg.lstsq(channels["direction"], mean, rcond=None)[0]
    up = force / np.linalg.norm(force)
    inward = np.cross(up, np.cross(up, channels["lever"]))
    inward = np.sum(channels["direction"] * inward, axis=1)
    weighed = np.linalg.lstsq(rows @ cov @ rows.T + np.diag(variance),
                              np.column_stack([inward, mean]), rcond=1e-13)[0]
    information, pull = inward @ weighed
    if information <= 0.0:
        return np.zeros(3)
    square = max(pull / information, 0.0) + _UNNOTICED / np.sqrt(information)
    return np.sqrt(square) * up


def folded(x: np.ndarray, cov: np.ndarray, quat: np.ndarray, about: np.ndarray) -> Start:
    """A Start whose theta is in its quaternion."""
    turn = scipy.spatial.transform.Rotation.from_rotvec(parts(x).theta)
    quat = (scipy.spatial.transform.Rotation.from_quat(quat) * turn).as_quat()
    parts(x).theta[:] = 0.0
    return Start(x, cov, quat, about)


def _agreeing(params, array, start, mean):
    """Mask (m,) of the channels whose mean readings do not contradict the others."""
    work = make_workspace(array.channels)
    state = State(start.x, start.cov, start.quat, np.array([-1], dtype=np.int64),
                  np.zeros(array.accelerometers, CHECK), np.zeros(1, ADAPTATION),
                  np.zeros(len(array.channels)), np.zeros(len(array.channels), bool),
                  np.zeros((len(start.x), 3)))
    linearise(array.channels, start.x, work)
    cross_check(state, kernel_params(params, array)[0], array.channels, mean, start.x, work)
    return work.use


def _still_rows(array, mean, use, size):
    """What the channels of a still body measure, linearised: (m, N)."""
    channels = array.channels
    m = len(channels)
    rows = np.zeros((m, size))
    rows[:, BIAS:BIAS + m] = np.eye(m)
    gyro = channels["is_gyro"]
    felt = channels[~gyro]
    rows[~gyro, ACC:ACC_RATE] = felt["direction"]
    rows[~gyro, ALPHA:ALPHA + 3] = np.cross(felt["lever"], felt["direction"])
    rows[gyro, OMEGA:ALPHA] = channels["direction"][gyro]
    known = use & ~gyro
    force = np.linalg.lstsq(channels["direction"][known], mean[known], rcond=None)[0]
    for row, channel in zip(rows, channels):
        if channel["turn"] >= 0 and not channel["is_gyro"]:
            row[channel["turn"]:channel["turn"] + 3] = np.cross(channel["direction"], force)
        if channel["scale"] >= 0 and not channel["is_gyro"]:
            row[channel["scale"]] = channel["direction"] @ force
    return rows


def is_still(params: AccelerationFieldParams, array: SensorArray, readings: np.ndarray) -> bool:
    """Whether a body is still by its ``readings`` (n, m) of ``initial.duration``.

    Every channel varies by less than ``initial.still_sd`` (accelerometers) or
    ``initial.angular_velocity_sd`` (gyroscope) beyond its noise, and so do the means of its halves:
    a slow turn goes under in strong noise, but not in these. No gyroscope reports more than a bias
    may be; what all accelerometers have in common does not turn, and is about as large as gravity.
    A steady turn about the vertical feels the same: only a gyroscope, or a fast one, tells it.
    """
    channels = array.channels
    seen = np.where(np.isfinite(readings), readings, np.nan)
    use = np.isfinite(seen).sum(axis=0) > 1
    if not np.any(use):
        return False
    noise = params.noise_scale * channels["density"] * np.sqrt(params.sample_rate)
    is_gyro = channels["is_gyro"]
    still = np.where(is_gyro, params.initial.angular_velocity_sd, params.initial.still_sd)
    if not np.all(np.nanstd(seen[:, use], axis=0) < (still + 2 * noise)[use]):
        return False
    first, last = (np.nansum(half, axis=0) / np.maximum(np.isfinite(half).sum(axis=0), 1)
                   for half in np.array_split(seen[:, use], 2))
    chance = 4.0 * noise * np.sqrt(4.0 / len(readings))
    if not np.all(np.abs(last - first) < (2 * still + chance)[use]):
        return False
    if np.any(np.isposinf(readings[:, is_gyro])):    # at its range
        return False
    rates = use & is_gyro
    largest = np.maximum(_LARGEST_BIAS, _SURELY * channels["bias_sd"])
    if np.any(np.abs(np.nanmean(seen[:, rates], axis=0)) > largest[rates]):
        return False
    return not array.specific_force or params.gravity == 0.0 or _feels_gravity_alone(
        params, channels, noise, np.nanmean(seen, axis=0), use, last - first, len(readings))


def _feels_gravity_alone(params, channels, noise, mean, use, moved, samples):
    """Whether what most tri-axial accelerometers feel stands still and is about gravity, by the
    ``mean`` (m,) of the channels in ``use`` (m,), and what those have ``moved`` by."""
    change = np.zeros(len(use))
    change[use] = moved
    forces, turns = [], []
    for sensor in np.unique(channels["sensor"][~channels["is_gyro"]]):
        own = (channels["sensor"] == sensor) & use
        if own.sum() == 3:
            forces.append(np.linalg.norm(mean[own]))
            turns.append(np.linalg.norm(change[own]))
    if not forces:
        return True
    felt = ~channels["is_gyro"]
    chance = np.median(noise[felt]) * np.sqrt(3.0 * 4.0 / samples)
    bias = np.median(channels["bias_sd"][felt])
    return bool(np.median(turns) < params.gravity * _SWAY * 0.5 * params.initial.duration
                + _SURELY * chance
                and abs(np.median(forces) - params.gravity)
                < _STRANGE * params.gravity + _SURELY * bias)


def normalized(quat: Sequence[float]) -> np.ndarray:
    """A quaternion (4,) scaled to unit length."""
    values = np.asarray(quat, dtype=float)
    return values / np.linalg.norm(values)


def _level(up, quat):
    """The orientation nearest to ``quat`` in which the body direction ``up`` points up."""
    pointing = scipy.spatial.transform.Rotation.from_quat(quat).apply(up)
    axis = np.cross(pointing, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    # Upside down, every horizontal axis is as near as any other.
    axis = axis / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
    turn = scipy.spatial.transform.Rotation.from_rotvec(axis * np.arctan2(sine, pointing[2]))
    return (turn * scipy.spatial.transform.Rotation.from_quat(quat)).as_quat()


def _update(x, cov, rows, reading, noise):
    total = rows @ cov @ rows.T + noise
    # Least squares, since precise sensors without biases make the total singular in float64.
    gain = np.linalg.lstsq(total, rows @ cov, rcond=1e-13)[0].T
    x = x + gain @ (reading - rows @ x)
    reduce = np.eye(len(x)) - gain @ rows
    return x, reduce @ cov @ reduce.T + gain @ noise @ gain.T
