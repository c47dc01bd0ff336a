"""What a table says of itself: a first description from its names, units and values.

Names and units that stand in the header are taken as they are; what they leave open is guessed from
the values (gravity and the Earth's field are always there), and each guess is marked. A table that
leaves nothing open needs no description.
"""

import re
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from imu_fusion.errors import SampleError
from imu_fusion.sources import units
from imu_fusion.sources.header import ONES, TIME, WEEK, Column, column_of
from imu_fusion.sources.source import BROKEN, EPOCH, STANDARD_GRAVITY, decoded, is_number
from imu_fusion.sources.times import NANOSECONDS, calendar, is_calendar

_LINES = 3000           # that are looked at
_COMMENT = "#"
_FIELD = (15e-6, 80e-6)  # T, of the Earth, with room
_GRAVITY = (0.85, 1.15)  # of standard gravity, of a sensor at rest
_SINCE_START = 1e8      # s, three years: times below do not count from 1970
_OUR_YEARS = 9e8, 4e9   # s, since 1970
_COUNTERS = tuple(2.0 ** bits for bits in (16, 24, 32))    # at which they begin anew
_WEEKS = 1000, 10_000   # since 1980
_WEEK = 604_800.0       # s
_COUNTS = 50.0          # of whole numbers with a greater norm: counts of a converter

_LEAST_TURN = 0.3       # rad, that tells in which unit a gyroscope is
_WELL = 0.9             # share of what turned that a gyroscope explains
_OTHER_UNITS = ("-", "a.u.", "local_flux", "degc", "celsius", "pa", "hpa", "kpa", "v", "mv", "%",
                "no_units")
# Times of some loggers, by the name of their column: unit, s per tick.
_KNOWN_TIMES = {"sampletimefine": ("tick", 1e-4)}    # Xsens MT Manager


@dataclass
class Sketch:
    """A first description: ``content`` as in the YAML, ``remarks`` on its keys, ``doubts`` of
    which some key was guessed, ``unused`` columns."""

    content: dict[str, Any] = field(default_factory=dict)
    remarks: dict[str, str] = field(default_factory=dict)
    doubts: dict[str, str] = field(default_factory=dict)
    unused: list[str] = field(default_factory=list)

    @property
    def is_sure(self) -> bool:
        """Whether nothing had to be guessed."""
        return not self.doubts and any(k not in ("time",) and isinstance(v, dict)
                                       for k, v in self.content.items())

    def to_yaml(self) -> str:
        """The text of the description, each guess marked."""
        lines = ["# Read from the header and the values. Lines that end in 'guess' are to be "
                 "checked."]
        for key, value in self.content.items():
            if isinstance(value, dict) and any(isinstance(v, dict) for v in value.values()):
                lines.append(f"{key}:")
                lines += [f"  {name}: {_flow(v)}{self._mark(f'{key}.{name}')}"
                          for name, v in value.items()]
            else:
                lines.append(f"{key}: {_flow(value)}{self._mark(key)}")
        if self.unused:
            lines.append(f"# not used: {', '.join(self.unused)}")
        return "\n".join(lines) + "\n"

    def _mark(self, key: str) -> str:
        if key in self.doubts:
            return f"    # {self.doubts[key]}: guess"
        return f"    # {self.remarks[key]}" if key in self.remarks else ""


def _flow(value: Any) -> str:
    """YAML on one line; strings in quotes where they need them."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k}: {_flow(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_flow, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        plain = re.fullmatch(r"[A-Za-z_][\w/^]*", value) and value.lower() not in (
            "y", "n", "yes", "no", "on", "off", "true", "false", "null", "nan", "inf")
        return value if plain else '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return repr(value)


def sketch(data: bytes, where: str) -> Sketch:
    """A first description of a table from its beginning.

    Raises:
        SampleError: this is no table of numbers.
    """
    lines = [decoded(line.rstrip(b"\r")) for line in
             data.removeprefix(b"\xef\xbb\xbf").split(b"\n")[:_LINES]]
    if len(data) and not data.endswith(b"\n") and len(lines) > 2:
        lines.pop()    # perhaps cut in the middle
    best = max((_layout(lines, delimiter, decimal) for delimiter in (",", ";", "\t", "|", "space")
                for decimal in ".," if delimiter != decimal), key=lambda layout: layout.score)
    if best.score <= 0:
        raise SampleError(f"{where}: no rows of numbers are found; a table has a line for each "
                          "sample")
    rows = _sound(best)
    result = Sketch()
    delimiter = {"\t": "tab"}.get(best.delimiter, best.delimiter)
    comment = _COMMENT if any(line.startswith(_COMMENT) for line in lines[best.first:]) else None
    for key, value, usual in (("delimiter", delimiter, ","), ("decimal", best.decimal, "."),
                              ("comment", comment, None), ("skip_lines", best.skip, 0),
                              ("header", best.header, True)):
        if value != usual:
            result.content[key] = value
    values = {name: np.array([_value(row[k], best.decimal) for row in rows])
              for k, name in enumerate(best.names)}
    columns = [column_of(label, name, unit) for label, name, unit in zip(
        best.labels or [""] * len(best.names), best.names, best.units or [""] * len(best.names))]
    _sketch_time(result, columns, values, {name: [row[k] for row in rows]
                                           for k, name in enumerate(best.names)})
    if not best.labels:
        columns = _by_values(columns, values, result.content["time"].get("column"))
    _sketch_vectors(result, columns, values)
    _sketch_gnss(result, columns, values)
    used = set(_used(result.content))
    result.unused = [c.name for c in columns if c.name and c.name not in used]
    return result


@dataclass
class _Layout:
    """``names`` are those of the description; ``labels`` and ``units`` what stands above the
    columns, empty where nothing does; ``first`` the line of the first row."""

    score: float
    delimiter: str = ","
    decimal: str = "."
    skip: int = 0
    first: int = 0
    header: bool = True
    names: list[str] = field(default_factory=list)
    labels: list[str] = field(default_factory=list)
    units: list[str] = field(default_factory=list)
    rows: list[list[str]] = field(default_factory=list)


def _cut(line: str, delimiter: str) -> list[str]:
    cells = line.split() if delimiter == "space" else line.split(delimiter)
    return [cell.strip().strip('"').strip() for cell in cells]


def _pointed(text: str, decimal: str) -> str:
    return text.replace(",", ".") if decimal == "," else text


def _value(text: str, decimal: str) -> float:
    text = _pointed(text, decimal)
    return float(text) if is_number(text) else np.nan


def _sound(layout: "_Layout") -> list[list[str]]:
    """The rows without those that have no number where nearly all others have one."""
    broken: set[int] = set()
    for k in range(len(layout.names)):
        none = [i for i, row in enumerate(layout.rows)
                if row[k] and not is_number(_pointed(row[k], layout.decimal))]
        broken |= set(none if len(none) <= BROKEN * len(layout.rows) else ())
    return [row for i, row in enumerate(layout.rows) if i not in broken]


def _layout(lines: list[str], delimiter: str, decimal: str) -> _Layout:
    """How the lines look when cut so: its score is the number of numeric cells of like rows."""
    rows = [(k, _cut(line, delimiter)) for k, line in enumerate(lines) if line.strip()]
    numeric = {k: sum(np.isfinite(_value(c, decimal)) for c in cells) for k, cells in rows}
    like = [(k, cells) for k, cells in rows if len(cells) > 1 and numeric[k] >= 0.5 * len(cells)]
    if len(like) < 3:
        return _Layout(0.0)
    width = Counter(len(cells) for _, cells in like).most_common(1)[0][0]
    body = [(k, cells) for k, cells in like if len(cells) == width]
    first = body[0][0]
    above = [(k, cells) for k, cells in rows if k < first]
    score = float(sum(numeric[k] for k, _ in body)) / len(rows)
    layout = _Layout(score, delimiter, decimal, first=first, rows=[cells for _, cells in body])
    _read_header(layout, above, width)
    if 2 * len(body) < len(rows) - (len(above) if layout.header else 0):
        return _Layout(0.0)
    return layout


def _read_header(layout: _Layout, above: list[tuple[int, list[str]]], width: int) -> None:
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


def _sketch_time(result, columns, values, texts):
    """The time column: by name or unit, else the first that rises throughout."""
    for column in columns:
        if is_calendar(texts[column.name][0]) and _sketch_dates(
                result, column.name, texts[column.name], values):
            return
    turns = {c.name: _turn(values[c.name]) for c in columns}
    rising = [c for c in columns if turns[c.name] is not None]
    named_so = [c for c in columns if not c.kind and np.isfinite(values[c.name]).any() and (
        re.fullmatch(TIME, c.low) or (c in rising and units.spelled(c.unit, units.TIME)))]
    chosen = ([c for c in named_so if c in rising] or named_so or rising or [None])[0]
    if chosen is None:
        result.content["time"] = {"rate": 100.0}
        result.doubts["time"] = "no column of times is found, the rate is not known"
        return
    step = float(np.nanmedian(np.abs(np.diff(values[chosen.name]))))
    latest = float(np.nanmax(values[chosen.name]))
    logger = _KNOWN_TIMES.get(chosen.low)
    if logger:
        result.content["time"] = {"column": chosen.name, "unit": logger[0], "tick": logger[1],
                                  "wrap": 2.0 ** 32, "start": EPOCH * 1e-9}
        result.remarks["time"] = f"{1 / (step * logger[1]):.4g} Hz" if step else ""
        return
    known = _named_time_unit(chosen) or (_epoch_unit(latest) if chosen in named_so else None)
    unit = known or _time_unit(step, latest)
    time = result.content["time"] = {"column": chosen.name, "unit": unit}
    seconds = 10.0 ** (units.TIME[unit] - 9)
    week = next((c.name for c in columns if re.fullmatch(WEEK, c.low) and (
        np.ptp(values[c.name]) <= 1 and _WEEKS[0] < values[c.name][0] < _WEEKS[1])), None)
    if week is not None and latest * seconds <= _WEEK:
        time["week"] = week
    elif latest * seconds < _SINCE_START:
        time["start"] = EPOCH * 1e-9    # counted from some start
    rate = 1 / (step * seconds) if step else np.nan
    if not known or chosen not in named_so:
        result.doubts["time"] = (f"steps of {step:g} would be {rate:.4g} Hz" if step else
                                 "the times stand still")
    elif step:
        result.remarks["time"] = f"{rate:.4g} Hz"
        if not 0.05 <= rate <= 100e3:
            result.doubts["time"] = f"{rate:.4g} Hz, is the unit right?"
    if turns[chosen.name]:
        time["wrap"] = turns[chosen.name]
        result.doubts["time"] = f"{rate:.4g} Hz; a counter that begins anew"
    elif chosen not in rising:
        result.doubts["time"] = f"{rate:.4g} Hz; the times fall back, or stand still"


def _sketch_dates(result, name, texts, values):
    """Whether the texts are times that are written out; their seconds go to ``values``."""
    try:
        since = np.array([calendar(text.strip()) for text in texts], dtype=np.int64)
    except ValueError:
        return False
    result.content["time"] = {"column": name, "unit": "iso8601"}
    values[name] = (since - since[0]) / NANOSECONDS
    if since[0] < _SINCE_START * NANOSECONDS:
        result.content["time"]["start"] = EPOCH * 1e-9
        result.doubts["time"] = "hours without a date"
    return True


def _turn(values):
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


def _named_time_unit(column):
    """The unit that the name of a column of times tells, or None."""
    unit = units.spelled(column.unit, units.TIME)
    suffix = re.search(r"[ _](s|ms|us|ns|sec)$|(nano|micro|milli)", column.low)
    return unit or (suffix and {"nano": "ns", "micro": "us", "milli": "ms", "sec": "s"}.get(
        suffix[1] or suffix[2], suffix[1]))


def _epoch_unit(latest):
    """The unit in which a time since 1970 is of our years, or None."""
    return next((unit for unit, power in units.TIME.items() if
                 _OUR_YEARS[0] < latest * 10.0 ** (power - 9) < _OUR_YEARS[1]), None)


def _time_unit(step, latest):
    """The unit in which times are of our years, or else steps of usual rates."""
    return _epoch_unit(latest) or (
        "s" if step < 0.7 else "ms" if step < 300 else "us" if step < 3e5 else "ns")


def _by_values(columns, values, time):
    """Without names: triples in a row, of which one shows gravity; the other two are taken for the
    gyroscope and the magnetometer in the usual order."""
    rest = [c for c in columns if c.name != time][:9]
    triples = [rest[k:k + 3] for k in range(0, len(rest) - 2, 3)]
    if not triples:
        return columns

    force = max(triples[:2], key=lambda triple: _feels_gravity(triple, values))
    kinds = ("accelerometer", "gyroscope", "magnetometer")
    order = [force, *(t for t in triples if t is not force)]
    known = {c.name: Column(c.name, kind, axis) for kind, triple in zip(kinds, order)
             for axis, c in enumerate(triple)}
    return [known.get(c.name, c) for c in columns]


def _feels_gravity(axes, values):
    """(whether the norm at rest is that of gravity in some unit, that norm if it may be counts), by
    which the likeliest accelerometer has the greatest."""
    data = np.column_stack([values[c.name] for c in axes])
    norm = _quiet(data)
    fits = any(_GRAVITY[0] < norm * f / STANDARD_GRAVITY < _GRAVITY[1]
               for f in units.ACCELERATION.values())
    return fits, bool((data == np.round(data)).all()) * norm


def _groups(columns, kind):
    """{group: columns of x, y, z} of the sensors of a kind of which all axes are there."""
    groups: dict[str, dict[int, Column]] = {}
    for c in columns:
        if c.kind == kind and c.axis is not None:
            groups.setdefault(c.group, {}).setdefault(c.axis, c)
    return {group: [axes[k] for k in range(3)] for group, axes in groups.items() if len(axes) == 3}


def _sketch_vectors(result, columns, values):
    for kind, known in (("accelerometer", units.ACCELERATION), ("gyroscope", units.RATE),
                        ("magnetometer", units.FIELD)):
        groups = _groups(columns, kind)
        named_so = bool(groups)
        if kind == "accelerometer" and not named_so:    # whatever they are called: front, back
            groups = {group: axes for group, axes in _groups(columns, "").items()
                      if _feels_gravity(axes, values)[0]}
        if kind == "accelerometer" and len(groups) > 1 and not (
                named_so and not all(re.search(r"\d", group) for group in groups)):
            _sketch_array(result, groups, values)
            continue
        if not groups:
            continue
        axes = next(iter(groups.values()))
        if kind == "accelerometer":
            axes = max(groups.values(), key=lambda group: _feels_gravity(group, values))
        data = np.column_stack([values[c.name] for c in axes])
        if kind == "gyroscope":
            unit, scale, doubt = _rate_unit(axes[0].unit, data, _turned(columns, values),
                                            _seconds(result, values))
        else:
            unit, scale, doubt = _unit_of(kind, axes[0].unit, known, data)
        result.content[kind] = {"columns": [c.name for c in axes], "unit": unit}
        if scale != 1.0:
            result.content[kind]["scale"] = scale
        if len(groups) > 1:
            doubt = f"one of {len(groups)}" + (f"; {doubt}" if doubt else "")
        if doubt:
            result.doubts[kind] = doubt
        elif kind == "accelerometer":
            _remark_gravity(result, data * known[unit] / scale)


def _sketch_array(result, groups, values):
    array = {}
    for group, axes in groups.items():
        word = re.sub(r"\W", "", group)
        name = word if word.isidentifier() and word.isascii() else "a" + word
        unit, scale, doubt = _unit_of("accelerometer", axes[0].unit, units.ACCELERATION,
                                      np.column_stack([values[c.name] for c in axes]))
        array[name] = {"columns": [c.name for c in axes], "unit": unit}
        if scale != 1.0:
            array[name]["scale"] = scale
        result.doubts[f"accelerometers.{name}"] = "; ".join(filter(None, [
            doubt, "add position: [x, y, z] in m, and axes where they are not those of the body"]))
    result.content["accelerometers"] = array


def _quiet(data):
    """Median of the norms where they change least: (norm, mean vector)."""
    norms = np.linalg.norm(data, axis=1)
    norms = norms[np.isfinite(norms)]
    if len(norms) < 3:
        return np.nan
    size = max(min(50, len(norms) // 2), 2)
    windows = np.lib.stride_tricks.sliding_window_view(norms, size)
    return float(np.median(windows[int(np.argmin(np.ptp(windows, axis=1)))]))


def _unit_of(kind, written, known, data):
    """(unit, counts per unit, what is doubtful) of a sensor."""
    unit = units.spelled(written, known)
    rest = _quiet(data)
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


def _remark_gravity(result, acc):
    """Nothing tells the sign of gravity but the axis that points up, which nobody knows here."""
    mean = np.nanmedian(acc, axis=0)
    text = ("median (" + ", ".join(f"{v:.1f}" for v in mean)
            + ") m/s^2: at rest +9.8 on the axis that points up, else turn it with rotation")
    if mean[int(np.argmax(np.abs(mean)))] < 0:
        result.doubts["accelerometer"] = text + "; does this axis point down, or is the sign wrong"
    else:
        result.remarks["accelerometer"] = text


def _seconds(result, values):
    """Times in s, or None."""
    time = result.content["time"]
    if "column" not in time:
        return None
    factor = time.get("tick") or 10.0 ** (units.TIME.get(time["unit"], 9) - 9)
    turns = np.cumsum(np.diff(values[time["column"]], prepend=0.0) < 0)
    return (values[time["column"]] + turns * time.get("wrap", 0.0)) * factor


def _turned(columns, values):
    """Vectors (n, 3) that stand still in the world, as far as is known: field, or gravity."""
    for kind in ("magnetometer", "accelerometer"):
        groups = _groups(columns, kind)
        if groups:
            yield np.column_stack([values[c.name] for c in next(iter(groups.values()))])


def _rate_unit(written, data, vectors, time):
    """(unit, counts per unit, what is doubtful) of a gyroscope. A vector v that stands still in
    the world turns as dv/dt = -rate x v in the sensor, whatever the unit of v: that tells the unit
    of the rate."""
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


def _sketch_gnss(result, columns, values):
    have = {c.kind: c for c in columns if c.kind in ONES}

    def unit(kind, known, usual, key):
        found = units.spelled(have[kind].unit, known)
        if found is None:
            result.doubts[key] = f"unit of {have[kind].name} not named"
        return found or usual

    if {"lat", "lon", "height"} <= have.keys():
        angle = units.spelled(have["lat"].unit, units.ANGLE)
        peak = float(np.nanmax(np.abs(values[have["lon"].name])))
        entry: dict[str, Any] = {
            "columns": [have[k].name for k in ("lat", "lon", "height")],
            "unit": angle or ("deg" if peak <= 360 else "1e-7 deg"),
            "height_unit": unit("height", units.LENGTH, "m", "position")}
        accuracy = [have[k].name for k in ("h_acc", "v_acc") if k in have]
        if len(accuracy) == 2:
            entry["accuracy"] = accuracy
        if "fix" in have:
            entry["fix"] = have["fix"].name
        result.content["position"] = entry
    frames = ((("north", "east", "down"), "ned"), (("east", "north", "up"), "enu"),
              (("speed", "course"), "course"))
    for kinds, frame in frames:
        if set(kinds) <= have.keys():
            result.content["velocity"] = {
                "columns": [have[k].name for k in kinds], "frame": frame,
                "unit": unit(kinds[0], units.SPEED, "m/s", "velocity")}
            if "s_acc" in have:
                result.content["velocity"]["accuracy"] = [have["s_acc"].name]
            break
    if {"qx", "qy", "qz", "qw"} <= have.keys():
        result.content["reference"] = {"columns": [have[k].name for k in ("qx", "qy", "qz", "qw")]}
        result.doubts["reference"] = "taken as world (east, north, up) <- imu"


def _used(content):
    for value in content.values():
        if isinstance(value, dict):
            yield from _used(value)
        elif isinstance(value, list):
            yield from (v for v in value if isinstance(v, str))
        elif isinstance(value, str):
            yield value
