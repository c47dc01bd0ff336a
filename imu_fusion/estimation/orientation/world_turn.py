"""Turns of the world's axes about up, where no field has been seen: nothing tells its heading."""

import math

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.geometry.rotation import quat_conjugate, quat_exp, quat_multiply, quat_rotate
from imu_fusion.kernels import njit


@njit
def turn_world(s, angle):
    """Turn attitude and motion by ``angle`` (rad). Returns the turn, xyzw."""
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
    return turn


@njit
def face_alike(state, best):
    """Give all hypotheses (k,) the heading of one: which of them is the likeliest may change, and a
    heading that nothing tells would then jump."""
    for k in range(len(state)):
        if k != best:
            apart = quat_multiply(state[best].quat_world_imu,
                                  quat_conjugate(state[k].quat_world_imu))
            turn_world(state[k], 2.0 * math.atan2(apart[2], apart[3]))
