"""How a table is cut: delimiter, decimal sign, header, names and rows."""

import re
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from imu_fusion.errors import SampleError
from imu_fusion.sources import units
from imu_fusion.sources.header import Column, column_of
from imu_fusion.sources.source import BROKEN, decoded, is_number

_LINES = 3000           # that are looked at
_COMMENT = "#"
_OTHER_UNITS = ("-", "a.u.", "local_flux", "degc", "celsius", "pa", "hpa", "kpa", "v", "mv", "%",
                "no_units")


@dataclass
class Layout:
    """``names`` are those of the description; ``labels`` and ``units`` what stands above the
    columns, empty where nothing does; ``comment`` how lines between the rows begin that are none;
    ``score``: numeric cells per line, by which the likeliest way to cut is chosen."""

    score: float
    delimiter: str = ","
    decimal: str = "."
    skip: int = 0
    comment: str | None = None
    header: bool = True
    names: list[str] = field(default_factory=list)
    labels: list[str] = field(default_factory=list)
    units: list[str] = field(default_factory=list)
    rows: list[list[str]] = field(default_factory=list)

    def texts(self) -> dict[str, list[str]]:
        """What stands in each column, as written."""
        return {name: [row[k] for row in self.rows] for k, name in enumerate(self.names)}

    def values(self) -> dict[str, NDArray]:
        """The numbers (n,) of each column, NaN where there is none."""
        return {name: np.array([_number(row[k], self.decimal) for row in self.rows])
                for k, name in enumerate(self.names)}

    def columns(self) -> list[Column]:
        """What the header says of each column."""
        nothing = [""] * len(self.names)
        return [column_of(label, name, unit) for label, name, unit in zip(
            self.labels or nothing, self.names, self.units or nothing)]


def read_layout(data: bytes, where: str) -> Layout:
    """How a table is cut, from its beginning.

    Raises:
        SampleError: this is no table of numbers.
    """
    lines = [decoded(line.rstrip(b"\r")) for line in
             data.removeprefix(b"\xef\xbb\xbf").split(b"\n")[:_LINES]]
    if len(data) and not data.endswith(b"\n") and len(lines) > 2:
        lines.pop()    # perhaps cut in the middle
    best = max((_as_cut(lines, delimiter, decimal) for delimiter in (",", ";", "\t", "|", "space")
                for decimal in ".," if delimiter != decimal), key=lambda layout: layout.score)
    if best.score <= 0:
        raise SampleError(f"{where}: no rows of numbers are found; a table has a line for each "
                          "sample")
    best.rows = _sound(best)
    return best


def _as_cut(lines: list[str], delimiter: str, decimal: str) -> Layout:
    """How the lines look when cut so: its score is the number of numeric cells of like rows."""
    rows = [(k, _cut(line, delimiter)) for k, line in enumerate(lines) if line.strip()]
    numeric = {k: sum(np.isfinite(_number(c, decimal)) for c in cells) for k, cells in rows}
    like = [(k, cells) for k, cells in rows if len(cells) > 1 and numeric[k] >= 0.5 * len(cells)]
    if len(like) < 3:
        return Layout(0.0)
    width = Counter(len(cells) for _, cells in like).most_common(1)[0][0]
    body = [(k, cells) for k, cells in like if len(cells) == width]
    first = body[0][0]
    above = [(k, cells) for k, cells in rows if k < first]
    score = float(sum(numeric[k] for k, _ in body)) / len(rows)
    comment = _COMMENT if any(line.startswith(_COMMENT) for line in lines[first:]) else None
    layout = Layout(score, delimiter, decimal, comment=comment, rows=[cells for _, cells in body])
    _read_header(layout, above, width)
    if 2 * len(body) < len(rows) - (len(above) if layout.header else 0):
        return Layout(0.0)
    return layout


def _sound(layout: Layout) -> list[list[str]]:
    """The rows without those that have no number where nearly all others have one."""
    broken: set[int] = set()
    for k in range(len(layout.names)):
        none = [i for i, row in enumerate(layout.rows)
                if row[k] and not is_number(_pointed(row[k], layout.decimal))]
        broken |= set(none if len(none) <= BROKEN * len(layout.rows) else ())
    sound = [row for i, row in enumerate(layout.rows) if i not in broken]
    return sound if 2 * len(sound) > len(layout.rows) else layout.rows


def _cut(line: str, delimiter: str) -> list[str]:
    cells = line.split() if delimiter == "space" else line.split(delimiter)
    return [cell.strip().strip('"').strip() for cell in cells]


def _pointed(text: str, decimal: str) -> str:
    return text.replace(",", ".") if decimal == "," else text


def _number(text: str, decimal: str) -> float:
    text = _pointed(text, decimal)
    return float(text) if is_number(text) else np.nan


def _read_header(layout: Layout, above: list[tuple[int, list[str]]], width: int) -> None:
    """Names of the columns from the lines above them, the last of which may hold units."""
    open_end = all(not row[-1] for row in layout.rows)    # each row ends with a delimiter

    def of_columns(line):
        """The cells of a line that has one for each column; else none."""
        cells = above[line][1] if len(above) >= -line else []
        fits = len(cells) == width or (open_end and len(cells) == width - 1)
        return [*cells, *[""] * (width - len(cells))] if fits else []

    layout.skip = above[-1][0] if above else 0
    has_units = bool(above) and all(_is_unit(cell) for cell in above[-1][1])
    layout.labels = of_columns(-2 if has_units else -1)
    if has_units:
        layout.units = [_bare(cell) for cell in of_columns(-1)]
    # The reader takes names from the line above the rows alone.
    layout.header = bool(layout.labels) and not has_units
    layout.names = (layout.labels if layout.header else [str(k + 1) for k in range(width)])
    layout.skip += bool(above) and not layout.header


def _bare(unit: str) -> str:
    """A unit without brackets around it."""
    return unit[1:-1] if re.fullmatch(r"\(.*\)|\[.*\]", unit) else unit


def _is_unit(text: str) -> bool:
    text = _bare(text)
    return not text or text.lower() in _OTHER_UNITS or any(
        units.spelled(text, known) for known in (
            units.ACCELERATION, units.RATE, units.FIELD, units.LENGTH, units.SPEED, units.ANGLE,
            units.TIME))
