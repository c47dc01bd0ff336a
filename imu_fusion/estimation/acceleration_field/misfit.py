"""How far the constants of a sensor came from what was said of them (numba).

Biases and mounting have a mean of zero and the sd that is stated for them. What does not fit a
rigid body goes into them even where it is nothing of the kind: a delay, a filter. So where those of
one sensor, taken together, are further off than chance makes them, all that is stated is too small
by as much, and is widened (Birge 1932).
"""

import math

from imu_fusion.estimation.acceleration_field.motion_model import BIAS
from imu_fusion.kernels import njit

_CHANCE = 3.0   # standard deviations of a mean square that is no misfit


@njit
def widening(x, channels):
    """Factor on all covariances, by the mean x (N,) of a state with CHANNELs (m,)."""
    excess, squares, number = 0.0, 0.0, 0
    for c in range(len(channels)):
        channel = channels[c]
        is_first = c == 0 or channels[c - 1].sensor != channel.sensor
        if is_first:
            squares, number = 0.0, 0
        # What walks may have come from anywhere.
        if channel.bias_sd > 0.0 and channel.bias_walk == 0.0:
            squares += (x[BIAS + c] / channel.bias_sd) ** 2
            number += 1
        if channel.scale >= 0:
            squares += (x[channel.scale] / channel.scale_sd) ** 2
            number += 1
        if is_first:
            for i in range(3):
                if channel.turn >= 0:
                    squares += (x[channel.turn + i] / channel.axes_sd) ** 2
                    number += 1
                if channel.shift >= 0:
                    squares += (x[channel.shift + i] / channel.position_sd) ** 2
                    number += 1
        is_last = c == len(channels) - 1 or channels[c + 1].sensor != channel.sensor
        if is_last and number > 0:
            excess = max(excess, squares / number - _by_chance(number))
    return 1.0 + excess


@njit
def _by_chance(number):
    """Mean square of so many constants, in their variances, that chance hardly exceeds (Wilson and
    Hilferty 1931)."""
    spread = 2.0 / (9.0 * number)
    return (1.0 - spread + _CHANCE * math.sqrt(spread)) ** 3
