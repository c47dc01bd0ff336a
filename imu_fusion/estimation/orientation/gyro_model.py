"""What the gyroscope's raw rates say of the turn, with all that is known of the gyroscope."""

from imu_fusion.kernels import njit


@njit
def rate_of_turn(s, gyr):
    """Rate of turn, a tuple, from a raw one, with bias, scale and clipped rate."""
    bias, clipped, scale = s.gyro_bias, s.clipped_rate, s.gyro_scale
    return (gyr[0] - bias[0] + clipped[0] + scale[0, 0] * gyr[0] + scale[0, 1] * gyr[1]
            + scale[0, 2] * gyr[2],
            gyr[1] - bias[1] + clipped[1] + scale[1, 0] * gyr[0] + scale[1, 1] * gyr[1]
            + scale[1, 2] * gyr[2],
            gyr[2] - bias[2] + clipped[2] + scale[2, 0] * gyr[0] + scale[2, 1] * gyr[1]
            + scale[2, 2] * gyr[2])
