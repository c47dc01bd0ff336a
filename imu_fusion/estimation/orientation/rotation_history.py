"""The last rotations, from the gyroscope alone.

Magnetometer samples are used at the time they belong to. A ring of the last
rotations, integrated from the rates alone (no corrections, hence no jumps),
carries a sample from its own time to the newest Imu sample: that is how sensor
delays, late arrival and different rates are all handled by one mechanism.
"""

from imu_fusion.estimation.orientation.state import HISTORY_LENGTH
from imu_fusion.geometry.rotation import (
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_normalize,
)
from imu_fusion.kernels import njit


@njit
def rotation_of_step(rate, rate_next, dt):
    """Rotation vector (3,) of a step over which the rate changes linearly.

    The second term is that of coning: without it the error is of second order in dt
    where the axis of rotation moves.
    """
    mean, coning = 0.5 * dt, dt * dt / 12.0
    a, b = rate, rate_next
    return (mean * (a[0] + b[0]) + coning * (a[1] * b[2] - a[2] * b[1]),
            mean * (a[1] + b[1]) + coning * (a[2] * b[0] - a[0] * b[2]),
            mean * (a[2] + b[2]) + coning * (a[0] * b[1] - a[1] * b[0]))


@njit
def push(history, stamp, turn):
    """Turn the chain by a quaternion (4,), imu axes, and remember it at ``stamp``."""
    turned = quat_normalize(quat_multiply(history.quat, turn))
    slot = history.count % HISTORY_LENGTH
    for i in range(4):
        history.quat[i] = turned[i]
        history.quats[slot, i] = turned[i]
    history.stamps[slot] = stamp
    history.count += 1


@njit
def look_back(history, stamp, taken):
    """How the sensor has turned since ``stamp``.

    Writes the quaternion q with ``v_imu_now = rotate(q, v_imu_then)`` to ``taken.turn`` and the
    rate of turn at that time, rad/s, to ``taken.rate``. Returns False where the history does not
    reach back that far.
    """
    newer = -1
    for back in range(min(history.count, HISTORY_LENGTH)):
        slot = (history.count - 1 - back) % HISTORY_LENGTH
        here = history.stamps[slot]
        if here < stamp or (here == stamp and (newer >= 0 or history.count == 1)):
            then = history.quats[slot]
            since = quat_multiply(quat_conjugate(history.quat), then)
            for i in range(3):
                taken.rate[i] = 0.0
            if newer >= 0:
                step = quat_log(quat_multiply(quat_conjugate(then), history.quats[newer]))
                span = history.stamps[newer] - here
                for i in range(3):
                    taken.rate[i] = step[i] / (span * 1e-9)
                since = quat_multiply(since, quat_exp(step, (stamp - here) / span))
            for i in range(4):
                taken.turn[i] = since[i]
            return True
        newer = slot
    return False
