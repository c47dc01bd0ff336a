"""Which column of a table holds its times, and what they count."""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imu_fusion.sources import units
from imu_fusion.sources.header import TIME, WEEK, Column
from imu_fusion.sources.source import EPOCH
from imu_fusion.sources.times import NANOSECONDS, calendar, is_calendar

_SINCE_START = 1e8      # s, three years: times below do not count from 1970
_OUR_YEARS = 9e8, 4e9   # s, since 1970
_COUNTERS = tuple(2.0 ** bits for bits in (16, 24, 32))    # at which they begin anew
_WEEKS = 1000, 10_000   # since 1980
_WEEK = 604_800.0       # s
# Times of some loggers, by the name of their column: unit, s per tick.
_KNOWN_TIMES = {"sampletimefine": ("tick", 1e-4)}    # Xsens MT Manager


@dataclass
class TimeEntry:
    """``content``: what the description says of the times; ``remark`` and ``doubt`` of it."""

    content: dict[str, Any]
    remark: str = ""
    doubt: str = ""

    def seconds(self, values: dict[str, NDArray]) -> NDArray | None:
        """Times (n,) in s, or None where no column holds them."""
        name = self.content.get("column")
        if name is None:
            return None
        factor = self.content.get("tick") or 10.0 ** (units.TIME.get(self.content["unit"], 9) - 9)
        turns = np.cumsum(np.diff(values[name], prepend=0.0) < 0)
        return (values[name] + turns * self.content.get("wrap", 0.0)) * factor


def time_entry(columns: list[Column], values: dict[str, NDArray],
               texts: dict[str, list[str]]) -> TimeEntry:
    """The time column: by name or unit, else the first that rises throughout. Seconds of times
    that are written out go to ``values``."""
    for column in columns:
        if is_calendar(texts[column.name][0]):
            entry = _dates(column.name, texts[column.name], values)
            if entry is not None:
                return entry
    turns = {c.name: _turns_over(values[c.name]) for c in columns}
    rising = [c for c in columns if turns[c.name] is not None]
    named_so = [c for c in columns if not c.kind and np.isfinite(values[c.name]).any() and (
        re.fullmatch(TIME, c.low) or (c in rising and units.spelled(c.unit, units.TIME)))]
    chosen = next(iter([c for c in named_so if c in rising] or named_so or rising), None)
    if chosen is None:
        return TimeEntry({"rate": 100.0}, doubt="no column of times is found, the rate is not "
                                                "known")
    step = float(np.nanmedian(np.abs(np.diff(values[chosen.name]))))
    if chosen.low in _KNOWN_TIMES:
        unit, tick = _KNOWN_TIMES[chosen.low]
        return TimeEntry({"column": chosen.name, "unit": unit, "tick": tick, "wrap": 2.0 ** 32,
                          "start": EPOCH * 1e-9}, f"{1 / (step * tick):.4g} Hz" if step else "")
    latest = float(np.nanmax(values[chosen.name]))
    known = _named_unit(chosen) or (_epoch_unit(latest) if chosen in named_so else None)
    unit = known or _likely_unit(step, latest)
    seconds = 10.0 ** (units.TIME[unit] - 9)
    entry = TimeEntry({"column": chosen.name, "unit": unit,
                       **_origin(columns, values, latest * seconds)})
    rate = 1 / (step * seconds) if step else np.nan
    if not known or chosen not in named_so:
        entry.doubt = (f"steps of {step:g} would be {rate:.4g} Hz" if step else
                       "the times stand still")
    elif step:
        entry.remark = f"{rate:.4g} Hz"
        if not 0.05 <= rate <= 100e3:
            entry.doubt = f"{rate:.4g} Hz, is the unit right?"
    if turns[chosen.name]:
        entry.content["wrap"] = turns[chosen.name]
        entry.doubt = f"{rate:.4g} Hz; a counter that begins anew"
    elif chosen not in rising:
        entry.doubt = f"{rate:.4g} Hz; the times fall back, or stand still"
    return entry


def _origin(columns, values, latest):
    """From when times count, of which the latest is given in s: a GPS week, some start, or 1970."""
    week = next((c.name for c in columns if re.fullmatch(WEEK, c.low) and (
        np.ptp(values[c.name]) <= 1 and _WEEKS[0] < values[c.name][0] < _WEEKS[1])), None)
    if week is not None and latest <= _WEEK:
        return {"week": week}
    return {"start": EPOCH * 1e-9} if latest < _SINCE_START else {}


def _dates(name, texts, values):
    content = {"column": name, "unit": "iso8601"}
    try:
        since = np.array([calendar(text.strip()) for text in texts], dtype=np.int64)
    except ValueError:
        return None    # not all of them are times
    values[name] = (since - since[0]) / NANOSECONDS
    if since[0] < _SINCE_START * NANOSECONDS:
        return TimeEntry(content | {"start": EPOCH * 1e-9}, doubt="hours without a date")
    return TimeEntry(content)


def _turns_over(values):
    """Where a counter begins anew of whose values the rest rise: 0 if nowhere, None if they do not
    rise."""
    step = np.diff(values)
    if not len(step) or not np.ptp(values) > 0 or not np.isfinite(values).all():
        return None
    falls = step[step < 0]
    if not len(falls):
        return 0
    usual = float(np.median(step[step >= 0])) if len(falls) < 0.1 * len(step) else 0.0
    return next((size for size in _COUNTERS if values.max() < size and usual > 0 and (
        (falls + size > 0) & (falls + size < 100 * usual)).all()), None)


def _named_unit(column):
    """The unit that the name of a column of times tells, or None."""
    unit = units.spelled(column.unit, units.TIME)
    suffix = re.search(r"[ _](s|ms|us|ns|sec)$|(nano|micro|milli)", column.low)
    return unit or (suffix and {"nano": "ns", "micro": "us", "milli": "ms", "sec": "s"}.get(
        suffix[1] or suffix[2], suffix[1]))


def _epoch_unit(latest):
    """The unit in which a time since 1970 is of our years, or None."""
    return next((unit for unit, power in units.TIME.items() if
                 _OUR_YEARS[0] < latest * 10.0 ** (power - 9) < _OUR_YEARS[1]), None)


def _likely_unit(step, latest):
    """The unit in which times are of our years, or else steps of usual rates."""
    return _epoch_unit(latest) or (
        "s" if step < 0.7 else "ms" if step < 300 else "us" if step < 3e5 else "ns")
