"""Single wild samples, kept from turning the attitude or moving the body."""

from imu_fusion.kernels import njit

WILD_RATE = 10.0           # rad/s within a sample: more than a tap on the sensor (7 were seen)
WILD_FORCE = 150.0         # m/s^2 within a sample: more than a step of a foot
# Times the usual change that makes a value suspect. In the recordings of bags/ (230 000 samples)
# 999 of 1000 changes of the rate stay below 7, and the largest is 24.
_CHANGES = 20.0
_MEMORY = 1.0              # s, over which changes are usual
_STEP = 0.05               # s: between slower samples anything can happen


@njit
def hold(spike, value, last, dt, size, missed):
    """Hold back a value far from the one before, which then stands in for it.

    If the next one is back where it came from, it was no motion; if not, it was, and what was
    missed of its integral is made up for.

    Args:
        spike: a state.SPIKE, in place.
        value: (3,) of the newest sample; replaced while held.
        last: (3,) of the one before; replaced by what was held if that was motion.
        dt: s, between both.
        size: change that can be wild.
        missed: (3,), gets the integral to make up for.

    Returns:
        Whether the value is held.
    """
    change = 0.0
    for i in range(3):
        change = max(change, abs(value[i] - last[i]))
    is_far = change > max(size, _CHANGES * spike.usual_change)
    if spike.is_held:
        spike.is_held = False
        if is_far:
            for i in range(3):
                missed[i] = 0.5 * spike.step * (spike.value[i] - last[i])
                last[i] = spike.value[i]
        return False
    if is_far and dt <= _STEP:
        spike.is_held = True
        spike.step = dt
        for i in range(3):
            spike.value[i] = value[i]
            value[i] = last[i]
        return True
    spike.usual_change += min(dt / _MEMORY, 1.0) * (change - spike.usual_change)
    return False
