"""Calibration of a gyroscope from turns between rests.

Winkler 2025 (appendix A.3) turns it at known rates by a robot. A turn at a known rate for a known
time is one by a known angle, and by hand anybody can make one: once round on a table. Gravity as
the (calibrated) accelerometer feels it before and after says more: integrated rates must carry the
one into the other (Tedaldi, Pretto, Menegatti 2014), which shows the axes, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.errors import CalibrationError
from imu_fusion.geometry.rotation import quat_exp, quat_multiply
from imu_fusion.kernels import njit
from imu_fusion.sensors.linear_calibration import LinearCalibration, condition_of, covariance
from imu_fusion.sensors.magnetometer_calibration import coverage

_FEWEST_TURNS = 6
_LEAST_ANGLE = np.radians(20.0)     # a turn by less says little
_WORST_CONDITION = 1e3
_CONTRADICTS = np.radians(4.0)      # what turns may leave unexplained, RMS
_BY_HAND = np.radians(0.3)          # least standard deviation of what closes a turn


@dataclass(frozen=True, eq=False)
class Turn:
    """Between two rests: ``rate`` (n, 3) rad/s at ``time`` (n,) s; ``before``, ``after`` (3,):
    specific force at rest there, m/s^2."""

    time: np.ndarray
    rate: np.ndarray
    before: np.ndarray
    after: np.ndarray


def calibrate_gyroscope(turns: Sequence[Turn], offset: np.ndarray, offset_sd: np.ndarray,
                        angle: float | None = None) -> LinearCalibration:
    """Calibrate from turns about different axes.

    Args:
        turns: each between two rests. offset, offset_sd: (3,) rad/s, mean rate at rest and its
            standard deviation.
        angle: rad, by which every turn went, about one axis; None: not known. Gravity alone does
            not show the scale of an axis that was vertical in every turn about it.

    Raises:
        CalibrationError: too few turns, or turns that leave a parameter undetermined, or that no
            linear sensor can have measured.
    """
    turns = [t for t in turns if np.linalg.norm(_sum(t, offset)) > _LEAST_ANGLE]
    if len(turns) < _FEWEST_TURNS:
        raise CalibrationError(f"gyroscope: {len(turns)} turns by more than 20 deg between rests; "
                               f"at least {_FEWEST_TURNS} about different axes are needed")

    def residual(p):
        matrix = p.reshape(3, 3)
        return np.concatenate([_misses(t, matrix, offset, angle) for t in turns])

    fit = scipy.optimize.least_squares(residual, np.eye(3).ravel(), loss="soft_l1", f_scale=0.02)
    condition = condition_of(fit.jac)
    if not condition < _WORST_CONDITION:
        raise CalibrationError(
            f"gyroscope: the turns do not determine it (condition number {condition:.2g}): turn it "
            "about all axes, some of them not vertical, and not by whole turns alone")
    matrix = fit.x.reshape(3, 3)
    each = np.array([np.linalg.norm(_misses(t, matrix, offset, angle)) for t in turns])
    rms = float(np.sqrt(np.mean(each ** 2)))
    if rms > _CONTRADICTS:
        raise CalibrationError(
            f"gyroscope: the turns contradict gravity{'' if angle is None else ' or their angle'} "
            f"by {np.degrees(rms):.1f} deg (RMS) after the calibration: a clipped or lost part, "
            "another unit than rad/s, or turns by another angle")
    cov = np.zeros((12, 12))
    cov[:9, :9] = covariance(fit.jac, fit.fun, _BY_HAND)
    to_bias = -np.kron(np.eye(3), offset)        # b = -A offset
    cov[9:, 9:] = (to_bias @ cov[:9, :9] @ to_bias.T
                   + matrix @ np.diag(np.square(offset_sd)) @ matrix.T)
    cov[9:, :9] = to_bias @ cov[:9, :9]
    cov[:9, 9:] = cov[9:, :9].T
    axes = np.array([_sum(t, offset) for t in turns])
    return LinearCalibration(
        matrix, -matrix @ offset, cov, np.degrees(each), "deg",
        f"{len(turns)} turns between rests, gravity"
        + ("" if angle is None else f" and an angle of {np.degrees(angle):g} deg"),
        coverage(axes / np.linalg.norm(axes, axis=1, keepdims=True)), condition)


def _sum(turn, offset):
    """Integral (3,) of the rates, rad: the angle, where the axis stands still."""
    return scipy.integrate.trapezoid(turn.rate - offset, turn.time, axis=0)


def _misses(turn, matrix, offset, angle):
    """What a turn leaves unexplained, rad: (3,) of gravity's direction, and the angle's."""
    rate = (turn.rate - offset) @ matrix.T
    quat = _turned(0.5 * (rate[1:] + rate[:-1]), np.diff(turn.time))
    after = scipy.spatial.transform.Rotation.from_quat(quat).apply(
        turn.after / np.linalg.norm(turn.after))
    missed = after - turn.before / np.linalg.norm(turn.before)
    if angle is None:
        return missed
    return np.append(missed, np.linalg.norm(matrix @ _sum(turn, offset)) - angle)


@njit
def _turned(rate, dt):
    """Quaternion (4,) of the attitude after rates (n, 3) over steps (n,), in the axes before."""
    quat = (0.0, 0.0, 0.0, 1.0)
    for i in range(len(dt)):
        quat = quat_multiply(quat, quat_exp(rate[i], dt[i]))
    return np.array(quat)
