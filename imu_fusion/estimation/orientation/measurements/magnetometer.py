"""The magnetometer in the fusion filter: first field, heading, the samples of a block.

The field in world axes is constant but for a drift, and for a local part that is frozen while
the sensor rests and forgotten as it moves. Samples weigh less the more their norm deviates, and
the more they differ from what was expected.
"""

import math

import numpy as np

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.geometry.rotation import (
    quat_exp,
    quat_multiply,
    quat_rotate,
    quat_rotate_inverse,
    quat_to_matrix,
)
from imu_fusion.kernels import njit

NAME = "magnetometer"
_FIRST_FIELD_SD = 2e-3     # relative: noise of the field that the alignment averages
_HORIZONTAL_SHARE = 0.02   # of the field; below, heading is noise: the magnetic poles
_WHITE_TIME = 0.02         # s: faster sampling of the same disturbance is no news
# Degrees of freedom of the residual's distribution. Few, since the errors of a field indoors
# are no Gaussian's; from 3 to 9 nothing depends on it.
_TAIL_DOF = 5.0
# Columns: attitude (2), field, local field, lag, offset (3), matrix (9).
_LAG, _OFFSET, _MATRIX, _COLUMNS = 4, 5, 8, 17
_EXPECTED_BLOCKS = 500     # in motion, some 10 s: as much as they tell of places, a hypothesis does
_FIRST_BLOCKS = 50         # in motion: three places, whose mean begins the scatter
_IRON = 12                 # states of hard and soft iron


@njit
def start_field(s, p, z, has_heading, follow):
    """Begin the field states with ``z`` (3,) tesla, measured here and now, world axes.

    The first sample makes the field share the tilt's error. With ``has_heading`` the
    heading has no error but a constant one, or with ``follow`` = 1 one that is known as well
    as tilt and calibration, and is corrected when these are.
    """
    cov = s.cov
    s.field_norm = math.sqrt(z[0] ** 2 + z[1] ** 2 + z[2] ** 2)
    s.first_tilt_var = _turned_by_tilt(cov, z)
    s.field_scatter, s.scattered = _usual_scatter(p), 0
    b = (z[0] / s.field_norm, z[1] / s.field_norm, z[2] / s.field_norm)
    for i in range(3):
        s.field[i] = b[i]
    for i in range(es.FIELD, es.MAG_OFFSET):
        cov[i, :] = 0.0
        cov[:, i] = 0.0
        cov[i, i] = 1.0 if i < es.LOCAL_FIELD else p.local_field_sd ** 2
    if has_heading:
        cov[es.ATTITUDE + 2, es.ATTITUDE + 2] += follow
        s.heading_known = True
        s.is_anchored = follow == 0.0
        s.heading_var = p.heading_sd ** 2
    _share_errors(s, p, b, has_heading, follow)
    judge_anchor(s, p)


@njit
def _turned_by_tilt(cov, z):
    """Variance of what the error of the tilt turns the needle of ``z`` (3,), world axes, by: where
    the field is steep, much of what is vertical is taken for horizontal."""
    steep = z[2] / max(z[0] ** 2 + z[1] ** 2, (_HORIZONTAL_SHARE * z[2]) ** 2)
    variance = 0.0
    for i in range(2):
        for j in range(2):
            variance += z[i] * cov[es.ATTITUDE + i, es.ATTITUDE + j] * z[j]
    return variance * steep ** 2


@njit
def _share_errors(s, p, b, has_heading, follow):
    """Updates that make field, attitude and calibration share the first sample's error."""
    r = quat_to_matrix(s.quat_world_imu)
    m = quat_rotate_inverse(s.quat_world_imu, b)
    row = s.row    # of the state: a numba record does not keep an array of its own alive
    error = np.zeros(es.N)
    no_tape = np.empty(0, es.TAPE)
    row.residual, row.variance = 0.0, _FIRST_FIELD_SD ** 2
    for c in range(3):
        # What iron turns the needle by: across the field and horizontal.
        s.anchor[c] = ((b[0] * r[1, c] - b[1] * r[0, c])
                       / max(b[0] ** 2 + b[1] ** 2, _HORIZONTAL_SHARE ** 2))
        for d in range(3):
            s.anchor[3 + 3 * c + d] = s.anchor[c] * m[d]
    for i in range(3):
        _put_columns(row, i, b)
        row.coefficient[_LAG] = 0.0
        for c in range(3):
            row.coefficient[_OFFSET + c] = r[i, c] * follow
            for d in range(3):
                row.coefficient[_MATRIX + 3 * c + d] = r[i, c] * m[d] * follow
        es.update(s.cov, error, es.N, row, no_tape)
    if has_heading and follow:
        # North is where the field of the surroundings points, to azimuth D: nothing across it.
        # What the place of the first sample adds turns the needle that it shows.
        row.count = 2
        row.index[0], row.index[1] = es.FIELD, es.FIELD + 1
        row.coefficient[0], row.coefficient[1] = math.cos(p.declination), -math.sin(p.declination)
        es.update(s.cov, error, es.N, row, no_tape)


@njit
def judge_anchor(s, p):
    """Variance of an anchored heading, which no later sample changes.

    Beside its own it has what the first tilt's error, the place and hard and soft iron turned the
    first needle by, iron so far as it is known by now: what it is found to be, and what that leaves
    open. The filter takes the first needle for true, hence iron for zero in that one pose, and of
    each state keeps only what that leaves open. That much of its variance is no knowledge: it
    counts as the prior until turning has made it smaller.
    """
    if not s.is_anchored:
        return    # start_field's
    hard, soft = p.fusion.mag_offset_sd ** 2, p.fusion.mag_matrix_sd ** 2
    one_pose = hard * soft / (hard + soft) if hard + soft > 0.0 else 0.0
    turned = 0.0
    variance = 0.0
    for i in range(3):    # of what was taken off, which is not the prior's
        for j in range(3):
            variance += s.anchor[i] * s.hard_iron.cov[i, j] * s.anchor[j]
    for a in range(_IRON):
        i = _iron_index(a)
        turned += s.anchor[a] * (s.mag_offset[a] if a < 3 else
                                 s.mag_matrix[(a - 3) // 3, (a - 3) % 3])
        open_part = min(s.cov[i, i] / one_pose, 1.0) if one_pose > 0.0 else 1.0
        variance += s.anchor[a] ** 2 * open_part * (hard if a < 3 else soft)
    place = _place_variance(s, p) * (s.anchor[0] ** 2 + s.anchor[1] ** 2 + s.anchor[2] ** 2)
    s.heading_var = min(p.heading_sd ** 2 + s.first_tilt_var + place + turned ** 2 + variance,
                        es.UNIFORM_VARIANCE)


@njit
def doubt_first_needle(s, p):
    """Let a heading that begins in motion have the variance of what places are known to do."""
    if not s.is_anchored:
        place = _place_variance(s, p) * (s.anchor[0] ** 2 + s.anchor[1] ** 2 + s.anchor[2] ** 2)
        s.heading_var = min(s.heading_var + place, es.UNIFORM_VARIANCE)


@njit
def _place_variance(s, p):
    """Variance of what the place of the first needle added to it, beyond what is usual: what places
    are found to do, and at first what the hypothesis expects of them."""
    expected = p.local_field_sd ** 2 - p.fusion.local_field_sd[0] ** 2
    return max(s.field_scatter - _usual_scatter(p),
               expected * _EXPECTED_BLOCKS / (_EXPECTED_BLOCKS + s.scattered), 0.0)


@njit
def _usual_scatter(p):
    """Mean square per axis of a sample about the field where nothing is near."""
    return (p.fusion.local_field_sd[0] ** 2 + p.fusion.mag_disturbance_sd ** 2
            + p.fusion.mag_offset_sd ** 2 + p.fusion.mag_matrix_sd ** 2)


@njit
def _iron_index(a):
    """Of hard (3) and soft iron (9), in the error state."""
    return es.MAG_OFFSET + a if a < 3 else es.MAG_MATRIX + a - 3


@njit
def _put_columns(row, i, field):
    """Columns of component i of the field: attitude, field and local field; indices of all."""
    j, m = (i + 1) % 3, (i + 2) % 3
    row.count = _COLUMNS
    row.index[0], row.coefficient[0] = es.ATTITUDE + m, field[j]
    row.index[1], row.coefficient[1] = es.ATTITUDE + j, -field[m]
    row.index[2], row.coefficient[2] = es.FIELD + i, 1.0
    row.index[3], row.coefficient[3] = es.LOCAL_FIELD + i, 1.0
    row.index[_LAG] = es.MAG_LAG
    for c in range(3):
        row.index[_OFFSET + c] = es.MAG_OFFSET + c
    for c in range(9):
        row.index[_MATRIX + c] = es.MAG_MATRIX + c


@njit
def _fix_heading(s, p, z):
    """Turn the world about up so that ``z`` (3,) tesla, world axes, points magnetic north."""
    s.world_turned = True
    horizontal = math.hypot(z[0], z[1])
    norm = math.sqrt(horizontal ** 2 + z[2] ** 2)
    known = horizontal >= _HORIZONTAL_SHARE * norm
    # The needle points to azimuth D: east sin D, north cos D.
    angle = 0.5 * math.pi - p.declination - math.atan2(z[1], z[0]) if known else 0.0
    turn = quat_exp((0.0, 0.0, angle), 1.0)
    s.quat_world_imu[:] = quat_multiply(turn, s.quat_world_imu)
    s.velocity[:] = quat_rotate(turn, s.velocity)
    s.position[:] = quat_rotate(turn, s.position)
    cov = s.cov
    for group in (es.ATTITUDE, es.VELOCITY, es.POSITION):
        for j in range(es.N):
            cov[group:group + 3, j] = quat_rotate(turn, cov[group:group + 3, j])
        for j in range(es.N):
            cov[j, group:group + 3] = quat_rotate(turn, cov[j, group:group + 3])
    # The sensor may be moving: what it shows now is no anchor.
    start_field(s, p, quat_rotate(turn, z), known, 1.0 if known else 0.0)


@njit
def _calibrated(s, raw):
    """A sample relative to the field's norm, less offset and soft iron as known so far: a tuple."""
    offset, matrix = s.mag_offset, s.mag_matrix
    return (raw[0] - offset[0] - matrix[0, 0] * raw[0] - matrix[0, 1] * raw[1]
            - matrix[0, 2] * raw[2],
            raw[1] - offset[1] - matrix[1, 0] * raw[0] - matrix[1, 1] * raw[1]
            - matrix[1, 2] * raw[2],
            raw[2] - offset[2] - matrix[2, 0] * raw[0] - matrix[2, 1] * raw[1]
            - matrix[2, 2] * raw[2])


@njit
def collect(s, p, taken, count):
    """Add magnetometer samples to the block.

    taken: mag_queue.TAKEN (count,), at least one. Their mean in present imu axes goes to
    ``s.step.mag``, its weight (10) to ``s.step.reliability``.
    """
    if s.field_norm == 0.0:
        _fix_heading(s, p, quat_rotate(quat_multiply(s.quat_world_imu, taken[0].turn),
                                       taken[0].field))
    norm, total, quat = s.field_norm, s.mag_sum, s.quat_world_imu
    mean = (0.0, 0.0, 0.0)
    for n in range(count):
        sample = taken[n]
        raw = (sample.field[0] / norm, sample.field[1] / norm, sample.field[2] / norm)
        m = _calibrated(s, raw)
        rate = sample.rate
        r = quat_to_matrix(quat_multiply(quat, sample.turn))
        drag = (rate[1] * m[2] - rate[2] * m[1], rate[2] * m[0] - rate[0] * m[2],
                rate[0] * m[1] - rate[1] * m[0])
        for i in range(3):
            for j in range(3):
                total.field[i] += r[i, j] * m[j]
                total.lag[i] += r[i, j] * drag[j]
                total.offset[i, j] += r[i, j]
                for c in range(3):
                    total.matrix[i, 3 * j + c] += r[i, j] * raw[c]
        now = quat_rotate(sample.turn, m)
        mean = (mean[0] + now[0] / count, mean[1] + now[1] / count, mean[2] + now[2] / count)
        total.count += 1
    for i in range(3):
        s.step.mag[i] = mean[i] * norm
    size = math.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2)
    s.step.reliability = math.exp(-(p.mag.reliability * (1.0 - size)) ** 2)


@njit
def field(s, p, error, rows):
    """Rows (3,) of the block's mean sample against the field.

    The noise is Student's t: the further the sample is from what was expected (error (N,): the
    error state so far), the less it weighs, however its norm may look.
    """
    total = s.mag_sum
    count = total.count
    z = (total.field[0] / count, total.field[1] / count, total.field[2] / count)
    expected = (s.field[0] + s.local_field[0], s.field[1] + s.local_field[1],
                s.field[2] + s.local_field[2])
    if not s.step.still:    # at rest a place repeats itself
        _judge_scatter(s, z)
    deviation = abs(math.sqrt(z[0] ** 2 + z[1] ** 2 + z[2] ** 2) - 1.0)
    sd = p.fusion.mag_disturbance_sd + p.fusion.norm_deviation_factor * deviation
    variance = (sd * sd * max(_WHITE_TIME / s.block.time, 1.0 / count)
                + (p.sensor.mag_noise_sd / s.field_norm) ** 2 / count)
    for i in range(3):
        row = rows[i]
        _put_columns(row, i, expected)
        row.residual = z[i] - expected[i]
        row.coefficient[_LAG] = total.lag[i] / count
        for c in range(3):
            row.coefficient[_OFFSET + c] = total.offset[i, c] / count
        for c in range(9):
            row.coefficient[_MATRIX + c] = total.matrix[i, c] / count
    distance, log_det = _innovation(s.cov, error, rows, variance)
    # Of the t distribution, less what is the same for all hypotheses.
    s.log_likelihood -= 0.5 * (log_det + (_TAIL_DOF + 3.0) * math.log1p(distance / _TAIL_DOF))
    variance *= (_TAIL_DOF + distance) / (_TAIL_DOF + 3.0)
    for i in range(3):
        rows[i].variance = variance


@njit
def _judge_scatter(s, z):
    """Take the field z (3,) of one block into its mean square about that of the surroundings: as
    the scale of a t distribution, in which a magnet that is passed counts little."""
    s.scattered += 1
    off = ((z[0] - s.field[0]) ** 2 + (z[1] - s.field[1]) ** 2 + (z[2] - s.field[2]) ** 2) / 3.0
    weight = 1.0
    if s.scattered > _FIRST_BLOCKS:
        scale = max(s.field_scatter, _FIRST_FIELD_SD ** 2)
        weight = (_TAIL_DOF + 3.0) / (_TAIL_DOF + 3.0 * off / scale)
    s.field_scatter += (weight * off - s.field_scatter) / s.scattered


@njit
def _innovation(cov, error, rows, variance):
    """Squared Mahalanobis distance of the innovation of rows (3,), and its covariance's log
    determinant; ``variance``: of each row's noise. error (N,): the error state so far."""
    total = np.empty((3, 3))
    residual = np.empty(3)
    for i in range(3):
        row = rows[i]
        residual[i] = row.residual
        spread = es.spread_of(cov, row, es.N)
        for a in range(_COLUMNS):
            residual[i] -= row.coefficient[a] * error[row.index[a]]
        for j in range(i + 1):
            other = rows[j]
            total[i, j] = variance if i == j else 0.0
            for b in range(_COLUMNS):
                total[i, j] += other.coefficient[b] * spread[other.index[b]]
    distance = 0.0
    log_det = 0.0
    # Cholesky's factor in place, and the residual through it.
    for i in range(3):
        for j in range(i + 1):
            part = total[i, j]
            for k in range(j):
                part -= total[i, k] * total[j, k]
            total[i, j] = math.sqrt(part) if i == j else part / total[j, j]
        for k in range(i):
            residual[i] -= total[i, k] * residual[k]
        residual[i] /= total[i, i]
        distance += residual[i] ** 2
        log_det += 2.0 * math.log(total[i, i])
    return distance, log_det
