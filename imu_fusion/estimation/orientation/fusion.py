"""Orientation from gyroscope, accelerometer and magnetometer: an error-state filter.

The attitude is carried on by every rate; about every ``fusion.block`` seconds a Kalman
update corrects it with what the modules of ``measurements`` observe.

Slow states beside the attitude: gyroscope bias, scale and misalignment, accelerometer
bias, the magnetometer's offset, matrix and lag. A gyroscope axis at its limit gets two
for what it does not show (clipped_rate).

This file is the order in which things are done (:func:`step`, :func:`correct`). What is done lies
beside it: first_state, prediction, measurements, error_state (the algebra), rest_detection,
forgetting, output.
"""

import math

import numpy as np

from imu_fusion.estimation.orientation import (
    clipped_rate,
    forgetting,
    gyro_limit,
    gyro_repeats,
    hard_iron,
    imu_rejection,
    mag_queue,
    output,
    prediction,
    rotation_history,
    spike,
    wander,
)
from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation.gyro_model import rate_of_turn
from imu_fusion.estimation.orientation.measurements import (
    back_in_range,
    bounded_motion,
    magnetometer,
    rest,
)
from imu_fusion.estimation.orientation.motion_scale import motion_scale
from imu_fusion.estimation.orientation.rest_detection import is_still, refuted_turn
from imu_fusion.estimation.orientation.rows import (
    FLAG_HELD,
    FLAG_MAG_DISTURBED,
    FLAG_MAG_USED,
    FLAG_SATURATED,
    FLAG_STILL,
    SATURATED_AXES_SHIFT,
)
from imu_fusion.estimation.orientation.state import MAG_SUM
from imu_fusion.geometry.rotation import quat_exp, quat_multiply, quat_normalize, quat_to_matrix
from imu_fusion.kernels import njit

_LAG_SDS = 3.0             # standard deviations within which a magnetometer lag is believed
# Of the block, while an axis is at its limit: its angular acceleration is forgotten in the time of
# two whole blocks.
_BURST_SHARE = 0.1
_DISTURBED = 0.5           # weight (10) below which a sample is flagged as disturbed
_NO_FIELD = 1e-9           # of its norm: a field without a horizontal part
_NO_BLOCK = np.zeros(1, es.PREDICTION)
_NO_SUM = np.zeros(1, MAG_SUM)


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
        forgetting.allow_for_gap(s, p)
    _take_mags(s, p)
    s.step.still = is_still(s, p)
    if s.step.still:
        s.step.flags |= FLAG_STILL
    elif s.rest.settled:
        turned = refuted_turn(s, p)
        if turned > 0.0:
            forgetting.realign(s, p, turned)
    result = 1
    length = p.fusion.block * (_BURST_SHARE if s.clipped else 1.0)
    if s.step.back or s.block.time >= length - 1e-6:
        _end_block(s, p, tape)
        result = 2
        s.clipped &= ~s.step.back
    for i in range(3):
        s.gyr_last[i] = s.step.gyr[i]
        s.force_last[i] = s.step.force[i]
    output.write(s, p, row, len(tape) > 0)
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
    stuck = gyro_repeats.is_stuck(s)    # before the search for limits takes the sample
    clipped = gyro_limit.find(s.gyro_limit, p.sensor.gyro_range, step.gyr[:])
    if clipped:
        step.flags |= FLAG_SATURATED | clipped << SATURATED_AXES_SHIFT
        s.counts.saturated += 1
    if stuck and not clipped:
        gyro_repeats.allow_for(s, p)
    elif spike.hold(s.gyro_spike, step.gyr[:], s.gyr_last[:], step.dt, spike.WILD_RATE,
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
def _carry(s, p):
    """Attitude over the step: trapezoidal rates with the coning term."""
    step = s.step
    rate_last = rate_of_turn(s, s.gyr_last)
    clipped_rate.carry(s, p)
    rate = rate_of_turn(s, step.gyr)
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
    prediction.collect(s, p, middle)


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
    lost = s.clipped or s.gyro_repeats.is_stuck
    if p.seeks_iron and (lost or s.step.dt > p.gap.max):
        hard_iron.interrupt(s.hard_iron)
    for n in range(count):
        sample = taken[n]
        if p.seeks_iron and not lost:
            then = quat_multiply(s.history.quat, sample.turn)
            if hard_iron.add(s.hard_iron, s.stamp, then, sample.field):
                s.iron_shown = True
        for i in range(3):
            sample.field[i] -= s.hard_iron.taken_off[i]
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
    prediction.finish(s, p)
    if len(tape):
        tape[0].count = 0
        tape[0].prediction = s.block
    # A plain array: the algebra is compiled once for all that it is used on.
    es.predict(s.cov[:], s.block)
    error = np.zeros(es.N)
    known, placed = s.log_likelihood, s.position_likelihood
    correct(s, p, error, tape)
    if s.clipped or s.was_clipped or s.gyro_repeats.is_stuck:
        # What the rate was is a guess: its misfit is no evidence of the surroundings.
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
