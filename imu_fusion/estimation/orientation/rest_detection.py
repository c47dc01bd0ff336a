"""When the sensor is at rest."""

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.kernels import njit

REST_MEMORY = 0.25        # s, of the means that the rest detector compares with
_REST_TURN = 1.5e-3       # rad/s per axis: slower turning than 0.5 deg/s passes as rest
_SDS2 = 9.0               # squared standard deviations of the bias within which a mean rate is bias


@njit
def is_still(s, p):
    """Rest: rate and force have kept to their short-term means, and the mean rate is bias.

    Slow turning is told from rest by the bias' own uncertainty.
    """
    rest, step = s.rest, s.step
    part = min(step.dt / REST_MEMORY, 1.0)
    rate2 = 0.0
    force2 = 0.0
    mean2 = 0.0
    limit2 = 0.0
    for i in range(3):
        rest.mean_rate[i] += part * (step.gyr[i] - rest.mean_rate[i])
        rest.mean_force[i] += part * (step.force[i] - rest.mean_force[i])
        rate2 += (step.gyr[i] - rest.mean_rate[i]) ** 2
        force2 += (step.force[i] - rest.mean_force[i]) ** 2
        mean2 += (rest.mean_rate[i] - s.gyro_bias[i]) ** 2
        limit2 += s.cov[es.GYRO_BIAS + i, es.GYRO_BIAS + i] + _REST_TURN ** 2
    if (rate2 > p.fusion.rest_rate ** 2 or force2 > p.rest_force ** 2
            or mean2 > _SDS2 * limit2):
        rest.since = s.stamp
    return s.stamp - rest.since > p.fusion.rest_time * 1e9
