"""Velocity and position of the motion stay bounded about their means.

Zero-mean pseudo-measurements with the standard deviations and correlation times of the motion.
Gravity's direction follows from that, without ever taking the specific force for gravity.
"""

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.kernels import njit

NAME = "bounded motion"
_REST_SPEED_SD = 0.003     # m/s, over 20 ms: a sensor that rests in a quiet hand
_WHITE_TIME = 0.02         # s


@njit
def velocity(i, s, p, scale, row):
    """Row of the velocity along world axis i. scale: of motion_scale.

    At equal accelerations times grow as velocities do, and extents as their square.
    """
    f, time = p.fusion, s.block.time
    variance = (_REST_SPEED_SD ** 2 * _WHITE_TIME / time if s.step.still
                else scale ** 3 * f.velocity_sd ** 2 * max(f.velocity_time / time, 1.0))
    es.put_single(row, es.VELOCITY + i, -s.velocity[i], variance)


@njit
def position(i, s, p, scale, row):
    """Row of the position along world axis i, likewise."""
    f, time = p.fusion, s.block.time
    es.put_single(row, es.POSITION + i, -s.position[i],
                  scale ** 5 * f.position_sd ** 2 * max(f.position_time / time, 1.0))
