"""Orientation from gyroscope, accelerometer and magnetometer: an error-state filter.

The attitude is carried on by every rate; about every ``block`` seconds a Kalman
update corrects it. What is observed:

- Velocity and position stay bounded: zero-mean pseudo-measurements with the standard
  deviations and correlation times of the motion. Gravity's direction follows from
  that, without ever taking the specific force for gravity.
- The field in world axes is constant but for a drift, and for a local part
  that is frozen while the sensor rests and forgotten as it moves. Samples weigh less
  the more their norm deviates.
- At rest, velocity and rate are zero.

Slow states beside the attitude: gyroscope bias, scale and misalignment, accelerometer
bias, the magnetometer's offset, matrix and lag. A gyroscope axis at its limit gets two
for what it does not show: the excess of its rate, and the angular acceleration (surge) that
drives it, which starts as the slope that ran into the limit and is forgotten in
``surge_time``. The first sample back within the limit tells what the excess has become.
"""

import math

import numpy as np
from imu_fusion.kernels import njit

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation import state as st
from imu_fusion.estimation.orientation.detect import (
    REST_MEMORY, find_limits, hold_spike, is_still, mean_rate, start_limits)
from imu_fusion.estimation.orientation.field import (
    collect_mags, start_field, update_mag)
from imu_fusion.estimation.orientation.fusion_layout import (
    ACC_LAST, BLOCK_MAGS, BLOCK_START, CLIPPED, COV, GRAVITY, HEADING_VAR, K_SIZE, LIMIT,
    MAG_ROWS, MAG_SUM, MEAN_FORCE, MEAN_RATE, MOTION, MOVE, N, P_ACC_WALK, P_BLOCK,
    P_ESTIMATE_BIAS, P_FIELD_WALK, P_FOLLOW_FIELD, P_LAG_SD, P_LOCAL_SD, P_LOCAL_TIME,
    P_OFFSET_SD, P_POS_SD, P_POS_TIME, P_REST_RATE_SD, P_SCALE_SD, P_SIZE, P_SOFT_SD,
    P_SURGE_SD, P_SURGE_TIME, P_USE_ACC, P_VEL_SD, P_VEL_TIME, REPEATS, REST_SINCE, S, SLOPE,
    SWAY, WAS_CLIPPED, WORLD_TURNED, X_SIZE)
from imu_fusion.estimation.orientation.state import push_mag
from imu_fusion.geometry.rotation import quat_exp, quat_multiply, quat_normalize, quat_to_matrix

# What every kernel offers beside its functions.
__all__ = ["K_SIZE", "P_SIZE", "X_SIZE", "advance", "initialise", "pack", "push_mag", "run_loop",
           "step_imu"]

_SWAY_TIME = 5.0           # s: velocity changes faster than this show in SWAY
_MOTION_TIME = 30.0        # s: over which the size of the motion is judged
_MOTION_SDS2 = 4.0         # squared standard deviations beyond which it is believed at once
_REST_SPEED_SD = 0.003     # m/s, over 20 ms: a sensor that rests in a quiet hand
_BACK_SD = 0.1             # rad/s: of what an axis shows that has just come back from its limit
_LAG_SDS = 3.0             # standard deviations within which a magnetometer lag is believed
_BURST_SHARE = 0.1         # of the block, while an axis is at its limit


def pack(par, p):
    """Write this kernel's own parameters (OrientationParams) behind the common ones."""
    par[st.P_COMMON:P_SIZE] = (
        p.block, p.velocity_walk, p.velocity_sd, p.velocity_time, p.position_sd,
        p.position_time, p.local_field_sd, p.local_field_time, p.field_walk, p.mag_sd,
        p.norm_deviation_factor, p.rest_rate, p.rest_force, p.rest_time, p.rest_rate_sd,
        p.surge_sd, p.surge_time, p.estimate_bias, p.gyro_scale_sd, p.mag_offset_sd,
        p.mag_matrix_sd, p.mag_delay_sd if p.mag_delay is None else 0.0,
        p.heading_anchor == "field", math.radians(p.heading_sd_deg), p.use_acc)


def initialise(x, k, par, a):
    """Start from an Alignment. x, k: zeroed state."""
    x[st.Q:st.Q + 4] = a.quat_world_imu
    x[st.U:st.U + 4] = 0.0, 0.0, 0.0, 1.0
    x[S + es.BIAS:S + es.BIAS + 3] = x[st.GYR_BIAS:st.GYR_BIAS + 3] = a.gyr_bias
    x[S + es.LAG] = x[st.LAG]
    x[GRAVITY] = a.gravity
    x[HEADING_VAR] = st.UNIFORM_VARIANCE
    x[MEAN_RATE:MEAN_RATE + 3] = a.gyr_bias
    start_limits(x, par)
    sd = np.zeros(N)
    sd[es.ATT:es.ATT + 2] = math.sqrt(a.cov_attitude_world[0, 0])
    sd[es.BIAS:es.SCALE] = max(a.gyr_bias_sd, 2e-4)
    sd[es.SCALE:es.VEL] = par[P_SCALE_SD]
    sd[es.VEL:es.POS] = 0.01 if a.at_rest else par[P_VEL_SD]
    sd[es.POS:es.FIELD] = 0.01 if a.at_rest else par[P_POS_SD]
    sd[es.OFFSET:es.ACC_BIAS] = par[P_OFFSET_SD]
    sd[es.ACC_BIAS:es.LAG] = par[st.P_ACC_BIAS_SD]
    sd[es.LAG] = par[P_LAG_SD]
    sd[es.SOFT:es.EXCESS] = par[P_SOFT_SD]
    x[COV:COV + N * N] = np.diag(sd ** 2).ravel()
    if a.field_world is not None:
        follow = 1.0 if par[P_FOLLOW_FIELD] or not a.at_rest else 0.0
        start_field(x, k, par, a.field_world, a.has_heading, follow)


@njit
def _rate(x, gyr):
    """Rate of turn, a tuple, from a raw one, with bias, scale and excess."""
    bias, excess, scale = S + es.BIAS, S + es.EXCESS, S + es.SCALE
    return (gyr[0] - x[bias] + x[excess] + x[scale] * gyr[0] + x[scale + 1] * gyr[1]
            + x[scale + 2] * gyr[2],
            gyr[1] - x[bias + 1] + x[excess + 1] + x[scale + 3] * gyr[0] + x[scale + 4] * gyr[1]
            + x[scale + 5] * gyr[2],
            gyr[2] - x[bias + 2] + x[excess + 2] + x[scale + 6] * gyr[0] + x[scale + 7] * gyr[1]
            + x[scale + 8] * gyr[2])


@njit
def _motion_scale(x, par, cov, move):
    """Factor by which velocities exceed the stated ones, at least 1.

    A body that moves more than was said is believed: a vehicle is not held by a hand.
    Judged by the axis that moves most, less what gravity feigns at a wrong tilt. Large motion is
    believed at once, before it can turn the vertical; moderate motion if it lasts.
    """
    time = move[es.MOVE_TIME]
    keep = math.exp(-time / _SWAY_TIME)
    motion = 0.0
    for i in range(3):
        change = move[es.MOVE_FORCE + i] - (x[GRAVITY] * time if i == 2 else 0.0)
        x[SWAY + i] = keep * x[SWAY + i] + par[P_USE_ACC] * change
        feigned = 0.0
        if i < 2:
            tilt = es.ATT + 1 - i
            feigned = cov[tilt, tilt] * (x[GRAVITY] * _SWAY_TIME) ** 2
        motion = max(motion, (x[SWAY + i] ** 2 - feigned) / par[P_VEL_SD] ** 2)
    x[MOTION] += min(time / _MOTION_TIME, 1.0) * (motion - x[MOTION])
    return math.sqrt(max(x[MOTION], motion / _MOTION_SDS2, 1.0))


@njit
def _surge_gain(par, time):
    """Excess (rad/s) after ``time`` (s) per surge (rad/s^2) before."""
    return par[P_SURGE_TIME] * (1.0 - math.exp(-time / par[P_SURGE_TIME]))


@njit
def _surge_noise(par, time):
    """Variances of surge and excess that ``time`` (s) adds (Singer 1970)."""
    part = time / par[P_SURGE_TIME]
    keep = math.exp(-part)
    # The series where the closed form would be a small difference of large numbers.
    growth = (2.0 / 3.0 * part ** 3 if part < 1e-2
              else 2.0 * part - 3.0 + 4.0 * keep - keep * keep)
    return (par[P_SURGE_SD] ** 2 * (1.0 - keep * keep),
            (par[P_SURGE_SD] * par[P_SURGE_TIME]) ** 2 * growth)


@njit
def _carry_excess(x, k, par, gyr, last, dt, clipped, begun):
    """What axes at their limit do not show, over one step.

    clipped: bits of the axes at their limit, begun: of those that have just reached it.
    """
    noise = x[MOVE + es.MOVE_NOISE:MOVE + es.MOVE_SIZE]
    for i in range(3):
        entered = (gyr[i] - last[i]) / dt if dt > 0.0 else 0.0
        if (begun >> i) & 1:
            slope = x[SLOPE + i]
            if (slope - entered) * gyr[i] < 0.0:
                slope = entered
            x[S + es.SURGE + i] = slope
            x[S + es.EXCESS + i] = (slope - entered) * dt
            # As old as the slope is, or as the limit where it was only now found.
            age = (1.0 + k[REPEATS + i]) * dt if dt > 0.0 else par[st.P_MAX_GAP]
            noise[es.SURGE + i], noise[es.EXCESS + i] = _surge_noise(par, age)
        elif (k[CLIPPED] >> i) & 1:
            x[S + es.EXCESS + i] += x[S + es.SURGE + i] * _surge_gain(par, dt)
            x[S + es.SURGE + i] *= math.exp(-dt / par[P_SURGE_TIME])
        if not (clipped >> i) & 1:
            x[SLOPE + i] = entered


@njit
def _end_block(x, k, par, still, back, gyr, last, tape):
    """Prediction and updates over the collected block.

    still: at rest. back: bits of the axes that came back from their limit.
    gyr, last: (3,) raw rates of the newest sample and the one before, rad/s.
    """
    cov = x[COV:COV + N * N].reshape(N, N)
    move = x[MOVE:MOVE + es.MOVE_SIZE]
    time = move[es.MOVE_TIME]
    rate = 1e-3 if still else 1.0 / par[P_LOCAL_TIME]
    keep = math.exp(-time * rate)
    move[es.MOVE_LOCAL_KEEP] = keep
    move[es.MOVE_SURGE_KEEP] = math.exp(-time / par[P_SURGE_TIME])
    move[es.MOVE_SURGE_GAIN] = _surge_gain(par, time)
    if time > 0.0:
        move[es.MOVE_SURGE_MEAN] = par[P_SURGE_TIME] * (1.0 - move[es.MOVE_SURGE_GAIN] / time)
    surge_var, excess_var = _surge_noise(par, time)
    states = N if k[CLIPPED] else es.EXCESS
    move[es.MOVE_STATES] = states
    noise = move[es.MOVE_NOISE:]
    for i in range(3):
        lasting = ((k[CLIPPED] & k[WAS_CLIPPED]) >> i) & 1
        move[es.MOVE_EXCESS_KEEP + i] = lasting
        noise[es.ATT + i] += par[st.P_GYR_DENSITY] ** 2 * time
        noise[es.BIAS + i] = par[st.P_BIAS_WALK] ** 2 * time
        noise[es.VEL + i] = par[P_ACC_WALK] ** 2 * time
        noise[es.FIELD + i] = par[P_FIELD_WALK] ** 2 * time
        noise[es.LOCAL + i] = par[P_LOCAL_SD] ** 2 * (1.0 - keep * keep)
        if lasting:
            noise[es.SURGE + i] = surge_var
            noise[es.EXCESS + i] = excess_var
        x[S + es.LOCAL + i] *= keep
    if len(tape):
        tape[es.TAPE_OPS] = 0
        tape[es.TAPE_MOVE:es.TAPE_MOVE + es.MOVE_SIZE] = move
    es.predict(cov, move)

    scale = _motion_scale(x, par, cov, move)
    error = np.zeros(N)
    index = np.empty(1, dtype=np.int64)
    row = np.ones(1)
    for i in range(3):
        if (back >> i) & 1:
            index[0] = es.EXCESS + i
            es.update(cov, error, states, index, row, gyr[i] - last[i]
                      - x[S + es.EXCESS + i], _BACK_SD ** 2, tape)
    for i in range(3):
        if still:
            index[0] = es.BIAS + i
            es.update(cov, error, states, index, row, mean_rate(x, i) - x[S + es.BIAS + i],
                      par[P_REST_RATE_SD] ** 2 * REST_MEMORY / time, tape)
        if not par[P_USE_ACC]:
            continue    # without force, velocity and position tell nothing
        # At equal accelerations times grow as velocities do, and extents as their square.
        index[0] = es.VEL + i
        variance = (_REST_SPEED_SD ** 2 * 0.02 / time if still
                    else scale ** 3 * par[P_VEL_SD] ** 2 * max(par[P_VEL_TIME] / time, 1.0))
        es.update(cov, error, states, index, row, -x[S + es.VEL + i], variance, tape)
        index[0] = es.POS + i
        es.update(cov, error, states, index, row, -x[S + es.POS + i],
                  scale ** 5 * par[P_POS_SD] ** 2 * max(par[P_POS_TIME] / time, 1.0), tape)
    if k[BLOCK_MAGS] > 0:
        update_mag(x, k, par, error, still, tape)

    x[st.Q:st.Q + 4] = quat_normalize(quat_multiply(quat_exp(error), x[st.Q:st.Q + 4]))
    for i in range(3, states):
        if par[P_ESTIMATE_BIAS] or i < es.BIAS or i >= es.VEL:
            x[S + i] += error[i]
    for i in range(3):
        x[st.GYR_BIAS + i] = x[S + es.BIAS + i]
        if (back >> i) & 1:
            x[S + es.EXCESS + i] = 0.0
            x[S + es.SURGE + i] = 0.0
    # A wrong lag beyond belief would keep every further sample from being used.
    bound = _LAG_SDS * par[P_LAG_SD]
    if bound > 0.0:
        x[S + es.LAG] = min(max(x[S + es.LAG], -bound), bound)
    x[st.LAG] = x[S + es.LAG]
    if len(tape):
        tape[es.TAPE_COV:es.TAPE_COV + N * N] = x[COV:COV + N * N]
        tape[es.TAPE_TURNED] = k[WORLD_TURNED]
    k[WORLD_TURNED] = 0
    k[BLOCK_START] = k[st.LAST_STAMP]
    x[MOVE:MOVE + es.MOVE_SIZE] = 0.0
    x[MAG_SUM:MAG_SUM + MAG_ROWS] = 0.0
    k[BLOCK_MAGS] = 0
    k[WAS_CLIPPED] = k[CLIPPED] & ~back


@njit
def advance(x, k, par, stamp, sample, row, row_int, tape):
    """One Imu sample through the filter; see :func:`step_imu`.

    tape: TAPE_SIZE floats for what the smoother needs, or an empty array.

    Returns:
        0 if the sample was refused, 1 if a row was written, 2 if it also ended a block.
    """
    if not st.is_newer(k, stamp, sample):
        return 0
    gyr = sample[:3].copy()
    acc = sample[3:6]
    first = not k[st.STARTED]
    if first:
        x[st.GYR_LAST:st.GYR_LAST + 3] = gyr
        x[ACC_LAST:ACC_LAST + 3] = acc
        x[MEAN_FORCE:MEAN_FORCE + 3] = acc
        k[REST_SINCE] = stamp
        k[st.LAST_STAMP] = stamp
        k[st.STARTED] = 1
    dt = (stamp - k[st.LAST_STAMP]) * 1e-9
    flags = st.mag_flags(k)
    move = x[MOVE:MOVE + es.MOVE_SIZE]

    clipped = find_limits(x, k, par, gyr)
    if clipped:
        flags |= st.FLAG_SATURATED | clipped << st.SATURATED_AXES_SHIFT
        k[st.SATURATED] += 1
    missed = np.zeros(3)
    if not first and hold_spike(x, k, gyr, dt, missed):
        flags |= st.FLAG_HELD
        k[st.RATES_HELD] += 1
        clipped = k[CLIPPED]     # nothing is known of this sample
    begun = clipped & ~k[CLIPPED]
    back = k[CLIPPED] & ~clipped
    k[CLIPPED] |= clipped
    # Trapezoidal rates and forces over the step, at the attitude of its middle.
    last = x[st.GYR_LAST:st.GYR_LAST + 3].copy()
    rate_last = _rate(x, last)
    _carry_excess(x, k, par, gyr, last, dt, clipped, begun)
    rate = _rate(x, gyr)
    if back:    # those axes show their rates again
        excess = S + es.EXCESS
        rate = (rate[0] - (back & 1) * x[excess], rate[1] - (back >> 1 & 1) * x[excess + 1],
                rate[2] - (back >> 2) * x[excess + 2])
    phi = st.rotation_of_step(rate_last, rate, dt)
    phi = (phi[0] + missed[0], phi[1] + missed[1], phi[2] + missed[2])
    middle = quat_to_matrix(quat_multiply(x[st.Q:st.Q + 4], quat_exp(phi, 0.5)))
    turn = quat_exp(phi)
    x[st.Q:st.Q + 4] = quat_normalize(quat_multiply(x[st.Q:st.Q + 4], turn))
    k[st.LAST_STAMP] = stamp
    st.push_rotation(x, k, stamp, turn)
    for i in range(3):
        force = 0.0
        for j in range(3):
            f = 0.5 * (acc[j] + x[ACC_LAST + j]) - x[S + es.ACC_BIAS + j]
            force += middle[i, j] * f
            move[es.MOVE_ROTATION + 3 * i + j] += middle[i, j] * dt
            if (k[CLIPPED] >> j) & 1:
                part = 0.5 if ((begun | back) >> j) & 1 else 1.0
                move[es.MOVE_EXCESS + 3 * i + j] += part * middle[i, j] * dt
            for c in range(3):
                move[es.MOVE_SCALE + 9 * i + 3 * j + c] += (
                    middle[i, j] * 0.5 * (last[c] + gyr[c]) * dt)
        change = 0.0
        if par[P_USE_ACC]:
            move[es.MOVE_FORCE + i] += force * dt
            change = (force - (x[GRAVITY] if i == 2 else 0.0)) * dt
        x[S + es.POS + i] += (x[S + es.VEL + i] + 0.5 * change) * dt
        x[S + es.VEL + i] += change
    move[es.MOVE_TIME] += dt
    x[st.GYR_LAST:st.GYR_LAST + 3] = gyr
    x[ACC_LAST:ACC_LAST + 3] = acc
    if dt > par[st.P_MAX_GAP]:
        flags |= st.FLAG_GAP
        k[st.GAPS] += 1
        k[REST_SINCE] = stamp
        unseen = min((par[st.P_GAP_RATE_SD] * dt) ** 2, st.UNIFORM_VARIANCE)
        for i in range(3):
            # Nothing is known of the motion meanwhile: start velocity and position anew.
            move[es.MOVE_NOISE + es.ATT + i] += unseen
            move[es.MOVE_NOISE + es.VEL + i] += par[P_VEL_SD] ** 2
            move[es.MOVE_NOISE + es.POS + i] += par[P_POS_SD] ** 2
            x[S + es.VEL + i] = 0.0
            x[S + es.POS + i] = 0.0

    samples = np.empty((k[st.PENDING_COUNT], st.TAKEN_WORDS))
    taken = st.take_mags(x, k, samples)
    reliability = np.nan
    mag = np.full(3, np.nan)
    if taken > 0:
        reliability = collect_mags(x, k, par, samples, taken)
        mag = samples[0, :3].copy()
        if reliability < 0.5:
            flags |= st.FLAG_MAG_DISTURBED
            k[st.MAG_DISTURBED] += taken
        else:
            flags |= st.FLAG_MAG_USED
            k[st.MAG_USED] += taken

    still = is_still(x, k, par, stamp, dt, gyr, acc)
    if still:
        flags |= st.FLAG_STILL
    result = 1
    length = par[P_BLOCK] * (_BURST_SHARE if k[CLIPPED] else 1.0)
    if back or move[es.MOVE_TIME] >= length - 1e-6:
        _end_block(x, k, par, still, back, gyr, last, tape)
        result = 2
        k[CLIPPED] &= ~back
    if not k[st.HEADING_KNOWN]:
        flags |= st.FLAG_NO_HEADING
    if stamp <= k[st.ALIGN_UNTIL]:
        flags |= st.FLAG_ALIGNING
    _write(x, k, par, stamp, dt, gyr, acc, mag, reliability, flags, clipped, taken, row, row_int,
           len(tape) > 0)
    return result


@njit
def _write(x, k, par, stamp, dt, gyr, acc, mag, reliability, flags, clipped, taken, row, row_int,
           taped):
    """The output row of the present state."""
    cov = x[COV:COV + N * N].reshape(N, N)
    noise_dt = dt if dt > 0.0 else 1e-2
    since = x[MOVE + es.MOVE_TIME]
    cov_world = cov[:3, :3].copy()
    var_gyr = np.empty(3)
    bias_var = np.empty(3)
    force = np.empty(3)
    for i in range(3):
        cov_world[i, i] += par[st.P_GYR_DENSITY] ** 2 * since + x[MOVE + es.MOVE_NOISE + es.ATT + i]
        bias_var[i] = cov[es.BIAS + i, es.BIAS + i]
        var_gyr[i] = par[st.P_GYR_DENSITY] ** 2 / noise_dt + bias_var[i]
        for j in range(3):
            slot = es.SCALE + 3 * i + j
            var_gyr[i] += cov[slot, slot] * gyr[j] ** 2
        if (k[CLIPPED] >> i) & 1:
            var_gyr[i] += (cov[es.EXCESS + i, es.EXCESS + i]
                           + x[MOVE + es.MOVE_NOISE + es.EXCESS + i]
                           + since ** 2 * cov[es.SURGE + i, es.SURGE + i])
        force[i] = acc[i] - x[S + es.ACC_BIAS + i]
    cov_world[2, 2] += x[HEADING_VAR]
    rate = np.empty(3)
    rate[:] = _rate(x, gyr)
    if not taped:    # else the smoother does it, after its correction
        st.beyond_limits(rate, clipped, x[LIMIT:LIMIT + 3])
    st.write_row(row, row_int, par, stamp, x[st.Q:st.Q + 4], cov_world, rate, var_gyr,
                 force, par[st.P_ACC_DENSITY] ** 2 / noise_dt + cov[es.ACC_BIAS, es.ACC_BIAS],
                 x[S + es.BIAS:S + es.BIAS + 3], bias_var, mag, reliability, flags, taken)


@njit
def step_imu(x, k, par, stamp, sample, row, row_int):
    """One Imu sample through the filter.

    Args:
        x, k, par: state and parameters, in place.
        stamp: int64 ns.
        sample: (6,) rate rad/s, specific force m/s^2.
        row, row_int: float and integer view of the output row.

    Returns:
        0 if the sample was refused (not finite, or not newer than the last), else 1 or 2.
    """
    return advance(x, k, par, stamp, sample, row, row_int, np.empty(0))


@njit
def run_loop(x, k, par, imu_stamps, samples, mag_stamps, mags, rows, rows_int):
    """Whole logs in merge order: a magnetometer sample before the Imu of the same stamp.

    Returns the number of rows written.
    """
    written = 0
    j = 0
    tape = np.empty(0)
    for i in range(len(imu_stamps)):
        while j < len(mag_stamps) and mag_stamps[j] <= imu_stamps[i]:
            push_mag(x, k, par, mag_stamps[j], mags[j])
            j += 1
        if advance(x, k, par, imu_stamps[i], samples[i], rows[written], rows_int[written], tape):
            written += 1
    while j < len(mag_stamps):
        push_mag(x, k, par, mag_stamps[j], mags[j])
        j += 1
    return written
