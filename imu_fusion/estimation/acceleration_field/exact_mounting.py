"""Is the mounting exact? A hypothesis within the filter that knows how far off it may be (numba).

A filter with states of the mounting lets noise into them: of a rig that is as described it knows
less than one without. That one need not be run: its mean is that of the first filter, given that
these states are zero, and how much likelier it makes the readings is by how much their density at
zero has grown (Savage-Dickey ratio: Verdinelli and Wasserman 1995). Each counts as that says
(Magill 1965). What is stated is about the first filter's mean all the same: that all sensors are
turned or scaled alike no reading refutes.
"""

import math
from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.acceleration_field.motion_model import BIAS
from imu_fusion.estimation.acceleration_field.sensor_array import SensorArray
from imu_fusion.kernels import njit

_REFUTED = -50.0   # log odds that readings do not make up for: nobody asks any more
#: Of the variances of mounting, that "zero" may be off: what they have in common is known exactly.
_NEARLY = 1e-6
#: Squares of sds, by which the mean moves before it is asked again, and share of the variances.
_MOVED, _LEARNT = 0.03, 0.05


class Exact(NamedTuple):
    """What is known of the hypothesis, changed in place; k states of mounting."""

    allowed: np.ndarray   # (k,) variances that count as zero
    log_det: np.ndarray   # (1,) log determinant of their covariance before the first sample
    odds: np.ndarray      # (1,) log of how much likelier it is than that the mounting is off; -inf
    #                       where it is refuted, or nobody asks
    pull: np.ndarray      # (k,) the mean, by the inverse of its covariance
    asked: np.ndarray     # (k + 1,) the mean when it was last asked, and the variances' sum, in sds
    work: np.ndarray      # (k, k + 1)


def make_exact(array: SensorArray, asks: bool = True) -> Exact:
    """The :class:`Exact` of an array with states of its mounting, before the first sample."""
    known = array.mounting_covariance()
    allowed = _NEARLY * np.diag(known)
    k = len(allowed)
    log_det = np.linalg.slogdet(known + np.diag(allowed))[1]
    return Exact(allowed, np.full(1, log_det), np.full(1, 0.0 if asks and k else -np.inf),
                 np.zeros(k), np.full(k + 1, np.inf), np.zeros((k, k + 1)))


@njit
def ask(exact, x, cov):
    """Bring odds and pull of the Exact up to date, by the mean and the covariance of a state that
    has learnt of its mounting; in place."""
    if not exact.odds[0] > -math.inf:
        return
    a, z, k = exact.work, exact.pull, len(exact.pull)
    first = len(x) - k
    moved, known = 0.0, 0.0
    for i in range(k):
        moved += (x[first + i] - exact.asked[i]) ** 2 / exact.allowed[i]
        known += cov[first + i, first + i] / exact.allowed[i]
    if _NEARLY * moved < _MOVED and abs(known - exact.asked[k]) < _LEARNT * known:
        return
    exact.asked[:k], exact.asked[k] = x[first:], known
    for i in range(k):
        for j in range(i, k):
            a[i, j] = cov[first + i, first + j]
        a[i, i] += exact.allowed[i]
        a[i, k] = x[first + i]
    log_det, squares = 0.0, 0.0
    for i in range(k):
        # Rounding must not make it negative.
        pivot = max(a[i, i], exact.allowed[i])
        a[i, i] = pivot
        log_det += math.log(pivot)
        squares += a[i, k] * a[i, k] / pivot
        for j in range(i + 1, k):
            share = a[i, j] / pivot
            row, of = a[j], a[i]
            for c in range(j, k + 1):
                row[c] -= share * of[c]
    for i in range(k - 1, -1, -1):
        left = a[i, k]
        for j in range(i + 1, k):
            left -= a[i, j] * z[j]
        z[i] = left / a[i, i]
    exact.odds[0] = 0.5 * (exact.log_det[0] - log_det - squares)
    if exact.odds[0] < _REFUTED:
        exact.odds[0] = -math.inf


@njit
def share(exact):
    """What the hypothesis counts, of one."""
    return 1.0 / (1.0 + math.exp(-exact.odds[0])) if exact.odds[0] > _REFUTED else 0.0


@njit
def change_of(exact, cov):
    """How the mean of the first states (18,) changes by the hypothesis; cov (N, N)."""
    first = len(cov) - len(exact.pull)
    change = np.zeros(BIAS)
    for k in range(len(exact.pull)):
        row, pull = cov[first + k], exact.pull[k]
        for i in range(BIAS):
            change[i] -= row[i] * pull
    return change
