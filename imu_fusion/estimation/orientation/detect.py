"""What the fusion filter detects: gyroscope axes at their limit, and rest."""

import math

import numpy as np
from imu_fusion.kernels import njit

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation import state as st
from imu_fusion.estimation.orientation.fusion_layout import (
    CHANGE, COV, ENTRY, HELD, HELD_RATE, HELD_STEP, K_SIZE, LARGEST, LIMIT, MEAN_FORCE,
    MEAN_RATE, N, P_REST_FORCE, P_REST_RATE, P_REST_TIME, REPEATED, REPEATS, REST_SINCE, S, X_SIZE)
from imu_fusion.sensors.saturation import LIMIT_TOLERANCE

REST_MEMORY = 0.25        # s, of the means that the rest detector compares with
_REST_TURN = 1.5e-3         # rad/s per axis: slower turning than 0.5 deg/s passes as rest
_REPEATS_AT_LIMIT = 4      # equal largest values in a row that make a flat top
_ENTRY_SHARE = 2e-3        # a flat top is run into; a quantised smooth peak is not
_LIMIT_FLOOR = 1.0         # rad/s: no gyroscope has a smaller range
_SPIKE = 10.0              # rad/s within a sample: more than a tap on the sensor (7 were seen)
_SPIKE_CHANGES = 20.0      # times the usual change that makes a rate suspect
_SPIKE_MEMORY = 1.0        # s, over which changes are usual
_SPIKE_STEP = 0.05         # s: between slower samples anything can happen


def start_limits(x, par):
    """Limits that were given; those to be found are infinite until then."""
    given = par[st.P_RANGE:st.P_RANGE + 3]
    x[LIMIT:LIMIT + 3] = np.where(np.isnan(given), np.inf, given)


@njit
def find_limits(x, k, par, gyr):
    """Learn each axis' limit from flat tops, unless given; mark the axes at theirs."""
    clipped = 0
    # A driver that repeats whole samples makes no flat tops.
    held = (gyr[0] == x[REPEATED] and gyr[1] == x[REPEATED + 1] and gyr[2] == x[REPEATED + 2])
    for i in range(3):
        size = abs(gyr[i])
        if math.isnan(par[st.P_RANGE + i]):
            if held:
                pass
            elif gyr[i] == x[REPEATED + i]:
                k[REPEATS + i] += 1
                if (k[REPEATS + i] >= _REPEATS_AT_LIMIT - 1
                        and size >= x[LARGEST + i] * (1.0 - LIMIT_TOLERANCE)
                        and x[ENTRY + i] > _ENTRY_SHARE * size > _ENTRY_SHARE * _LIMIT_FLOOR):
                    x[LIMIT + i] = min(x[LIMIT + i], size)
            else:
                k[REPEATS + i] = 0
                x[ENTRY + i] = abs(gyr[i] - x[REPEATED + i])
            # Two samples in a row: a single wild one neither hides nor disproves a limit.
            lasting = min(size, abs(x[REPEATED + i]))
            x[LARGEST + i] = max(x[LARGEST + i], lasting)
            if lasting > x[LIMIT + i] * (1.0 + LIMIT_TOLERANCE):
                x[LIMIT + i] = np.inf    # a repeated value that was no limit
            x[REPEATED + i] = gyr[i]
        if size >= x[LIMIT + i] * (1.0 - LIMIT_TOLERANCE):
            clipped |= 1 << i
    return clipped


def limits_of(gyr, par):
    """Limits (3,) rad/s that are given or that rates (n, 3) show by flat tops, else infinite."""
    x, k = np.zeros(X_SIZE), np.zeros(K_SIZE, dtype=np.int64)
    start_limits(x, par)
    for rates in gyr:
        find_limits(x, k, par, rates)
    return x[LIMIT:LIMIT + 3]


@njit
def hold_spike(x, k, gyr, dt, missed):
    """Keep a single wild rate from turning the attitude.

    A rate far from the one before is held back, which then stands in for it. If the next
    one is back where it came from, it was none; if not, it was motion, and what was missed of
    the rotation is made up for.

    Args:
        gyr: (3,) rad/s, replaced while held. dt: s since the sample before.
        missed: (3,) zeros; gets the rotation to make up for, rad.

    Returns:
        Whether the rate is held.
    """
    change = 0.0
    for i in range(3):
        change = max(change, abs(gyr[i] - x[st.GYR_LAST + i]))
    is_far = change > max(_SPIKE, _SPIKE_CHANGES * x[CHANGE])
    if k[HELD]:
        k[HELD] = 0
        if is_far:
            for i in range(3):
                missed[i] = 0.5 * x[HELD_STEP] * (x[HELD_RATE + i] - x[st.GYR_LAST + i])
                x[st.GYR_LAST + i] = x[HELD_RATE + i]
        return False
    if is_far and dt <= _SPIKE_STEP:
        k[HELD] = 1
        x[HELD_STEP] = dt
        for i in range(3):
            x[HELD_RATE + i] = gyr[i]
            gyr[i] = x[st.GYR_LAST + i]
        return True
    x[CHANGE] += min(dt / _SPIKE_MEMORY, 1.0) * (change - x[CHANGE])
    return False


@njit
def is_still(x, k, par, stamp, dt, gyr, acc):
    """Rest: rate and force have kept to their short-term means, and the mean rate is bias.

    Slow turning is told from rest by the bias' own uncertainty.
    """
    part = min(dt / REST_MEMORY, 1.0)
    rate2 = 0.0
    force2 = 0.0
    mean2 = 0.0
    limit2 = 0.0
    for i in range(3):
        x[MEAN_RATE + i] += part * (gyr[i] - x[MEAN_RATE + i])
        x[MEAN_FORCE + i] += part * (acc[i] - x[MEAN_FORCE + i])
        rate2 += (gyr[i] - x[MEAN_RATE + i]) ** 2
        force2 += (acc[i] - x[MEAN_FORCE + i]) ** 2
        mean2 += (x[MEAN_RATE + i] - x[S + es.BIAS + i]) ** 2
        slot = COV + (es.BIAS + i) * (N + 1)
        limit2 += x[slot] + _REST_TURN ** 2
    if (rate2 > par[P_REST_RATE] ** 2 or force2 > par[P_REST_FORCE] ** 2
            or mean2 > 9.0 * limit2):
        k[REST_SINCE] = stamp
    return stamp - k[REST_SINCE] > par[P_REST_TIME] * 1e9


@njit
def mean_rate(x, i):
    """Low-passed rate of axis i, scaled, with its bias."""
    rate = x[MEAN_RATE + i]
    for j in range(3):
        rate += x[S + es.SCALE + 3 * i + j] * x[MEAN_RATE + j]
    return rate
