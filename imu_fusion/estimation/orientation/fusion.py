"""Orientation from gyroscope, accelerometer and magnetometer: an error-state filter.

The attitude is carried on by every rate; about every ``fusion.block`` seconds a Kalman
update corrects it with what the modules of ``measurements`` observe.

Slow states beside the attitude: gyroscope bias, scale and misalignment, accelerometer
bias, the magnetometer's offset, matrix and lag. A gyroscope axis at its limit gets two
for what it does not show (clipped_rate).
"""

import math

import numpy as np

from imu_fusion.estimation.orientation import (
    clipped_rate,
    gyro_limit,
    imu_rejection,
    mag_queue,
    rotation_history,
    spike,
    wander,
)
from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation.alignment import Alignment
from imu_fusion.estimation.orientation.measurements import (
    back_in_range,
    bounded_motion,
    magnetometer,
    rest,
)
from imu_fusion.estimation.orientation.motion_scale import motion_scale
from imu_fusion.estimation.orientation.rest_detection import is_still, refuted_turn
from imu_fusion.estimation.orientation.rows import (
    FLAG_ALIGNING,
    FLAG_GAP,
    FLAG_HELD,
    FLAG_MAG_DISTURBED,
    FLAG_MAG_USED,
    FLAG_NO_HEADING,
    FLAG_SATURATED,
    FLAG_STILL,
    SATURATED_AXES_SHIFT,
    raise_to_limits,
    write_attitude,
)
from imu_fusion.estimation.orientation.state import MAG_SUM
from imu_fusion.geometry.rotation import (
    quat_exp,
    quat_multiply,
    quat_normalize,
    quat_rotate,
    quat_to_matrix,
)
from imu_fusion.kernels import njit

_LAG_SDS = 3.0             # standard deviations within which a magnetometer lag is believed
# Of the block, while an axis is at its limit: its angular acceleration is forgotten in the time of
# two whole blocks.
_BURST_SHARE = 0.1
_DISTURBED = 0.5           # weight (10) below which a sample is flagged as disturbed
_STILL_LOCAL_RATE = 1e-3   # 1/s: at rest the local field is forgotten in a quarter of an hour
_BIAS_SD_FLOOR = 2e-4      # rad/s: a first second at rest shows no bias better than that
_REST_SD = 0.01            # m/s and m: velocity and position at a start at rest
_LASTING_TIME = 10.0       # s, of accelerations that last in imu axes, such as those of turns
_REST_LASTING_TIME = 0.3   # s: at rest they are over
_FIRST_DT = 1e-2           # s: step that stands in for the one before the first sample
_NO_FIELD = 1e-9           # of its norm: a field without a horizontal part
_NO_BLOCK = np.zeros(1, es.PREDICTION)
_NO_SUM = np.zeros(1, MAG_SUM)


def initialise(state: np.ndarray, par: np.ndarray, alignment: Alignment) -> None:
    """Start from an Alignment. state (1,): zeroed; par (1,): of kernel_parameters."""
    s, p, a = state[0], par[0], alignment
    if p["lasting_acc_sd"] > 0.0 and not a.at_rest:
        # Where tilt and bias begin unknown, too, it explains what it should not.
        s["log_likelihood"] = -math.inf
    s["gyro_bias"] = a.gyr_bias
    s["gravity"] = a.gravity
    s["heading_var"] = es.UNIFORM_VARIANCE
    s["rest"]["mean_rate"] = a.gyr_bias
    sd = np.zeros(es.N)
    sd[es.ATTITUDE:es.ATTITUDE + 2] = math.sqrt(a.cov_attitude_world[0, 0])
    bias_sd = a.gyr_bias_sd if a.at_rest else p["sensor"]["gyro_bias_sd"]
    sd[es.GYRO_BIAS:es.GYRO_SCALE] = max(bias_sd, _BIAS_SD_FLOOR)
    sd[es.GYRO_SCALE:es.VELOCITY] = p["sensor"]["gyro_scale_sd"]
    sd[es.VELOCITY:es.POSITION] = _REST_SD if a.at_rest else p["fusion"]["velocity_sd"]
    sd[es.POSITION:es.FIELD] = _REST_SD if a.at_rest else p["fusion"]["position_sd"]
    sd[es.MAG_OFFSET:es.ACC_BIAS] = p["fusion"]["mag_offset_sd"]
    sd[es.ACC_BIAS:es.MAG_LAG] = p["sensor"]["acc_bias_sd"]
    sd[es.MAG_LAG] = p["mag_delay_sd"]
    sd[es.MAG_MATRIX:es.CLIPPED_RATE] = p["fusion"]["mag_matrix_sd"]
    s["cov"] = np.diag(sd ** 2)
    if a.field_world is not None:
        follow = 1.0 if p["follows_field"] or not a.at_rest else 0.0
        _start_field(state, par, a.field_world, a.has_heading, follow)


@njit
def _start_field(state, par, z, has_heading, follow):
    magnetometer.start_field(state[0], par[0], (z[0], z[1], z[2]), has_heading, follow)


@njit
def step(s, p, stamp, sample, row, tape):
    """One Imu sample through the filter.

    Args:
        s, p: state and parameters, records; s in place.
        stamp: int64 ns.
        sample: (6,) rate rad/s, specific force m/s^2.
        row: the output row.
        tape: (1,) error_state.TAPE for what the smoother needs, or empty.

    Returns:
        0 if the sample was refused (not possible, or not newer than the last), 1 if a row was
        written, 2 if it also ended a block.
    """
    if imu_rejection.is_refused(s, stamp, sample):
        return 0
    _begin_step(s, p, stamp, sample)
    _carry(s, p)
    if s.step.dt > p.gap.max:
        _allow_for_gap(s, p)
    _take_mags(s, p)
    s.step.still = is_still(s, p)
    if s.step.still:
        s.step.flags |= FLAG_STILL
    elif s.rest.settled:
        turned = refuted_turn(s, p)
        if turned > 0.0:
            _realign(s, p, turned)
    result = 1
    length = p.fusion.block * (_BURST_SHARE if s.clipped else 1.0)
    if s.step.back or s.block.time >= length - 1e-6:
        _end_block(s, p, tape)
        result = 2
        s.clipped &= ~s.step.back
    for i in range(3):
        s.gyr_last[i] = s.step.gyr[i]
        s.force_last[i] = s.step.force[i]
    _write(s, p, row, len(tape) > 0)
    return result


@njit
def _begin_step(s, p, stamp, sample):
    """Fill ``s.step`` with the sample, and with which axes are at their limit."""
    step = s.step
    first = not s.started
    for i in range(3):
        step.gyr[i] = sample[i]
        step.acc[i] = step.force[i] = sample[3 + i]
        step.missed[i] = step.missed_force[i] = 0.0
        if first:
            s.gyr_last[i] = step.gyr[i]
            s.force_last[i] = s.rest.mean_force[i] = step.acc[i]
    if first:
        s.rest.since = s.rest.changed = s.stamp = stamp
        s.started = True
    step.dt = (stamp - s.stamp) * 1e-9
    s.stamp = stamp
    step.flags = s.waiting_flags
    s.waiting_flags = 0
    clipped = gyro_limit.find(s.gyro_limit, p.sensor.gyro_range, step.gyr[:])
    if clipped:
        step.flags |= FLAG_SATURATED | clipped << SATURATED_AXES_SHIFT
        s.counts.saturated += 1
    if spike.hold(s.gyro_spike, step.gyr[:], s.gyr_last[:], step.dt, spike.WILD_RATE,
                  step.missed[:]):
        step.flags |= FLAG_HELD
        s.counts.rates_held += 1
        clipped = s.clipped     # nothing is known of this sample
    if p.use_acc and spike.hold(s.acc_spike, step.force[:], s.force_last[:], step.dt,
                                spike.WILD_FORCE, step.missed_force[:]):
        step.flags |= FLAG_HELD
        s.counts.forces_held += 1
    step.clipped = clipped
    step.begun = clipped & ~s.clipped
    step.back = s.clipped & ~clipped
    s.clipped |= clipped


@njit
def _rate(s, gyr):
    """Rate of turn, a tuple, from a raw one, with bias, scale and clipped rate."""
    bias, clipped, scale = s.gyro_bias, s.clipped_rate, s.gyro_scale
    return (gyr[0] - bias[0] + clipped[0] + scale[0, 0] * gyr[0] + scale[0, 1] * gyr[1]
            + scale[0, 2] * gyr[2],
            gyr[1] - bias[1] + clipped[1] + scale[1, 0] * gyr[0] + scale[1, 1] * gyr[1]
            + scale[1, 2] * gyr[2],
            gyr[2] - bias[2] + clipped[2] + scale[2, 0] * gyr[0] + scale[2, 1] * gyr[1]
            + scale[2, 2] * gyr[2])


@njit
def _carry(s, p):
    """Attitude over the step: trapezoidal rates with the coning term."""
    step = s.step
    rate_last = _rate(s, s.gyr_last)
    clipped_rate.carry(s, p)
    rate = _rate(s, step.gyr)
    back = step.back
    if back:    # those axes show their rates again
        rate = (rate[0] - (back & 1) * s.clipped_rate[0],
                rate[1] - (back >> 1 & 1) * s.clipped_rate[1],
                rate[2] - (back >> 2) * s.clipped_rate[2])
    phi = rotation_history.rotation_of_step(rate_last, rate, step.dt)
    phi = (phi[0] + step.missed[0], phi[1] + step.missed[1], phi[2] + step.missed[2])
    middle = quat_to_matrix(quat_multiply(s.quat_world_imu, quat_exp(phi, 0.5)))
    turn = quat_exp(phi, 1.0)
    s.quat_world_imu[:] = quat_normalize(quat_multiply(s.quat_world_imu, turn))
    rotation_history.push(s.history, s.stamp, turn)
    _collect(s, p, middle)


@njit
def _collect(s, p, middle):
    """Velocity and position over the step, and the block's integrals, at the attitude (3, 3) of
    its middle."""
    step, block = s.step, s.block
    dt = step.dt
    for i in range(3):
        force = 0.0
        for j in range(3):
            f = 0.5 * (step.force[j] + s.force_last[j]) - s.acc_bias[j]
            force += middle[i, j] * (f * dt + step.missed_force[j])
            block.rotation[i, j] += middle[i, j] * dt
            if (s.clipped >> j) & 1:
                part = 0.5 if ((step.begun | step.back) >> j) & 1 else 1.0
                block.clipped_rotation[i, j] += part * middle[i, j] * dt
            for c in range(3):
                block.rotation_gyr[i, 3 * j + c] += (
                    middle[i, j] * 0.5 * (s.gyr_last[c] + step.gyr[c]) * dt)
        change = 0.0
        if p.use_acc:
            block.force[i] += force
            change = force - (s.gravity * dt if i == 2 else 0.0)
        s.position[i] += (s.velocity[i] + 0.5 * change) * dt
        s.velocity[i] += change
    block.time += dt


@njit
def _allow_for_gap(s, p):
    """Nothing is known of the motion in a gap."""
    s.step.flags |= FLAG_GAP
    s.counts.gaps += 1
    s.rest.since = s.rest.changed = s.stamp
    s.rest.settled = 0
    unseen = min((p.gap.rate_sd * s.step.dt) ** 2, es.UNIFORM_VARIANCE)
    for i in range(3):
        s.block.noise[es.ATTITUDE + i] += unseen
    _forget_motion(s, p)


@njit
def _realign(s, p, turned):
    """A rest has refuted bias and attitude: what is known of them, and of what they were thought to
    show, begins anew. turned: rad, what the bias has turned the attitude by in this rest alone."""
    s.counts.realigned += 1
    rest, noise = s.rest, s.block.noise
    force = rest.mean_force
    up = quat_rotate(s.quat_world_imu, (force[0], force[1], force[2]))
    unsure = (up[0] ** 2 + up[1] ** 2) / (up[0] ** 2 + up[1] ** 2 + up[2] ** 2) + turned ** 2
    for i in range(3):
        noise[es.ATTITUDE + i] += unsure
        noise[es.GYRO_BIAS + i] += (rest.mean_rate[i] - s.gyro_bias[i]) ** 2
        noise[es.ACC_BIAS + i] += p.sensor.acc_bias_sd ** 2
        for j in range(3):
            noise[es.GYRO_SCALE + 3 * i + j] += p.sensor.gyro_scale_sd ** 2
    _forget_motion(s, p)
    rest.changed = s.stamp
    rest.settled = 0


@njit
def _forget_motion(s, p):
    """Start velocity and position anew."""
    noise = s.block.noise
    for i in range(3):
        noise[es.VELOCITY + i] += p.fusion.velocity_sd ** 2
        noise[es.POSITION + i] += p.fusion.position_sd ** 2
        s.velocity[i] = 0.0
        s.position[i] = 0.0


@njit
def _take_mags(s, p):
    """The magnetometer samples that the newest Imu sample has passed."""
    step = s.step
    step.mag_count = 0
    step.reliability = np.nan
    for i in range(3):
        step.mag[i] = np.nan
    if s.queue.count == 0:
        return
    taken = np.empty(s.queue.count, mag_queue.TAKEN)
    count = mag_queue.take(s, taken)
    if count == 0:
        return
    step.mag_count = count
    magnetometer.collect(s, p, taken, count)
    if step.reliability < _DISTURBED:
        step.flags |= FLAG_MAG_DISTURBED
        s.counts.mag_disturbed += count
    else:
        step.flags |= FLAG_MAG_USED
        s.counts.mag_used += count


@njit
def _end_block(s, p, tape):
    """Prediction and updates over the collected block."""
    _finish_prediction(s, p)
    if len(tape):
        tape[0].count = 0
        tape[0].prediction = s.block
    # A plain array: the algebra is compiled once for all that it is used on.
    es.predict(s.cov[:], s.block)
    error = np.zeros(es.N)
    known, placed = s.log_likelihood, s.position_likelihood
    correct(s, p, error, tape)
    if s.clipped or s.was_clipped:
        # What a clipped rate was is a guess: its misfit is no evidence of the surroundings.
        s.log_likelihood, s.position_likelihood = known, placed
    _add_error(s, p, error)
    magnetometer.judge_anchor(s, p)
    if len(tape):
        for i in range(es.N):
            source, target = s.cov[i], tape[0].cov[i]    # row by row: as fast as memory
            for j in range(es.N):
                target[j] = source[j]
        tape[0].turned = s.world_turned
    s.world_turned = False
    s.block_start = s.stamp
    s.block = _NO_BLOCK[0]
    s.mag_sum = _NO_SUM[0]
    s.was_clipped = s.clipped & ~s.step.back


@njit
def _finish_prediction(s, p):
    """Process noise and decays of the block."""
    block, f = s.block, p.fusion
    noise, time = block.noise, block.time
    keep = math.exp(-time * (_STILL_LOCAL_RATE if s.step.still else 1.0 / f.local_field_time))
    block.local_field_keep = keep
    block.acc_bias_keep, lasting_var = _lasting(s, p)
    block.acc_keep = math.exp(-time / f.angular_acc_time)
    block.rate_gain = clipped_rate.gain(p, time)
    if time > 0.0:
        block.rate_mean = f.angular_acc_time * (1.0 - block.rate_gain / time)
    acc_var, rate_var = clipped_rate.noise(p, time)
    block.states = es.N if s.clipped else es.CLIPPED_RATE
    for i in range(3):
        lasting = ((s.clipped & s.was_clipped) >> i) & 1
        block.stays_clipped[i] = lasting
        noise[es.ATTITUDE + i] += p.sensor.gyro_noise_density ** 2 * time
        noise[es.GYRO_BIAS + i] += p.sensor.gyro_bias_walk ** 2 * time
        noise[es.VELOCITY + i] += f.velocity_walk ** 2 * time
        noise[es.FIELD + i] = f.field_walk ** 2 * time
        noise[es.ACC_BIAS + i] += lasting_var
        s.acc_bias[i] *= block.acc_bias_keep
        noise[es.LOCAL_FIELD + i] = p.local_field_sd ** 2 * (1.0 - keep * keep)
        if lasting:
            noise[es.ANGULAR_ACC + i] = acc_var
            noise[es.CLIPPED_RATE + i] = rate_var
        s.local_field[i] *= keep


@njit
def _lasting(s, p):
    """Factor that the accelerometer's bias keeps over the block, and the variance that it gains:
    where accelerations last in imu axes it is theirs, too (Gauss-Markov)."""
    if p.lasting_acc_sd == 0.0:
        return 1.0, 0.0
    still = s.step.still
    keep = math.exp(-s.block.time / (_REST_LASTING_TIME if still else _LASTING_TIME))
    sd = p.sensor.acc_bias_sd if still else p.lasting_acc_sd
    return keep, sd ** 2 * (1.0 - keep * keep)


@njit
def correct(s, p, error, tape):
    """All measurements of the block, in order. error: (N,) zeros; gets the mean of the error."""
    scale = motion_scale(s, p)
    states = s.block.states
    rows = np.empty(3, es.ROW)
    for i in range(3):
        if (s.step.back >> i) & 1:
            back_in_range.clipped_rate(i, s, rows[0])
            es.update(s.cov, error, states, rows[0], tape)
    for i in range(3):
        if s.step.still:
            rest.gyro_bias(i, s, p, rows[0])
            s.log_likelihood += es.update(s.cov, error, states, rows[0], tape)[1]
        if p.use_acc:    # without force, velocity and position tell nothing
            bounded_motion.velocity(i, s, p, scale, rows[0])
            innovation, likely = es.update(s.cov, error, states, rows[0], tape)
            s.log_likelihood += likely
            if i < 2:
                s.wander.velocity[i] = wander.low_passed(s.wander.velocity[i], innovation,
                                                         s.block.time)
            bounded_motion.position(i, s, p, scale, rows[0])
            s.position_likelihood += es.update(s.cov, error, states, rows[0], tape)[1]
    s.wander.since += s.block.time
    if s.mag_sum.count > 0:
        magnetometer.field(s, p, error, rows)
        size = max(math.hypot(s.field[0], s.field[1]), _NO_FIELD)
        across = 0.0
        for i in range(3):
            innovation, _ = es.update(s.cov, error, states, rows[i], tape)
            if i < 2:
                across += innovation * (s.field[0] if i == 1 else -s.field[1]) / size
        s.wander.field = wander.low_passed(s.wander.field, across, s.wander.since)
        s.wander.since = 0.0
    wander.judge(s.wander, s.block.time)


@njit
def _add_error(s, p, error):
    """Move the nominal state by the mean of the error."""
    s.quat_world_imu[:] = quat_normalize(quat_multiply(quat_exp(error, 1.0), s.quat_world_imu))
    for i in range(3):
        if p.fusion.estimate_bias:
            s.gyro_bias[i] += error[es.GYRO_BIAS + i]
            for j in range(3):
                s.gyro_scale[i, j] += error[es.GYRO_SCALE + 3 * i + j]
        s.velocity[i] += error[es.VELOCITY + i]
        s.position[i] += error[es.POSITION + i]
        s.field[i] += error[es.FIELD + i]
        s.local_field[i] += error[es.LOCAL_FIELD + i]
        s.mag_offset[i] += error[es.MAG_OFFSET + i]
        s.acc_bias[i] += error[es.ACC_BIAS + i]
        for j in range(3):
            s.mag_matrix[i, j] += error[es.MAG_MATRIX + 3 * i + j]
        if s.block.states > es.CLIPPED_RATE:
            s.clipped_rate[i] += error[es.CLIPPED_RATE + i]
            s.angular_acc[i] += error[es.ANGULAR_ACC + i]
        if (s.step.back >> i) & 1:
            s.clipped_rate[i] = 0.0
            s.angular_acc[i] = 0.0
    s.mag_lag += error[es.MAG_LAG]
    # A wrong lag beyond belief would keep every further sample from being used.
    bound = _LAG_SDS * p.mag_delay_sd
    if bound > 0.0:
        s.mag_lag = min(max(s.mag_lag, -bound), bound)


@njit
def _write(s, p, row, taped):
    """The output row of the present state. taped: the smoother will correct it."""
    step, cov = s.step, s.cov
    noise_dt = step.dt if step.dt > 0.0 else _FIRST_DT
    since = s.block.time
    density2 = p.sensor.gyro_noise_density ** 2
    cov_world = np.empty((3, 3))
    rate = _rate(s, step.gyr)
    var_acc = p.sensor.acc_noise_density ** 2 / noise_dt + cov[es.ACC_BIAS, es.ACC_BIAS]
    row.stamp = s.stamp
    for i in range(3):
        bias_var = cov[es.GYRO_BIAS + i, es.GYRO_BIAS + i]
        var_gyr = density2 / noise_dt + bias_var
        for j in range(3):
            slot = es.GYRO_SCALE + 3 * i + j
            var_gyr += cov[slot, slot] * step.gyr[j] ** 2
            cov_world[i, j] = cov[i, j]
            row.cov_gyr[i, j] = row.cov_acc[i, j] = 0.0
        cov_world[i, i] += density2 * since + s.block.noise[es.ATTITUDE + i]
        if (s.clipped >> i) & 1:
            var_gyr += (cov[es.CLIPPED_RATE + i, es.CLIPPED_RATE + i]
                        + s.block.noise[es.CLIPPED_RATE + i]
                        + since ** 2 * cov[es.ANGULAR_ACC + i, es.ANGULAR_ACC + i])
        row.gyr[i] = rate[i]
        row.cov_gyr[i, i] = var_gyr
        row.acc[i] = step.acc[i]
        if p.lasting_acc_sd == 0.0:    # else it is mostly motion
            row.acc[i] -= s.acc_bias[i]
        row.cov_acc[i, i] = var_acc
        row.gyr_bias[i] = s.gyro_bias[i]
        row.gyr_bias_sd[i] = math.sqrt(max(bias_var, 0.0))
    wander.widen(cov_world, wander.shown(s.wander))
    cov_world[2, 2] += s.heading_var
    if not taped:    # else the smoother does it, after its correction
        raise_to_limits(row.gyr, step.clipped, s.gyro_limit.limit)
    write_attitude(row, p, s.quat_world_imu, cov_world, step.mag, step.dt)
    row.reliability = step.reliability
    row.mag_count = step.mag_count
    if not s.heading_known:
        step.flags |= FLAG_NO_HEADING
    if s.stamp <= s.align_until:
        step.flags |= FLAG_ALIGNING
    row.flags = step.flags
