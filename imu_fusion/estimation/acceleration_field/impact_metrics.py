"""Impacts in an acceleration field: channel filters, events and injury metrics.

Metrics are those of impact biomechanics, each function with its source. Signals are uniformly
sampled in time ``t`` (n,) s. Metrics that tell axes apart expect those of SAE J211 (x forward,
y right, z down).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its parts are loaded where they are first used
from numpy.typing import ArrayLike

from imu_fusion.errors import EstimationError, SampleError
from imu_fusion.estimation.acceleration_field.rows import GAP, MISSING, SATURATED, field_at
from imu_fusion.parameters.declare import Parameters, param

STANDARD_GRAVITY = 9.80665
CHANNEL_CLASSES = (60, 180, 600, 1000)
# From x forward, y left, z up (REP 103) to the axes of SAE J211.
J211_FROM_REP103 = np.diag([1.0, -1.0, -1.0])
UNITS = {
    "begin_s": "s", "stamp": "ns", "point": "m", "hic15": "g^2.5 s", "hic15_interval_s": "s",
    "hic36": "g^2.5 s", "hic36_interval_s": "s", "bric": "1", "gambit": "1", "damage": "1",
    **dict.fromkeys(("peak_linear_acceleration", "peak_linear_acceleration_xyz", "clip_3ms",
                     "clip_3ms_cumulative"), "m/s^2"),
    "peak_velocity_change": "m/s", "peak_angular_velocity": "rad/s",
    "peak_angular_acceleration": "rad/s^2"}
"""Units of what :func:`measure_impacts` and :func:`find_peaks` return."""


@dataclass(frozen=True)
class ImpactParams(Parameters):
    """``impact.*``: when an event begins and how its signals are treated."""

    detect: bool = param(
        True, doc="Whether impacts are looked for and measured. Set it to false for motions that "
                  "have none, such as shaking by hand.")
    trigger: float = param(
        98.0665, unit="m/s^2", low=1e-3,
        doc="Linear acceleration at the first point that begins an event. Lower it to catch light "
            "impacts, raise it where ordinary motion reaches it.")
    before: float = param(
        0.02, unit="s", low=0.0, doc="How much of what precedes the trigger belongs to the event.")
    duration: float = param(
        0.2, unit="s", low=1e-3, doc="Whole length of an event. Raise it for soft surfaces.")
    linear_class: int | None = param(
        None, doc="Channel class (60, 180, 600 or 1000, SAE J211) of linear accelerations; unset: "
                  "unfiltered. Set it to compare with laboratories.")
    angular_class: int | None = param(
        None, doc="Channel class of angular rates and accelerations; unset: unfiltered.")
    axes: str = param(
        "rep103", choices=("rep103", "j211"),
        doc="Axes of the body: x forward with y left, z up, or y right, z down. Metrics that tell "
            "axes apart (BrIC, DAMAGE) need it.")


def corner_frequency(channel_class: int, rate: float) -> float:
    """Hz, of a channel frequency class of SAE J211-1 at a rate in Hz.

    Raises:
        SampleError: a class that there is not, or a rate too low for it.
    """
    if channel_class not in CHANNEL_CLASSES:
        raise SampleError(f"channel class {channel_class}: there are CFC "
                          + ", ".join(map(str, CHANNEL_CLASSES)))
    corner = 2.0775 * channel_class
    if corner >= 0.45 * rate:
        raise SampleError(f"CFC {channel_class} has its corner at {corner:.0f} Hz: a rate of "
                          f"{rate:g} Hz is too low, use a lower class or none (SAE J211 asks for "
                          f"{10 * channel_class} Hz)")
    return corner


def channel_filter(values: ArrayLike, rate: float, channel_class: int) -> np.ndarray:
    """Zero-phase filter of a channel frequency class, SAE J211-1 appendix C.

    A Butterworth filter of second order, run forwards and backwards, whose corner lies at
    2.0775 times the class number in Hz. The ends are padded with 10 ms of mirrored signal (ISO
    6487).

    Args:
        values: (n, ...) along time.
        rate: Hz.
        channel_class: 60, 180, 600 or 1000.

    Raises:
        SampleError: a class that there is not, or a rate too low for it.
    """
    corner = corner_frequency(channel_class, rate)
    values = np.asarray(values, dtype=float)
    pad = min(len(values) - 1, max(6, int(np.ceil(0.01 * rate))))
    sections = scipy.signal.butter(2, corner, fs=rate, output="sos")
    return scipy.signal.sosfiltfilt(sections, values, axis=0, padlen=pad)


def hic(t: np.ndarray, acceleration: np.ndarray, longest: float) -> tuple[
        float, float, float]:
    """Head injury criterion: the largest ``(t2 - t1) mean(a / g)^2.5`` over intervals of at most
    ``longest`` s (FMVSS 208; HIC15 and HIC36 for 0.015 and 0.036).

    Args:
        t: (n,) s.
        acceleration: (n,) magnitude, m/s^2.

    Returns:
        (value, t1, t2)
    """
    impulse = scipy.integrate.cumulative_trapezoid(acceleration / STANDARD_GRAVITY, t, initial=0.0)
    best = (0.0, t[0], t[0])
    for lag in range(1, len(t)):
        span = t[lag:] - t[:-lag]
        allowed = span <= longest * (1 + 1e-9)
        if not np.any(allowed):
            break
        value = np.where(allowed, span * (np.maximum(impulse[lag:] - impulse[:-lag], 0.0)
                                          / span) ** 2.5, 0.0)
        k = int(np.argmax(value))
        if value[k] > best[0]:
            best = (float(value[k]), float(t[k]), float(t[k + lag]))
    return best


def sustained_level(t: np.ndarray, magnitude: np.ndarray, duration: float = 0.003,
                    cumulative: bool = False) -> float:
    """The level that a piecewise linear signal exceeds for ``duration`` s: 3 ms clip.

    Args:
        t: (n,) s.
        magnitude: (n,) any unit.
        cumulative: add up all times above (FMVSS 208), else one interval must suffice.
    """
    low, high = float(np.min(magnitude)), float(np.max(magnitude))
    if t[-1] - t[0] < duration:
        raise EstimationError(f"3 ms clip: the signal lasts {t[-1] - t[0]:.4g} s only")
    # Bisection of a monotonic function down to rounding.
    for _ in range(60):
        level = 0.5 * (low + high)
        if _longest_above(t, magnitude, level, cumulative) >= duration:
            low = level
        else:
            high = level
    return low


def _longest_above(t, y, level, cumulative):
    y0, y1, span = y[:-1] - level, y[1:] - level, np.diff(t)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(y0 * y1 < 0, np.maximum(y0, y1) / np.abs(y1 - y0), (y0 + y1 > 0) * 1.0)
    above = share * span
    if cumulative:
        return above.sum()
    longest = current = 0.0
    for part, begins_above, ends_above in zip(above, y0 > 0, y1 > 0):
        current = current + part if begins_above else part
        longest = max(longest, current)
        if not ends_above:
            current = 0.0
    return longest


def bric(omega: np.ndarray) -> float:
    """Brain injury criterion of Takhounts et al. 2013 (Stapp 57): omega (n, 3) rad/s, J211 axes.

    Critical rates 66.25, 56.45 and 42.87 rad/s, the averages for strain and its cumulative
    measure.
    """
    return float(np.linalg.norm(np.abs(omega).max(axis=0) / (66.25, 56.45, 42.87)))


def gambit(acceleration: ArrayLike, alpha: ArrayLike) -> float:
    """Generalised acceleration model of Newman 1986: the largest
    ``((a / 250 g)^2.5 + (alpha / 25000)^2.5)^(1 / 2.5)``; magnitudes (n,), m/s^2 and rad/s^2."""
    ratio = (np.asarray(acceleration) / (250 * STANDARD_GRAVITY), np.asarray(alpha) / 25000.0)
    return float(np.max((ratio[0] ** 2.5 + ratio[1] ** 2.5) ** (1 / 2.5)))


def damage(t: np.ndarray, alpha: np.ndarray) -> float:
    """DAMAGE of Gabler, Crandall, Panzer 2019: the largest deflection of three coupled
    oscillators driven by the angular acceleration.

    Args:
        t: (n,) s, uniform.
        alpha: (n, 3) rad/s^2, J211 axes.
    """
    kxx, kyy, kzz, kxz = 32142.0, 23493.0, 16935.0, 1636.3
    stiffness = np.array([[kxx + kxz, 0, -kxz], [0, kyy, 0], [-kxz, 0, kxz + kzz]])
    system = scipy.signal.StateSpace(
        np.block([[np.zeros((3, 3)), np.eye(3)], [-stiffness, -5.9148e-3 * stiffness]]),
        np.vstack([np.zeros((3, 3)), np.eye(3)]), np.hstack([np.eye(3), np.zeros((3, 3))]),
        np.zeros((3, 3)))
    even = np.arange(len(t)) * (t[-1] - t[0]) / (len(t) - 1)
    _, deflection, _ = scipy.signal.lsim(system, alpha, even)
    return float(2.9903 * np.linalg.norm(deflection, axis=1).max())


def find_events(t: np.ndarray, magnitude: np.ndarray, params: ImpactParams) -> list[slice]:
    """Slices of the events: each from ``before`` ahead of a crossing of ``trigger``, over
    ``duration``; a crossing inside an event belongs to it.

    Args:
        t: (n,) s.
        magnitude: (n,) m/s^2.
        params: ImpactParams.
    """
    above = magnitude >= params.trigger
    crossings = np.flatnonzero(above & ~np.r_[False, above[:-1]])
    events, end = [], -np.inf
    for k in crossings:
        if t[k] <= end:
            continue
        begin = t[k] - params.before
        end = begin + params.duration
        events.append(slice(int(np.searchsorted(t, begin)),
                            int(np.searchsorted(t, end, side="right"))))
    return events


def measure_impacts(rows: np.ndarray, points: ArrayLike, gravity: float,
                    params: ImpactParams = ImpactParams()) -> list[dict[str, Any]]:
    """Metrics of every event in the rows of an acceleration field estimator.

    The linear acceleration is the kinematic one. Events are found at the first point, before
    any channel filter; filters run over the whole recording.

    Args:
        rows: structured array ROW.
        points: (p, 3) m in body coordinates; the origin if empty.
        gravity: m/s^2, that of the estimator.
        params: ImpactParams.

    Returns:
        List of dicts (one per event and point) of plain numbers and strings, for JSON or CSV.
        An event with uneven stamps or of less than 3 ms has no metrics but says why:
        ``refused``.

    Raises:
        SampleError: a rate too low for the channel class.
    """
    if len(rows) < 3 or not params.detect:
        return []
    t = (rows["stamp"] - rows["stamp"][0]) * 1e-9
    step = np.median(np.diff(t))
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    points = points if len(points) else np.zeros((1, 3))
    to_j211 = J211_FROM_REP103 if params.axes == "rep103" else np.eye(3)
    acc = field_at(rows, points, gravity)[1] @ to_j211
    events = find_events(t, np.linalg.norm(acc[:, 0], axis=1), params)
    omega, alpha = rows["omega"] @ to_j211, rows["alpha"] @ to_j211
    if params.linear_class is not None:
        acc = channel_filter(acc, 1 / step, params.linear_class)
    if params.angular_class is not None:
        omega, alpha = (channel_filter(v, 1 / step, params.angular_class)
                        for v in (omega, alpha))
    results = []
    for number, event in enumerate(events):
        # Holes give no honest metric.
        refused = ("stamps are not even" if np.any(
            np.abs(np.diff(t[event]) - step) > 0.1 * step) else
            "shorter than 3 ms" if t[event][-1] - t[event][0] < 0.003 else "")
        for k, point in enumerate(points):
            results.append({
                "event": number, "begin_s": float(t[event][0]), "stamp": int(
                    rows["stamp"][event][0]), "point": [float(v) for v in point],
                **({"refused": refused} if refused else
                   _metrics(t[event], acc[event, k], omega[event], alpha[event])),
                "linear_class": params.linear_class,
                "angular_class": params.angular_class,
                "complete": bool(t[-1] - t[event][0] >= params.duration - 1.5 * step),
                "saturated_samples": int(np.sum(rows["flags"][event] & SATURATED > 0)),
                "missing_samples": int(np.sum(rows["flags"][event] & (MISSING | GAP) > 0)),
                "axes": "j211"})
    return results


def find_peaks(rows: np.ndarray, points: ArrayLike, gravity: float) -> dict[str, Any]:
    """The greatest magnitudes over rows of an estimator, impact or none, unfiltered.

    Args:
        rows, points, gravity: as of :func:`measure_impacts`; at least one row.

    Returns:
        dict of plain numbers: of the linear acceleration one for each point, with its stamp.
    """
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    points = points if len(points) else np.zeros((1, 3))
    magnitude = np.linalg.norm(field_at(rows, points, gravity)[1], axis=2)
    at = magnitude.argmax(axis=0)
    return {"point": points.tolist(), "peak_linear_acceleration": magnitude.max(axis=0).tolist(),
            "stamp": rows["stamp"][at].tolist(),
            "peak_angular_velocity": float(np.linalg.norm(rows["omega"], axis=1).max()),
            "peak_angular_acceleration": float(np.linalg.norm(rows["alpha"], axis=1).max())}


def _metrics(t, acc, omega, alpha):
    magnitude, turning = np.linalg.norm(acc, axis=1), np.linalg.norm(alpha, axis=1)
    # Velocity change in the turning body: d v / dt = a - omega x v, from the start of the event.
    velocity = np.zeros_like(acc)
    for n in range(1, len(t)):
        h = t[n] - t[n - 1]
        middle = velocity[n - 1] + 0.5 * h * (acc[n - 1] - np.cross(omega[n - 1],
                                                                    velocity[n - 1]))
        velocity[n] = velocity[n - 1] + h * (0.5 * (acc[n] + acc[n - 1]) - np.cross(
            0.5 * (omega[n] + omega[n - 1]), middle))
    hic15, hic36 = hic(t, magnitude, 0.015), hic(t, magnitude, 0.036)
    return {
        "peak_linear_acceleration": float(magnitude.max()),
        "peak_linear_acceleration_xyz": [float(v) for v in np.abs(acc).max(axis=0)],
        "peak_velocity_change": float(np.linalg.norm(velocity, axis=1).max()),
        "peak_angular_acceleration": float(turning.max()),
        "peak_angular_velocity": float(np.linalg.norm(omega, axis=1).max()),
        "hic15": hic15[0], "hic15_interval_s": [hic15[1], hic15[2]],
        "hic36": hic36[0], "hic36_interval_s": [hic36[1], hic36[2]],
        "clip_3ms": sustained_level(t, magnitude),
        "clip_3ms_cumulative": sustained_level(t, magnitude, cumulative=True),
        "bric": bric(omega), "gambit": gambit(magnitude, turning), "damage": damage(t, alpha)}
