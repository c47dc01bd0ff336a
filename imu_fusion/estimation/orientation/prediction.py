"""What a block of Imu samples collects, and the prediction over it.

Integrals of the block that is being collected are in ``s.block``, an error_state.PREDICTION.
"""

import math

from imu_fusion.estimation.orientation import clipped_rate
from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.kernels import njit

_STILL_LOCAL_RATE = 1e-3   # 1/s: at rest the local field is forgotten in a quarter of an hour
_LASTING_TIME = 10.0       # s, of accelerations that last in imu axes, such as those of turns
_REST_LASTING_TIME = 0.3   # s: at rest they are over


@njit
def collect(s, p, middle):
    """Velocity and position over the step, and the block's integrals, at the attitude (3, 3) of
    its middle."""
    step, block = s.step, s.block
    dt = step.dt
    for i in range(3):
        force = 0.0
        for j in range(3):
            f = 0.5 * (step.force[j] + s.force_last[j]) - s.acc_bias[j]
            force += middle[i, j] * (f * dt + step.missed_force[j])
            block.rotation[i, j] += middle[i, j] * dt
            if (s.clipped >> j) & 1:
                part = 0.5 if ((step.begun | step.back) >> j) & 1 else 1.0
                block.clipped_rotation[i, j] += part * middle[i, j] * dt
            for c in range(3):
                block.rotation_gyr[i, 3 * j + c] += (
                    middle[i, j] * 0.5 * (s.gyr_last[c] + step.gyr[c]) * dt)
        change = 0.0
        if p.use_acc:
            block.force[i] += force
            change = force - (s.gravity * dt if i == 2 else 0.0)
        s.position[i] += (s.velocity[i] + 0.5 * change) * dt
        s.velocity[i] += change
    block.time += dt


@njit
def finish(s, p):
    """Process noise and decays of the block."""
    block, f = s.block, p.fusion
    noise, time = block.noise, block.time
    keep = math.exp(-time * (_STILL_LOCAL_RATE if s.step.still else 1.0 / f.local_field_time))
    block.local_field_keep = keep
    block.acc_bias_keep, lasting_var = _lasting(s, p)
    block.acc_keep = math.exp(-time / f.angular_acc_time)
    block.rate_gain = clipped_rate.gain(p, time)
    if time > 0.0:
        block.rate_mean = f.angular_acc_time * (1.0 - block.rate_gain / time)
    acc_var, rate_var = clipped_rate.noise(p, time)
    block.states = es.N if s.clipped else es.CLIPPED_RATE
    for i in range(3):
        lasting = ((s.clipped & s.was_clipped) >> i) & 1
        block.stays_clipped[i] = lasting
        noise[es.ATTITUDE + i] += p.sensor.gyro_noise_density ** 2 * time
        noise[es.GYRO_BIAS + i] += p.sensor.gyro_bias_walk ** 2 * time
        noise[es.VELOCITY + i] += f.velocity_walk ** 2 * time
        noise[es.FIELD + i] = f.field_walk ** 2 * time
        noise[es.ACC_BIAS + i] += lasting_var
        s.acc_bias[i] *= block.acc_bias_keep
        noise[es.LOCAL_FIELD + i] = p.local_field_sd ** 2 * (1.0 - keep * keep)
        if lasting:
            noise[es.ANGULAR_ACC + i] = acc_var
            noise[es.CLIPPED_RATE + i] = rate_var
        s.local_field[i] *= keep


@njit
def _lasting(s, p):
    """Factor that the accelerometer's bias keeps over the block, and the variance that it gains:
    where accelerations last in imu axes it is theirs, too (Gauss-Markov)."""
    if p.lasting_acc_sd == 0.0:
        return 1.0, 0.0
    still = s.step.still
    keep = math.exp(-s.block.time / (_REST_LASTING_TIME if still else _LASTING_TIME))
    sd = p.sensor.acc_bias_sd if still else p.lasting_acc_sd
    return keep, sd ** 2 * (1.0 - keep * keep)
