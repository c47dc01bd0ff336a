"""Ranges and velocities of a radar beside a recording: a CSV file."""

import csv
import re
from pathlib import Path

import numpy as np

from imu_fusion.errors import BagError
from imu_fusion.sources.source import is_number
from imu_fusion.sources.times import NANOSECONDS, calendar, is_calendar

# What the name of a column begins or ends with, and its unit if the name has one in brackets.
_COLUMNS = (("time", r"time|stamp", ("s", "utc")), ("range", r"range|distance", ("m",)),
            ("velocity", r"velocity|speed", ("m/s", "m s-1")))
_LARGEST = 1e10    # of any number; times end in 2286
_UNIX = 1e8    # s: later is a date, earlier counts from the start of the recording


def read_radar(path: str | Path, start: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read what a radar saw.

    Its first line names the columns: a time (ISO 8601, in UTC without a zone; or seconds, of 1970
    or since the start of the recording), a range or distance in m, and perhaps a velocity in m/s.

    Args:
        path: CSV file. start: first stamp of the recording, ns.

    Returns:
        (n,) s since start, (n,) m, (n,) m/s, nan where there is none.

    Raises:
        BagError: no such file or columns, another unit, a cell that is no number.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            rows = csv.reader(stream, skipinitialspace=True)
            places = _places(path, next(rows, []))
            found = [[_value(path, rows.line_num, name, row, place, start)
                      for name, place in places.items()] for row in rows if any(row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BagError(f"{path}: cannot be read as a table ({error})") from None
    if not found:
        raise BagError(f"{path}: holds no row")
    columns = dict(zip(places, np.array(found).T))
    return (columns["time"], columns["range"],
            columns.get("velocity", np.full(len(found), np.nan)))


def _places(path, header):
    """Name -> index of the columns."""
    places = {}
    for name, pattern, units in _COLUMNS:
        for index, cell in enumerate(header):
            if not re.search(pattern, cell, re.IGNORECASE):
                continue
            unit = re.search(r"\[(.*)\]", cell)
            if unit and unit[1].strip().lower() not in units:
                raise BagError(f"{path}: column '{cell}' is in {unit[1]}, expected {units[0]}")
            places[name] = index
            break
    missing = [name for name in ("time", "range") if name not in places]
    if missing:
        raise BagError(f"{path}: no column of {' and '.join(missing)} in its first line; there "
                       f"are: {', '.join(header)}")
    return places


def _value(path, line, name, row, place, start):
    """A cell as a number; of times, s since the start."""
    text = row[place].strip() if place < len(row) else ""
    try:
        if name == "velocity" and not text:
            return np.nan
        if name == "time" and is_calendar(text):
            return (calendar(text) - start) / NANOSECONDS
        value = float(text) if is_number(text) else np.nan
        if not abs(value) < _LARGEST or (name == "range" and value <= 0.0):
            raise ValueError
    except ValueError:
        raise BagError(f"{path}, line {line}: {name} is '{text}'") from None
    if name == "time" and value > _UNIX:
        return (round(value * NANOSECONDS) - start) / NANOSECONDS
    return value
