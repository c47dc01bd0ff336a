"""Is the mounting exact? A hypothesis beside the filter that knows how far off it may be (numba).

A filter with states of the mounting lets noise into them: of a rig that is as described it knows
less than one without. So a second filter without these states runs beside it, until the readings
refute it, and each counts as its likelihood says (Magill 1965). What is stated is about the first
filter's mean all the same: that all sensors are turned or scaled alike no reading refutes.
"""

import math
from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.acceleration_field.motion_model import BIAS, State
from imu_fusion.estimation.acceleration_field.sensor_array import SensorArray
from imu_fusion.estimation.acceleration_field.start import Start, folded
from imu_fusion.geometry.rotation import (
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_normalize,
)
from imu_fusion.kernels import njit

_SURE = 10.0          # log odds beyond which a hypothesis is refuted, and none grows
_CONTRADICTED = 12.5  # of it, where it leaves out what the other can explain: five sigma
#: Variances of mounting below which it is not known, of the largest.
_RANK = 1e-9


class Exact(NamedTuple):
    """The second filter; ``odds`` (1,) the log of how much likelier it is than the first, -inf
    where it is refuted or nobody asks."""

    state: State
    channels: np.ndarray   # (m,) CHANNEL
    odds: np.ndarray


def exact_start(start: Start, array: SensorArray) -> Start:
    """The Start of an array whose mounting is exact: ``start`` given that its states are zero."""
    moving = BIAS + len(array.channels)
    x, cov = start.x, start.cov
    known = np.linalg.pinv(cov[moving:, moving:], rcond=_RANK, hermitian=True)
    gain = known @ cov[moving:, :moving]
    return folded(x[:moving] - x[moving:] @ gain,
                  cov[:moving, :moving] - cov[:moving, moving:] @ gain, start.quat)


@njit
def weigh(odds, likelihood, exact_likelihood, use, exact_use):
    """Take one sample into the odds (1,), in place: log likelihoods, and which channels (m,) bool
    either filter used."""
    change = exact_likelihood - likelihood
    for c in range(len(use)):
        if use[c] != exact_use[c]:
            change = -_CONTRADICTED
    odds[0] = min(odds[0] + change, _SURE)
    if not odds[0] > -_SURE:
        odds[0] = -math.inf


@njit
def share(odds):
    """What the second filter counts, of one."""
    return 1.0 / (1.0 + math.exp(-odds)) if odds > -_SURE else 0.0


@njit
def blend(row, other, part):
    """Move a ROW towards that of the second filter, by a part of their difference, in place; that
    much further its mean may be off."""
    turn = quat_log(quat_multiply(quat_conjugate(row.quat), other.quat))
    row.quat[:] = quat_normalize(quat_multiply(row.quat, quat_exp(turn, part)))
    _widen(row.cov_attitude, turn, part)
    _move(row.omega, row.cov_omega, other.omega, part)
    _move(row.alpha, row.cov_alpha, other.alpha, part)
    _move(row.specific_force, row.cov_specific_force, other.specific_force, part)
    _move(row.acceleration_world, row.cov_acceleration_world, other.acceleration_world, part)
    for i in range(3):
        for j in range(3):
            row.gradient[i, j] += part * (other.gradient[i, j] - row.gradient[i, j])


@njit
def _move(mean, cov, other, part):
    change = other - mean
    _widen(cov, change, part)
    mean += part * change


@njit
def _widen(cov, change, part):
    for i in range(3):
        for j in range(3):
            cov[i, j] += part * part * change[i] * change[j]


@njit
def blend_rows(rows, others, part):
    """:func:`blend` of rows (n,) with others (n,), in place."""
    for n in range(len(rows)):
        blend(rows[n], others[n], part)
