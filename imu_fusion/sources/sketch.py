"""What a table says of itself: a first description from its names, units and values.

Names and units that stand in the header are taken as they are; what they leave open is guessed from
the values (gravity and the Earth's field are always there), and each guess is marked. A table that
leaves nothing open needs no description.
"""

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from imu_fusion.sources import units
from imu_fusion.sources.header import ONES, Column
from imu_fusion.sources.table_layout import read_layout
from imu_fusion.sources.table_time import time_entry
from imu_fusion.sources.table_units import feels_gravity, rate_unit, unit_of


@dataclass
class Sketch:
    """A first description: ``content`` as in the YAML, ``remarks`` on its keys, ``doubts`` of
    which some key was guessed, ``unused`` columns."""

    content: dict[str, Any] = field(default_factory=dict)
    remarks: dict[str, str] = field(default_factory=dict)
    doubts: dict[str, str] = field(default_factory=dict)
    unused: list[str] = field(default_factory=list)

    def add(self, key: str, content: dict[str, Any], remark: str = "", doubt: str = "") -> None:
        """An entry, and what is to be said of it."""
        self.content[key] = content
        if remark:
            self.remarks[key] = remark
        if doubt:
            self.doubts[key] = doubt

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


@np.errstate(over="ignore", invalid="ignore")    # wild values fit to nothing
def sketch(data: bytes, where: str) -> Sketch:
    """A first description of a table from its beginning.

    Raises:
        SampleError: this is no table of numbers.
    """
    layout = read_layout(data, where)
    result = Sketch()
    delimiter = {"\t": "tab"}.get(layout.delimiter, layout.delimiter)
    for key, value, usual in (("delimiter", delimiter, ","), ("decimal", layout.decimal, "."),
                              ("comment", layout.comment, None), ("skip_lines", layout.skip, 0),
                              ("header", layout.header, True)):
        if value != usual:
            result.content[key] = value
    values, columns = layout.values(), layout.columns()
    time = time_entry(columns, values, layout.texts())
    result.add("time", time.content, time.remark, time.doubt)
    if not layout.labels:
        columns = _by_values(columns, values, time.content.get("column"))
    _sketch_vectors(result, columns, values, time.seconds(values))
    _sketch_gnss(result, columns, values)
    used = set(_used(result.content))
    result.unused = [c.name for c in columns if c.name and c.name not in used]
    return result


def _by_values(columns, values, time):
    """Without names: triples in a row, of which one shows gravity; the other two are taken for the
    gyroscope and the magnetometer in the usual order."""
    rest = [c for c in columns if c.name != time][:9]
    triples = [rest[k:k + 3] for k in range(0, len(rest) - 2, 3)]
    if not triples:
        return columns

    force = max(triples[:2], key=lambda triple: feels_gravity(_vectors(triple, values)))
    kinds = ("accelerometer", "gyroscope", "magnetometer")
    order = [force, *(t for t in triples if t is not force)]
    known = {c.name: Column(c.name, kind, axis) for kind, triple in zip(kinds, order)
             for axis, c in enumerate(triple)}
    return [known.get(c.name, c) for c in columns]


def _groups(columns, kind):
    """{group: columns of x, y, z} of the sensors of a kind of which all axes are there."""
    groups: dict[str, dict[int, Column]] = {}
    for c in columns:
        if c.kind == kind and c.axis is not None:
            groups.setdefault(c.group, {}).setdefault(c.axis, c)
    return {group: [axes[k] for k in range(3)] for group, axes in groups.items() if len(axes) == 3}


def _vectors(axes, values):
    return np.column_stack([values[c.name] for c in axes])


def _sketch_vectors(result, columns, values, seconds):
    for kind, known in (("accelerometer", units.ACCELERATION), ("gyroscope", units.RATE),
                        ("magnetometer", units.FIELD)):
        groups = _groups(columns, kind)
        named_so = bool(groups)
        if kind == "accelerometer" and not named_so:    # whatever they are called: front, back
            groups = {group: axes for group, axes in _groups(columns, "").items()
                      if feels_gravity(_vectors(axes, values))[0]}
        if kind == "accelerometer" and len(groups) > 1 and not (
                named_so and not all(re.search(r"\d", group) for group in groups)):
            _sketch_array(result, groups, values)
            continue
        if not groups:
            continue
        axes = next(iter(groups.values()))
        if kind == "accelerometer":
            axes = max(groups.values(), key=lambda group: feels_gravity(_vectors(group, values)))
        data = _vectors(axes, values)
        if kind == "gyroscope":
            unit, scale, doubt = rate_unit(axes[0].unit, data, _turned(columns, values), seconds)
        else:
            unit, scale, doubt = unit_of(kind, axes[0].unit, known, data)
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
    array: dict[str, dict[str, Any]] = {}
    for group, axes in groups.items():
        word = re.sub(r"\W", "", group)
        name = word if word.isidentifier() and word.isascii() else "a" + word
        unit, scale, doubt = unit_of("accelerometer", axes[0].unit, units.ACCELERATION,
                                      _vectors(axes, values))
        array[name] = {"columns": [c.name for c in axes], "unit": unit}
        if scale != 1.0:
            array[name]["scale"] = scale
        result.doubts[f"accelerometers.{name}"] = "; ".join(filter(None, [
            doubt, "add position: [x, y, z] in m, and axes where they are not those of the body"]))
    result.content["accelerometers"] = array


def _remark_gravity(result, acc):
    """Nothing tells the sign of gravity but the axis that points up, which nobody knows here."""
    mean = np.nanmedian(acc, axis=0)
    text = ("median (" + ", ".join(f"{v:.1f}" for v in mean)
            + ") m/s^2: at rest +9.8 on the axis that points up, else turn it with rotation")
    if mean[int(np.argmax(np.abs(mean)))] < 0:
        result.doubts["accelerometer"] = text + "; does this axis point down, or is the sign wrong"
    else:
        result.remarks["accelerometer"] = text


def _turned(columns, values):
    """Vectors (n, 3) that stand still in the world, as far as is known: field, or gravity."""
    for kind in ("magnetometer", "accelerometer"):
        groups = _groups(columns, kind)
        if groups:
            yield _vectors(next(iter(groups.values())), values)


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
