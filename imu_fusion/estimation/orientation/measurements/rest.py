"""At rest the mean rate is the gyroscope's bias. (That velocity is zero, bounded_motion says.)

Columns of the scale are left out: they are the mean rate at rest itself, the bias of 0.01 rad/s.
"""

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation.rest_detection import REST_MEMORY
from imu_fusion.kernels import njit

NAME = "rest"


@njit
def gyro_bias(i, s, p, row):
    """Row of the bias of gyroscope axis i: the low-passed rate, scaled, less the bias."""
    rate = s.rest.mean_rate[i]
    for j in range(3):
        rate += s.gyro_scale[i, j] * s.rest.mean_rate[j]
    es.put_single(row, es.GYRO_BIAS + i, rate - s.gyro_bias[i],
                  p.fusion.rest_rate_sd ** 2 * REST_MEMORY / s.block.time)
