"""Motion and measurement model of the smoother, and their derivatives (numba).

State of a sample, one row of ``x``: position 0:3 and velocity 3:6 in the world, attitude
quaternion 6:10, gyroscope bias 10:13, accelerometer bias 13:16, then the optional states
that a layout places. The error state is one shorter (rotation vector 6:9 in sensor axes):
error index i >= 9 belongs to x[i + 1].

Between two samples the mean of their rates and forces holds. The position follows from
the velocities by the trapezoidal rule, so its derivative needs no storage of its own.
"""

import numpy as np
from imu_fusion.kernels import njit

from imu_fusion.geometry.gravity import gravity_world
from imu_fusion.geometry.rotation import (
    quat_exp, quat_multiply, quat_normalize, quat_to_matrix, right_jacobian)

POS, VEL, ATT, GYR_BIAS, ACC_BIAS, CORE = 0, 3, 6, 9, 12, 15

#: Optional blocks of the error state, in their order, with their sizes.
BLOCKS = (("mag_bias", 3), ("mag_scale", 3), ("gnss_position_error", 3),
          ("gnss_time_offset", 1), ("velocity_time_offset", 1), ("acc_matrix", 9),
          ("gyr_scale", 3), ("gnss_lever_arm", 3), ("body_height", 1), ("surface_lever_arm", 3),
          ("gnss_velocity_error", 3))
(MAG_BIAS, MAG_SCALE, GNSS_ERROR, TIME_OFFSET, VELOCITY_OFFSET, ACC_MATRIX, GYR_SCALE,
 LEVER_ARM, BODY_HEIGHT, SURFACE_ARM, GNSS_VELOCITY_ERROR) = range(len(BLOCKS))

FIX, VELOCITY, MAG = 0, 1, 2


def make_layout(present):
    """First error index of each block, -1 where absent, and the size of the error state."""
    layout, size = np.full(len(BLOCKS), -1), CORE
    for i, (name, width) in enumerate(BLOCKS):
        if name in present:
            layout[i] = size
            size += width
    return layout, size


@njit
def _cross_matrix(m, v, scale, out, row, column):
    """out[row:row+3, column:column+3] = scale * m @ [v]x."""
    for i in range(3):
        out[row + i, column] = scale * (m[i, 1] * v[2] - m[i, 2] * v[1])
        out[row + i, column + 1] = scale * (m[i, 2] * v[0] - m[i, 0] * v[2])
        out[row + i, column + 2] = scale * (m[i, 0] * v[1] - m[i, 1] * v[0])


@njit
def _product(a, b):
    """a @ b for 3 x 3 matrices (the library call costs more than the product)."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
    return out


@njit
def interval(x, gyr, acc, dt, gravity, spin, decay, layout, f_vel, f_att, x_next, rate,
             force_world):
    """Carry the state x over one interval; derivatives of velocity and attitude.

    The rotation of the Earth enters as a known rate and the Coriolis acceleration; their
    own derivatives (1e-4 per second) are left out of the transition.

    Args:
        x: state (n + 1,).
        gyr, acc: means over the interval (3,).
        dt: s.
        gravity: m/s^2 at the origin.
        spin: (3,) Earth rate in the world, rad/s.
        decay: (n,) factors of the slow states over the interval.
        layout: first index of the optional blocks.
        f_vel, f_att: (3, n), rows of the transition matrix; f_vel without the identity of the
            velocity itself. Entries that no block uses stay zero.
        x_next: (n + 1,) result.
        rate: (3,) corrected rate against the world, result.
        force_world: (3,) acceleration, result.

    Returns:
        Rotation matrices R_world_imu (3, 3) at the start and in the middle.
    """
    force = np.empty(3)
    for i in range(3):
        rate[i] = gyr[i] - x[10 + i]
        force[i] = acc[i] - x[13 + i]
    if layout[GYR_SCALE] >= 0:
        for i in range(3):
            rate[i] += x[layout[GYR_SCALE] + 1 + i] * gyr[i]
    if layout[ACC_MATRIX] >= 0:
        for i in range(3):
            for j in range(3):
                force[i] += x[layout[ACC_MATRIX] + 1 + 3 * i + j] * acc[j]
    start = quat_to_matrix(x[6:10])
    for i in range(3):
        for j in range(3):
            rate[i] -= start[j, i] * spin[j]
    turn = rate * dt
    half = quat_exp(turn, 0.5)
    middle_quat = quat_multiply(x[6:10], half)
    half_turn = quat_to_matrix(half)
    middle = _product(start, half_turn)
    g = gravity_world(x[0:3], gravity)
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        g[i] -= 2.0 * (spin[a] * x[3 + b] - spin[b] * x[3 + a])
        force_world[i] = (middle[i, 0] * force[0] + middle[i, 1] * force[1]
                          + middle[i, 2] * force[2] + g[i])
        x_next[i] = x[i] + dt * (x[3 + i] + 0.5 * dt * force_world[i])
        x_next[3 + i] = x[3 + i] + dt * force_world[i]
    x_next[6:10] = quat_normalize(quat_multiply(middle_quat, half))
    for i in range(9, len(decay)):
        x_next[i + 1] = decay[i] * x[i + 1]

    # Attitude: Exp(-turn) of the old error, and the right Jacobian of the rate's.
    whole_turn = _product(half_turn, half_turn)
    jacobian = right_jacobian(turn)
    # Velocity: the error of the attitude in the middle is that of the start, turned by half.
    lever = np.empty((3, 3))
    _cross_matrix(middle, force, -dt, lever, 0, 0)
    for i in range(3):
        for j in range(3):
            f_att[i, ATT + j] = whole_turn[j, i]
            f_att[i, GYR_BIAS + j] = -dt * jacobian[i, j]
            f_vel[i, ATT + j] = (lever[i, 0] * half_turn[j, 0] + lever[i, 1] * half_turn[j, 1]
                                 + lever[i, 2] * half_turn[j, 2])
            f_vel[i, GYR_BIAS + j] = -0.5 * dt * lever[i, j]
            f_vel[i, ACC_BIAS + j] = -dt * middle[i, j]
    if layout[GYR_SCALE] >= 0:
        k = layout[GYR_SCALE]
        for j in range(3):
            for i in range(3):
                f_att[i, k + j] = dt * jacobian[i, j] * gyr[j]
                f_vel[i, k + j] = 0.5 * dt * lever[i, j] * gyr[j]
    if layout[ACC_MATRIX] >= 0:
        for j in range(3):
            for i in range(3):
                for r in range(3):
                    f_vel[r, layout[ACC_MATRIX] + 3 * i + j] = dt * middle[r, i] * acc[j]
    return start, middle


@njit
def _scale_columns(x, rate, layout, h):
    """Columns of the gyroscope's scale in h (3, n), while those of its bias hold what the rate
    alone does: the scale enters the rate with the other sign, times the reading."""
    if layout[GYR_SCALE] >= 0:
        for j in range(3):
            # The reading that gave the rate, but for the Earth's (7e-5 rad/s).
            gyr = (rate[j] + x[10 + j]) / (1.0 + x[layout[GYR_SCALE] + 1 + j])
            for i in range(3):
                h[i, layout[GYR_SCALE] + j] = -gyr * h[i, GYR_BIAS + j]


@njit
def predict_fix(x, tau, rate, force_world, rotation, lever, layout, h):
    """Antenna position (3,) at ``tau`` after the sample, and its derivative h (3, n).

    The acceleration's derivatives times tau^2 / 2 are left out (:func:`predict_mag` says what
    that does): at 10 ms 5e-5 m per m/s^2 of bias, 0.005 sd with 300 fixes good to 1 cm.
    """
    cross = np.empty(3)
    cross[0] = rate[1] * lever[2] - rate[2] * lever[1]
    cross[1] = rate[2] * lever[0] - rate[0] * lever[2]
    cross[2] = rate[0] * lever[1] - rate[1] * lever[0]
    arm = lever + tau * cross
    predicted = np.empty(3)
    for i in range(3):
        predicted[i] = (x[i] + tau * (x[3 + i] + 0.5 * tau * force_world[i])
                        + rotation[i, 0] * arm[0] + rotation[i, 1] * arm[1]
                        + rotation[i, 2] * arm[2])
        h[i, POS + i] = 1.0
        h[i, VEL + i] = tau
    _cross_matrix(rotation, arm, -1.0, h, 0, ATT)
    _cross_matrix(rotation, lever, tau, h, 0, GYR_BIAS)
    _scale_columns(x, rate, layout, h)
    if layout[GNSS_ERROR] >= 0:
        for i in range(3):
            predicted[i] += x[layout[GNSS_ERROR] + 1 + i]
            h[i, layout[GNSS_ERROR] + i] = 1.0
    if layout[TIME_OFFSET] >= 0:
        for i in range(3):
            h[i, layout[TIME_OFFSET]] = -(x[3 + i] + tau * force_world[i]
                                          + rotation[i, 0] * cross[0] + rotation[i, 1] * cross[1]
                                          + rotation[i, 2] * cross[2])
    if layout[LEVER_ARM] >= 0:
        _cross_matrix(rotation, rate, tau, h, 0, layout[LEVER_ARM])
        h[:, layout[LEVER_ARM]:layout[LEVER_ARM] + 3] += rotation
    return predicted


@njit
def predict_velocity(x, tau, dt, rate, force_world, rotation, f_vel, columns, lever, layout, h):
    """Antenna velocity (3,) at ``tau`` after the sample, and its derivative h (3, n)."""
    cross = np.empty(3)
    cross[0] = rate[1] * lever[2] - rate[2] * lever[1]
    cross[1] = rate[2] * lever[0] - rate[0] * lever[2]
    cross[2] = rate[0] * lever[1] - rate[1] * lever[0]
    predicted = np.empty(3)
    _cross_matrix(rotation, cross, -1.0, h, 0, ATT)
    _cross_matrix(rotation, lever, 1.0, h, 0, GYR_BIAS)
    _scale_columns(x, rate, layout, h)
    if tau != 0.0:
        for i in range(3):
            for c in columns:
                h[i, c] += tau / dt * f_vel[i, c]
    for i in range(3):
        predicted[i] = (x[3 + i] + tau * force_world[i] + rotation[i, 0] * cross[0]
                        + rotation[i, 1] * cross[1] + rotation[i, 2] * cross[2])
        h[i, VEL + i] = 1.0
    if layout[GNSS_VELOCITY_ERROR] >= 0:
        for i in range(3):
            predicted[i] += x[layout[GNSS_VELOCITY_ERROR] + 1 + i]
            h[i, layout[GNSS_VELOCITY_ERROR] + i] = 1.0
    for block in (TIME_OFFSET, VELOCITY_OFFSET):
        if layout[block] >= 0:
            for i in range(3):
                h[i, layout[block]] = -force_world[i]
    if layout[LEVER_ARM] >= 0:
        _cross_matrix(rotation, rate, 1.0, h, 0, layout[LEVER_ARM])
    return predicted


@njit
def predict_mag(x, tau, rate, rotation, field_world, layout, h):
    """Magnetometer reading (3,) at ``tau`` after the sample (Fang 2020, eq. 50), and h (3, n).

    With the field F in sensor axes: (1 + s) (F - tau w x F) + b. What the errors of the
    gyroscope turn F by within tau (0.5 uT per rad/s at 10 ms) is left out of h. Residuals are
    exact, so N readings whose entries lack e shift a state by some sqrt(N) e sd / sigma of its
    standard deviation sd: 0.005 for the bias in a jump (N 2700, sigma 5 uT, sd 1e-3 rad/s).
    """
    field = np.empty(3)
    for i in range(3):
        field[i] = (rotation[0, i] * field_world[0] + rotation[1, i] * field_world[1]
                    + rotation[2, i] * field_world[2])
    turned = np.empty(3)
    turned[0] = field[0] - tau * (rate[1] * field[2] - rate[2] * field[1])
    turned[1] = field[1] - tau * (rate[2] * field[0] - rate[0] * field[2])
    turned[2] = field[2] - tau * (rate[0] * field[1] - rate[1] * field[0])
    predicted = np.empty(3)
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        scale = 1.0 + x[layout[MAG_SCALE] + 1 + i]
        predicted[i] = scale * turned[i] + x[layout[MAG_BIAS] + 1 + i]
        h[i, ATT + a] = -scale * field[b]
        h[i, ATT + b] = scale * field[a]
        h[i, layout[MAG_SCALE] + i] = turned[i]
        h[i, layout[MAG_BIAS] + i] = 1.0
    if tau != 0.0:
        along = tau * (rate[0] * field[0] + rate[1] * field[1] + rate[2] * field[2])
        for i in range(3):
            # An error d of the attitude turns F by F x d, and w x (F x d) = F (w d) - d (w F).
            scale = 1.0 + x[layout[MAG_SCALE] + 1 + i]
            for j in range(3):
                h[i, ATT + j] -= scale * tau * field[i] * rate[j]
            h[i, ATT + i] += scale * along
    return predicted
