"""A device's clock under that of the computer: offset, drift and steps, from delays alone."""

import numpy as np
import pytest

from imu_fusion.sources.clock import DeviceClock

S = 1_000_000_000


def lots(duration, drift=0.0, offset=12_345 * S, seed=0, size=4, least=300_000, late=2e6):
    """Yield (device times, arrival, true times at arrival's clock) of a sensor at 200 Hz: delays
    are at least .3 ms, 2 ms more on the average, now and then a tenth of a second."""
    noise = np.random.default_rng(seed)
    true = 1_700_000_000 * S + np.arange(round(duration * 200)) * 5_000_000
    device = np.round((true - true[0]) * (1.0 - drift)).astype(np.int64) + offset
    for k in range(0, len(true) - size + 1, size):
        delay = least + noise.exponential(late) + (noise.random() < 0.01) * 1e8
        yield device[k:k + size], int(true[k + size - 1] + delay), true[k:k + size]


def run(clock, parts):
    """(errors in s, stamps, true times) after the clock has settled."""
    errors, stamps, times = [], [], []
    for device, arrival, true in parts:
        if clock.has_stepped(int(device[-1]), arrival):
            clock.restart()
        clock.observe(int(device[-1]), arrival)
        if clock.is_settled:
            stamps.append(clock.map(device))
            errors.append((stamps[-1] - true) * 1e-9)
            times.append(true)
    return np.concatenate(errors), np.concatenate(stamps), np.concatenate(times)


@pytest.mark.parametrize("drift", [0.0, 50e-6, -50e-6])
def test_ten_minutes_with_drift_stay_within_a_millisecond_of_the_least_delay(drift):
    clock = DeviceClock()
    error, stamp, true = run(clock, lots(600.0, drift))
    settled = true > true[0] + 40 * S
    # Late by the least delay, .3 ms, and by what random delays leave of it.
    assert np.abs(error[settled] - 0.3e-3).max() < 1e-3
    # Before the drift is known it adds 50 us a second.
    assert np.abs(error).max() < 4e-3
    assert clock.drift == pytest.approx(drift, abs=5e-6) and clock.steps == 0
    # Intervals are those that the device measured, but for the drift and the following.
    assert np.abs(np.diff(stamp) / 5e6 - 1.0).max() < 2.2e-3
    assert (np.diff(stamp) > 0).all()


@pytest.mark.parametrize("jump", [3 * S, -3 * S, -12_000 * S])
def test_a_clock_that_was_set_begins_anew(jump):
    clock = DeviceClock()
    first = list(lots(30.0))
    after = [(device + jump, arrival + 30 * S, true + 30 * S) for device, arrival, true in first]
    run(clock, first)
    error, stamp, _ = run(clock, after)
    assert clock.steps == 1
    assert np.abs(error).max() < 4e-3 and (np.diff(stamp) > 0).all()


def test_a_network_that_stands_still_does_not_move_the_stamps():
    """Three seconds of samples that come at once, late."""
    parts = list(lots(30.0))
    held = [(device, max(arrival, parts[3600 // 4][1]), true) if 3000 <= 4 * k < 3600 else
            (device, arrival, true) for k, (device, arrival, true) in enumerate(parts)]
    clock = DeviceClock()
    error, _, _ = run(clock, held)
    assert clock.steps == 0 and np.abs(error).max() < 4e-3


def test_what_comes_before_it_has_settled_can_be_mapped_later():
    clock = DeviceClock()
    waiting = []
    for device, arrival, true in lots(2.0, late=2e7):
        clock.observe(int(device[-1]), arrival)
        if not clock.is_settled:
            waiting.append((device, true))
            continue
        for early, truth in waiting:
            assert np.abs(clock.map(early) - truth).max() < 5e6
        break
    assert len(waiting) > 10
