"""In which unit a sensor's values are, where nobody says so: gravity, the Earth's field, and that
what stands still in the world turns as the gyroscope says."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from imu_fusion.sources import units
from imu_fusion.sources.source import STANDARD_GRAVITY

_FIELD = (15e-6, 80e-6)  # T, of the Earth, with room
_GRAVITY = (0.85, 1.15)  # of standard gravity, of a sensor at rest
_COUNTS = 50.0          # of whole numbers with a greater norm: counts of a converter
_LEAST_TURN = 0.3       # rad, that tells in which unit a gyroscope is
_WELL = 0.9             # share of what turned that a gyroscope explains


def _norm_at_rest(data):
    """Median of the norms where they change least."""
    norms = np.linalg.norm(data, axis=1)
    norms = norms[np.isfinite(norms)]
    if len(norms) < 3:
        return np.nan
    size = max(min(50, len(norms) // 2), 2)
    windows = np.lib.stride_tricks.sliding_window_view(norms, size)
    return float(np.median(windows[int(np.argmin(np.ptp(windows, axis=1)))]))


def unit_of(kind: str, written: str, known: dict[str, float],
            data: NDArray) -> tuple[str, float, str]:
    """(unit, counts per unit, what is doubtful) of a sensor.

    Args:
        kind: "accelerometer" or "magnetometer".
        written: its unit as the header says, or "".
        known: SI units per unit, by the names of the units.
        data: (n, 3) values.
    """
    unit = units.spelled(written, known)
    rest = _norm_at_rest(data)
    if kind == "magnetometer":
        if unit:
            return unit, 1.0, ""
        fits = [u for u, f in known.items() if _FIELD[0] < rest * f < _FIELD[1]]
        if fits:
            return fits[0], 1.0, f"unit not named; norm {rest:.4g}"
        return "uT", rest / 50.0 if rest > 0 else 1.0, (
            f"norm {rest:.4g} fits no unit: taken as 50 uT")
    if unit:
        felt = rest * known[unit] / STANDARD_GRAVITY
        wrong = np.isfinite(felt) and felt < 0.2
        return unit, 1.0, f"{felt:.2g} g at rest: gravity is not in it" if wrong else ""
    for unit, factor in known.items():
        if _GRAVITY[0] < rest * factor / STANDARD_GRAVITY < _GRAVITY[1]:
            return unit, 1.0, f"unit not named; norm at rest {rest:.4g}"
    if bool((data == np.round(data)).all()) and rest > _COUNTS:
        scale = float(2 ** round(np.log2(rest)))
        return "g", scale, f"counts; {rest:g} at rest taken as about 1 g"
    return "m/s^2", 1.0, f"unit not named; norm at rest {rest:.4g}, which is gravity in none"


def rate_unit(written: str, data: NDArray, vectors: Iterable[NDArray],
              time: NDArray | None) -> tuple[str, float, str]:
    """(unit, counts per unit, what is doubtful) of a gyroscope. A vector v that stands still in
    the world turns as dv/dt = -rate x v in the sensor, whatever the unit of v: that tells the unit
    of the rate.

    Args:
        written: its unit as the header says, or "".
        data: (n, 3) values.
        vectors: such vectors (n, 3), the best first.
        time: (n,) s, if known.
    """
    unit = units.spelled(written, units.RATE)
    if unit:
        return unit, 1.0, ""
    peak = float(np.nanmax(np.abs(data)))
    whole = bool((data == np.round(data)).all()) and peak > _COUNTS
    for vector in vectors if time is not None else ():
        scale = _rad_per_unit(time, data, vector)
        if scale is None:
            continue
        for name, factor in units.RATE.items():
            if abs(np.log(scale / factor)) < 0.2:
                return name, 1.0, "unit not named; its turning fits"
        if whole:
            counts = float(f"{np.radians(1.0) / scale:.3g}")
            return "deg/s", counts, f"counts; its turning fits {counts:g} per deg/s"
    if whole:
        return "deg/s", 16.4, f"counts, greatest {peak:g}: 16.4 per deg/s is usual"
    return ("deg/s" if peak > 12.0 else "rad/s"), 1.0, f"unit not named; greatest value {peak:.3g}"


def _rad_per_unit(time, rate, vector):
    """rad/s per unit of the rate; None where it does not turn enough, or does not fit."""
    step = np.diff(time)
    if not len(step) or not (np.isfinite(step) & (step > 0)).all():
        return None
    size = max(round(0.3 / float(np.median(step))), 1)
    # The change of the vector over .3 s, and what a rate of 1 would have made of it.
    made = np.cumsum(np.cross(rate, vector)[:-1] * step[:, None], axis=0)[size - 1::size]
    made = np.diff(made, axis=0, prepend=np.zeros((1, 3)))
    change = np.diff(vector[::size], axis=0)
    n = min(len(made), len(change))
    made, change = made[:n], change[:n]
    fine = np.isfinite(made).all(axis=1) & np.isfinite(change).all(axis=1)
    made, change = made[fine], change[fine]
    total = float((change ** 2).sum())
    if not total or not (made ** 2).sum():
        return None
    scale = -float((change * made).sum() / (made ** 2).sum())
    left = float(((change + scale * made) ** 2).sum())
    turned = np.sqrt(total / max(float(np.nanmean((vector ** 2).sum(axis=1))), 1e-300))
    good = scale > 0 and turned > _LEAST_TURN and left < (1.0 - _WELL) * total
    return scale if good else None


def feels_gravity(data: NDArray) -> tuple[bool, float]:
    """(whether the norm at rest is that of gravity in some unit, that norm if it may be counts), by
    which the likeliest accelerometer has the greatest."""
    norm = _norm_at_rest(data)
    fits = any(_GRAVITY[0] < norm * f / STANDARD_GRAVITY < _GRAVITY[1]
               for f in units.ACCELERATION.values())
    return fits, bool((data == np.round(data)).all()) * norm
