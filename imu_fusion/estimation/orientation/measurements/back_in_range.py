"""The first sample of a gyroscope axis back within its limit tells what its clipped rate was."""

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.kernels import njit

NAME = "back in range"
# rad/s. Small beside what is known of the clipped rate before: with the default angular_acc_sd,
# 2 rad/s after 10 ms.
_BACK_SD = 0.1


@njit
def clipped_rate(i, s, row):
    """Row of the clipped rate of gyroscope axis i."""
    es.put_single(row, es.CLIPPED_RATE + i,
                  s.step.gyr[i] - s.gyr_last[i] - s.clipped_rate[i], _BACK_SD ** 2)
