"""Single wild rates of the gyroscope, kept from turning the attitude."""

from imu_fusion.kernels import njit

_SPIKE = 10.0              # rad/s within a sample: more than a tap on the sensor (7 were seen)
# Times the usual change that makes a rate suspect. In the recordings of bags/ (230 000 samples)
# 999 of 1000 changes stay below 7, and the largest is 24.
_SPIKE_CHANGES = 20.0
_SPIKE_MEMORY = 1.0        # s, over which changes are usual
_SPIKE_STEP = 0.05         # s: between slower samples anything can happen


@njit
def hold(s):
    """Hold back a rate far from the one before, which then stands in for it.

    If the next one is back where it came from, it was no motion; if not, it was, and what was
    missed of the rotation is made up for. Works on ``s.step``: gyr is replaced while held,
    missed gets the rotation to make up for.

    Returns:
        Whether the rate is held.
    """
    spike, step = s.spike, s.step
    change = 0.0
    for i in range(3):
        change = max(change, abs(step.gyr[i] - s.gyr_last[i]))
    is_far = change > max(_SPIKE, _SPIKE_CHANGES * spike.usual_change)
    if spike.is_held:
        spike.is_held = False
        if is_far:
            for i in range(3):
                step.missed[i] = 0.5 * spike.step * (spike.rate[i] - s.gyr_last[i])
                s.gyr_last[i] = spike.rate[i]
        return False
    if is_far and step.dt <= _SPIKE_STEP:
        spike.is_held = True
        spike.step = step.dt
        for i in range(3):
            spike.rate[i] = step.gyr[i]
            step.gyr[i] = s.gyr_last[i]
        return True
    spike.usual_change += min(step.dt / _SPIKE_MEMORY, 1.0) * (change - spike.usual_change)
    return False
