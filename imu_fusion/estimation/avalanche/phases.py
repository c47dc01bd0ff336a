"""The phases of the motion from the signals: Winkler 2025, section 3.2.

0 rest, 1 entrainment, 2 ballistic flight, 3 impact, 4 steady flow, 5 rolling, 6 rest. The paper
reads them off its diagrams; here each transition has a threshold, as a parameter, and a reason in
words.
"""

from dataclasses import dataclass

import numpy as np

from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.samples.free_fall import FLIGHT_TIME, FREE_FALL, free_falls

NAMES = ("rest", "entrainment", "ballistic flight", "impact", "steady flow", "rolling", "rest")


@dataclass(frozen=True)
class PhaseParams(Parameters):
    """``phases.*``: thresholds."""

    free_fall: float = param(
        FREE_FALL, unit="g", low=0.01, high=0.9, doc="Largest specific force of the ball's centre "
        "in flight. Raise it for an accelerometer with errors of many percent.")
    flight_time: float = param(
        FLIGHT_TIME, unit="s", low=0.02, doc="Shortest flight that counts.")
    first_flight_time: float = param(
        0.3, unit="s", low=0.02, doc="Shortest flight that is the throw of phase 2; without one "
        "the entrainment goes over into the steady flow.")
    rolling_rate: float = param(
        8.0, unit="rad/s", low=0.5, doc="Mean rate above which the ball rolls. Lower it for large "
        "snowballs.")
    rolling_time: float = param(
        2.0, unit="s", low=0.1, doc="Time over which that mean is taken.")


@dataclass(frozen=True)
class Transition:
    """Phase ``number`` begins at ``time`` (s), for a ``reason``."""

    number: int
    time: float
    reason: str


@dataclass(frozen=True)
class Flight:
    """A ballistic flight between two times (s)."""

    start: float
    end: float


def flights(time: np.ndarray, force: np.ndarray, gravity: float,
            params: PhaseParams = PhaseParams()) -> list[Flight]:
    """Flights (:func:`~imu_fusion.samples.free_fall.free_falls`).

    Args:
        time: (n,) s. force: (n, 3) m/s^2, specific force of the ball's centre. gravity: m/s^2.
    """
    return [Flight(float(time[fall.start]), float(time[fall.end])) for fall in free_falls(
        time, force, gravity, params.free_fall, params.flight_time)]


def find_phases(time: np.ndarray, force: np.ndarray, rate: np.ndarray, stop: float,
                gravity: float, params: PhaseParams = PhaseParams()) -> list[Transition]:
    """The transitions, in order; those that the motion does not have are left out.

    Args:
        time: (n,) s, from the entrainment (0) on. force: as :func:`flights` has it.
        rate: (n, 3) rad/s, recovered.
        stop: s, when the ball comes to rest. gravity: m/s^2.
    """
    found = [Transition(1, 0.0, "rates and forces leave the level of the rest before")]
    long = [f for f in flights(time, force, gravity, params)
            if f.end - f.start >= params.first_flight_time]
    rolls = _rolling(time, np.linalg.norm(rate, axis=1), params)
    if long and (rolls is None or long[0].start < rolls):
        flight = long[0]
        found += [
            Transition(2, flight.start, f"the specific force falls below {params.free_fall:g} g "
                       f"for {flight.end - flight.start:.2f} s: free fall"),
            Transition(3, flight.end, "a force ends the free fall")]
        size = np.linalg.norm(force, axis=1)
        after = np.flatnonzero((time >= flight.end) & (time < flight.end + 0.25))
        if len(after):
            peak = after[np.argmax(size[after])]
            over = peak + int(np.argmax(size[peak:] < gravity))
            found.append(Transition(4, float(time[over]), f"after a peak of "
                                    f"{size[peak] / gravity:.1f} g the force is down to 1 g"))
    if rolls is not None:
        found.append(Transition(5, rolls, f"the rate rises to more than {params.rolling_rate:g} "
                                f"rad/s and stays there"))
    found.append(Transition(6, stop, "rates and forces are down at the level of rest"))
    return found


def _rolling(time, rate, params):
    """Time (s) at which the rate (n,) begins to rise to that of rolling, of the longest time that
    its mean is that of rolling; None where it never is."""
    step = float(np.median(np.diff(time)))
    width = max(int(round(params.rolling_time / step)), 1)
    if len(rate) <= 2 * width:
        return None
    # Mean over the time that follows each sample; the throw spins a ball, too, but not as long.
    sums = np.concatenate([[0.0], np.cumsum(rate)])
    mean = (sums[width:] - sums[:-width]) / width
    fast = np.concatenate([[False], mean > params.rolling_rate, [False]])
    runs = np.flatnonzero(np.diff(fast.astype(int))).reshape(-1, 2)
    if not len(runs):
        return None
    first = runs[np.argmax(runs[:, 1] - runs[:, 0]), 0]
    level = float(np.median(rate[first + width:first + 2 * width]))
    # From here on it stays above half of that: a jerk of the flow does not.
    slow = np.flatnonzero(rate[first:first + width] < 0.5 * level)
    reached = first + (int(slow[-1]) + 1 if len(slow) else 0)
    before = float(np.median(rate[max(reached - width, 0):max(reached - width // 4, 1)]))
    marks = []
    for share in (0.5, 0.2):
        under = np.flatnonzero(rate[:reached + 1] < before + share * (level - before))
        marks.append(time[under[-1]] if len(under) else time[0])
    half, fifth = marks
    # An exponential rise: its logarithms at a fifth and a half.
    return float(fifth - (half - fifth) * np.log(0.8) / np.log(0.5 / 0.8))
