"""The fusion filter's output row, from its state."""

import math

import numpy as np

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation import wander
from imu_fusion.estimation.orientation.gyro_model import rate_of_turn
from imu_fusion.estimation.orientation.rows import finish, raise_to_limits
from imu_fusion.kernels import njit

_FIRST_DT = 1e-2           # s: step that stands in for the one before the first sample


@njit
def write(s, p, row, taped):
    """The output row of the present state. taped: the smoother will correct it."""
    step, cov = s.step, s.cov
    noise_dt = step.dt if step.dt > 0.0 else _FIRST_DT
    since = s.block.time
    density2 = p.sensor.gyro_noise_density ** 2
    cov_world = np.empty((3, 3))
    rate = rate_of_turn(s, step.gyr)
    var_acc = p.sensor.acc_noise_density ** 2 / noise_dt + cov[es.ACC_BIAS, es.ACC_BIAS]
    for i in range(3):
        bias_var = cov[es.GYRO_BIAS + i, es.GYRO_BIAS + i]
        var_gyr = density2 / noise_dt + bias_var
        for j in range(3):
            slot = es.GYRO_SCALE + 3 * i + j
            var_gyr += cov[slot, slot] * step.gyr[j] ** 2
            cov_world[i, j] = cov[i, j]
        cov_world[i, i] += density2 * since + s.block.noise[es.ATTITUDE + i]
        if (s.clipped >> i) & 1:
            var_gyr += (cov[es.CLIPPED_RATE + i, es.CLIPPED_RATE + i]
                        + s.block.noise[es.CLIPPED_RATE + i]
                        + since ** 2 * cov[es.ANGULAR_ACC + i, es.ANGULAR_ACC + i])
        row.gyr[i] = rate[i]
        row.cov_gyr[i, i] = var_gyr
        row.gyr_bias_sd[i] = math.sqrt(max(bias_var, 0.0))
    wander.widen(cov_world, wander.shown(s.wander), s.wander.overall)
    cov_world[2, 2] += min(s.heading_var + s.hard_iron.heading_var, es.UNIFORM_VARIANCE)
    if not taped:    # else the smoother does it, after its correction
        raise_to_limits(row.gyr, step.clipped, s.gyro_limit.limit)
    finish(row, s, p, var_acc, cov_world)
