"""A table of measured lengths of jumps beside the results of their recordings."""

import csv
import math
from pathlib import Path
from typing import Any

import numpy as np

from imu_fusion.errors import BagError
from imu_fusion.recordings.results import results_of
from imu_fusion.sources.source import is_number

_COLUMNS = ("recording", "measured")
_NODE = "smoother"


def read_lengths(table: str | Path) -> tuple[tuple[str, ...], np.ndarray, np.ndarray, np.ndarray]:
    """Measured lengths from a table, estimated ones from the results that it names.

    Returns:
        Of n jumps: names as in the table; estimated lengths, their standard deviations, measured
        lengths, (n,) m each.

    Args:
        table: CSV file with the columns ``recording``, an OUT of ``process`` or ``pipeline``
            (relative to the table), and ``measured``, m.

    Raises:
        BagError: no such table, columns or lengths; a recording without a jump.
    """
    table = Path(table)
    try:
        with table.open(newline="", encoding="utf-8-sig") as stream:
            rows = csv.DictReader(stream, skipinitialspace=True)
            missing = [name for name in _COLUMNS if name not in (rows.fieldnames or ())]
            if missing:
                raise BagError(f"{table}: no column {' and '.join(missing)} in its first line")
            found = [(row["recording"], *_length(table, rows.line_num, row)) for row in rows]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BagError(f"{table}: cannot be read as a table ({error})") from None
    if not found:
        raise BagError(f"{table}: holds no row")
    names, *numbers = zip(*found)
    estimated, sd, measured = (np.array(column) for column in numbers)
    return names, estimated, sd, measured


def _length(table, line, row):
    """Estimated length, its standard deviation and the measured length of a row of the table."""
    text = (row["measured"] or "").strip()
    measured = float(text) if is_number(text) else math.nan
    if not 0.0 < measured < math.inf:
        raise BagError(f"{table}, line {line}: measured is {row['measured']!r}, no length in m")
    recording = table.parent / (row["recording"] or "")
    jump: Any = results_of(recording, _NODE).get("jump")
    try:
        return float(jump["length"]), float(jump["length_sd"]), measured
    except (TypeError, KeyError, ValueError):
        raise BagError(f"{table}, line {line}: {recording} holds no smoothed jump (process "
                       "it with surface.file set to the hill)") from None
