"""The rate that a gyroscope axis at its limit does not show: Singer's process (1970).

The clipped rate is driven by an angular acceleration, a first-order Gauss-Markov process, which
starts as the slope that ran into the limit and is forgotten in its correlation time.
"""

import math

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.kernels import njit


@njit
def gain(p, time):
    """Clipped rate (rad/s) after ``time`` (s) per angular acceleration (rad/s^2) before."""
    tau = p.fusion.angular_acc_time
    return tau * (1.0 - math.exp(-time / tau))


@njit
def noise(p, time):
    """Variances of angular acceleration and clipped rate that ``time`` (s) adds."""
    sd, tau = p.fusion.angular_acc_sd, p.fusion.angular_acc_time
    part = time / tau
    keep = math.exp(-part)
    # The series where the closed form would be a small difference of large numbers.
    growth = (2.0 / 3.0 * part ** 3 if part < 1e-2
              else 2.0 * part - 3.0 + 4.0 * keep - keep * keep)
    return sd ** 2 * (1.0 - keep * keep), (sd * tau) ** 2 * growth


@njit
def carry(s, p):
    """Carry both over the present step, and start them on axes that have reached their limit."""
    step, noises = s.step, s.block.noise
    dt = step.dt
    for i in range(3):
        entered = (step.gyr[i] - s.gyr_last[i]) / dt if dt > 0.0 else 0.0
        if (step.begun >> i) & 1:
            slope = s.slope[i]
            if (slope - entered) * step.gyr[i] < 0.0:
                slope = entered
            s.angular_acc[i] = slope
            s.clipped_rate[i] = (slope - entered) * dt
            # As old as the slope is, or as the limit where it was only now found.
            age = max(s.gyro_limit.count[i], 1) * dt if dt > 0.0 else p.gap.max
            noises[es.ANGULAR_ACC + i], noises[es.CLIPPED_RATE + i] = noise(p, age)
        elif (s.clipped >> i) & 1:
            s.clipped_rate[i] += s.angular_acc[i] * gain(p, dt)
            s.angular_acc[i] *= math.exp(-dt / p.fusion.angular_acc_time)
        if not (step.clipped >> i) & 1:
            s.slope[i] = entered
