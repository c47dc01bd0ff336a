"""The first sample of a gyroscope axis back within its limit tells what its clipped rate was."""

from imu_fusion.kernels import njit

from imu_fusion.estimation.orientation import error_state as es

NAME = "back in range"
# rad/s: what the rate changes by from the last clipped sample to the first that is not, beyond the
# step that is seen: 20 rad/s^2 over 5 ms.
_BACK_SD = 0.1


@njit
def clipped_rate(i, s, row):
    """Row of the clipped rate of gyroscope axis i."""
    es.put_single(row, es.CLIPPED_RATE + i,
                  s.step.gyr[i] - s.gyr_last[i] - s.clipped_rate[i], _BACK_SD ** 2)
