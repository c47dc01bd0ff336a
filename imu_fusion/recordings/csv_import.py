"""Tables of accelerometers (CSV) as recordings: a YAML description instead of a program.

    delimiter: ","             # or "tab", "space" (any white space)
    skip_lines: 0              # ahead of the line of column names
    header: true               # false: there are no names, columns are numbered from 1
    time: {column: t, unit: ms, start: 1700000000.0}     # or {rate: 1000.0}
    position_unit: mm
    accelerometers:
      front:
        columns: [a1x, a1y, a1z]       # of the measured axes, in the order x, y, z
        unit: g
        position: [150, 0, 0]          # and all else that describes an accelerometer
    gyroscope: {columns: [wx, wy, wz], unit: deg/s}      # if there is one; also noise_density, ...
    parameters: {points: [0.0, 0.0, 0.05]}               # further ones of the estimator

The result is a recording and a parameter file of the acceleration field estimator for it.
"""

import csv
import os
import re
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from imu_fusion.errors import BagError, ParameterError, SampleError
from imu_fusion.estimation.acceleration_field.params import AccelerometerParams, Sensor
from imu_fusion.messages.convert import imu_message
from imu_fusion.messages.layouts import IMU, NANOSECONDS
from imu_fusion.parameters.bounded_yaml import read_yaml
from imu_fusion.parameters.declare import Parameters, flatten, param
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.targets import refuse_files, refuse_source
from imu_fusion.streams.acceleration_field import (
    GYROSCOPE_TOPIC,
    NODE,
    NODE_PARAMETERS,
    FieldConfiguration,
)

TIME_UNITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}  # powers of ten to nanoseconds
LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
ACCELERATION_UNITS = {"m/s^2": 1.0, "g": 9.80665, "mg": 9.80665e-3}
RATE_UNITS = {"rad/s": 1.0, "deg/s": np.pi / 180.0}
_DELIMITERS = {"tab": "\t", "space": None}
_SENSOR_AXES = ("x", "y", "z")
# Python's own numbers would also be 1_0 and digits of other scripts.
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_NOT_FINITE = ("nan", "inf", "-inf", "+inf")
_LATEST = 2**31 - 1    # seconds since 1970 in builtin_interfaces/Time
_DIGITS = 22           # of nanoseconds, with room


@dataclass(frozen=True)
class TimeParams(Parameters):
    """``time.*``: when the rows were measured."""

    column: str | None = param(None, doc="Column of the times; without one, give the rate.")
    unit: str = param("s", choices=tuple(TIME_UNITS), doc="Unit of the times.")
    start: float = param(
        0.0, unit="s", low=0.0, high=float(_LATEST),
        doc="Added to the times. Give the Unix time of their zero.")
    rate: float | None = param(
        None, unit="Hz", low=1e-3, doc="Rate of the rows, if the table has no times.")


@dataclass(frozen=True)
class TableParams(Parameters):
    """How the table is written."""

    delimiter: str = param(",", doc="Between two cells: one character, 'tab' or 'space'.")
    skip_lines: int = param(0, low=0, doc="Lines ahead of the column names.")
    header: bool = param(True, doc="Whether a line of column names leads the rows.")
    position_unit: str = param("m", choices=tuple(LENGTH_UNITS), doc="Unit of the positions.")
    time: TimeParams = TimeParams()


@dataclass(frozen=True)
class _AccelerometerColumns(Parameters):
    columns: tuple[str, ...] = param((), doc="Columns of the measured axes, x before y before z.")
    unit: str = param("m/s^2", choices=tuple(ACCELERATION_UNITS), doc="Unit of the columns.")


@dataclass(frozen=True)
class _GyroscopeColumns(Parameters):
    columns: tuple[str, ...] = param((), length=3, doc="Columns of x, y and z.")
    unit: str = param("rad/s", choices=tuple(RATE_UNITS), doc="Unit of the columns.")


@dataclass(frozen=True)
class _Sensor:
    """What to read of one sensor: (column, axis) pairs, factor to SI, its parameters."""

    topic: str
    pairs: tuple[tuple[str, int], ...]
    factor: float
    params: AccelerometerParams | Sensor

    def messages(self, stamps, table, frame_id):
        """Yield (stamp, cdr)."""
        values = np.zeros((len(stamps), 3))
        for column, axis in self.pairs:
            values[:, axis] = table[column] * self.factor
        rates = isinstance(self.params, Sensor)
        for stamp, value in zip(stamps, values):
            gyr, acc = (value, None) if rates else (None, value)
            yield int(stamp), imu_message(stamp, frame_id, gyr, acc)


class _Dumper(yaml.SafeDumper):
    """Quotes all strings: the parser of ROS takes a bare y, n or on for a truth value."""


_Dumper.add_representer(str, lambda dumper, text: dumper.represent_scalar(
    "tag:yaml.org,2002:str", text, style='"'))


def import_csv(source: str | Path, description: str | Path, out: str | Path,
               overwrite: bool = False) -> tuple[Path, int]:
    """Convert a table to a recording and, beside it, a parameter file.

    Args:
        source: CSV file.
        description: YAML file, see the module.
        out: rosbag2 directory to write; the parameter file is ``<out>.yaml``.
        overwrite: replace both.

    Returns:
        (path of the parameter file, number of rows)

    Raises:
        ImuFusionError: names the file with the line, column, unit or parameter that is wrong.
    """
    out = Path(out)
    parameter_file = out.with_name(out.name + ".yaml")
    refuse_source(source, out)
    refuse_source(description, out)
    refuse_files([source, description], parameter_file)
    if parameter_file.exists() and not overwrite:
        raise BagError(f"{parameter_file}: exists already; choose another name or --overwrite")
    table_params, sensors, given = _read_description(description)
    columns = {column for sensor in sensors for column, _ in sensor.pairs}
    stamps, table = _read_table(source, table_params, columns)
    values = _parameters(sensors, given, stamps)
    config = FieldConfiguration.from_mapping(values, str(description))
    config.make_estimator()  # an array that cannot work is refused before anything is written
    rows = [(stamp, topic_rank, sensor.topic, cdr) for topic_rank, sensor in enumerate(sensors)
            for stamp, cdr in sensor.messages(stamps, table, config.stream.body_frame)]
    rows.sort(key=lambda row: row[:2])
    text = (f"# Made from {Path(source).name} as {Path(description).name} says.\n"
            + yaml.dump({NODE: {"ros__parameters": values}}, Dumper=_Dumper, sort_keys=False,
                        default_flow_style=None, width=100))
    with BagWriter(out, overwrite=overwrite, whole=True) as writer:
        for stamp, _, topic, cdr in rows:
            writer.write("/" + topic, IMU.msgtype, cdr, stamp)
        beside = parameter_file.with_name(f".{parameter_file.name}.part")
        try:
            beside.write_text(text)
        except OSError as error:
            raise BagError(f"{parameter_file}: cannot be written ({error.strerror})") from None
    os.replace(beside, parameter_file)
    return parameter_file, len(stamps)


def _read_description(path):
    """(TableParams, list of _Sensor, dict of the other parameters) of a description."""
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise ParameterError(f"{path}: must map names to values; see the documentation of convert")
    arrays, gyroscope, given = (_mapping(content.pop(key, None), key, path)
                                for key in ("accelerometers", "gyroscope", "parameters"))
    if isinstance(content.get("time"), dict) and "column" in content["time"]:
        content["time"] = {**content["time"], "column": str(content["time"]["column"])}
    table = TableParams.from_mapping(content, str(path))
    if (table.time.column is None) == (table.time.rate is None):
        raise ParameterError(f"{path}: give either time.column or time.rate")
    if len(table.delimiter) != 1 and table.delimiter not in _DELIMITERS:
        raise ParameterError(f"{path}: delimiter '{table.delimiter}' is not one character, "
                             + " or ".join(f"'{name}'" for name in _DELIMITERS))
    scale = LENGTH_UNITS[table.position_unit]
    sensors = [_accelerometer(name, values, scale, path) for name, values in arrays.items()]
    if not sensors:
        raise ParameterError(f"{path}: names no accelerometers")
    if gyroscope:
        read, own = _split(gyroscope, _GyroscopeColumns, f"{path}: gyroscope")
        params = Sensor.from_mapping({f"gyro_{name}": value for name, value in own.items()},
                                     f"{path}: gyroscope")
        sensors.append(_Sensor(GYROSCOPE_TOPIC, tuple(zip(read.columns, range(3))),
                               RATE_UNITS[read.unit], params))
    return table, sensors, given


def _mapping(value, name, path):
    if not isinstance(value or {}, dict):
        raise ParameterError(f"{path}: '{name}' must map names to values")
    return value or {}


def _accelerometer(name, values, scale, path):
    values = _mapping(values, f"accelerometers.{name}", path)
    if not str(name).isidentifier() or not str(name).isascii():
        raise ParameterError(f"{path}: accelerometer '{name}' would be part of a topic: letters, "
                             "digits and underscores only, no digit first")
    source = f"{path}: accelerometers.{name}"
    read, own = _split(values, _AccelerometerColumns, source)
    params = AccelerometerParams.from_mapping(own, source)
    params = params.replace(position=tuple(scale * v for v in params.position))
    axes = [k for k, axis in enumerate(_SENSOR_AXES) if axis in params.measured_axes]
    if len(read.columns) != len(axes):
        raise ParameterError(f"{path}: accelerometers.{name}: {len(read.columns)} columns for "
                             f"the measured axes {', '.join(_SENSOR_AXES[k] for k in axes)}")
    return _Sensor(f"accelerometers/{name}", tuple(zip(read.columns, axes)),
                   ACCELERATION_UNITS[read.unit], params)


def _split(values, columns_class, source):
    """What the table says of a sensor, and the other values: what the estimator must know."""
    names = {info.name for info in columns_class.infos()}
    own = {key: value for key, value in values.items() if key in names}
    if isinstance(own.get("columns"), list):
        own["columns"] = [str(column) for column in own["columns"]]
    else:
        raise ParameterError(f"{source}: 'columns' must list the columns of the table")
    return (columns_class.from_mapping(own, source),
            {name: value for name, value in values.items() if name not in names})


def _read_table(source, params, columns):
    """(stamps (n,) int64, dict of column to (n,) float64, NaN for empty cells) of a table."""
    try:
        with open(source, newline="", encoding="utf-8-sig") as stream:
            for number in range(params.skip_lines):
                if not stream.readline():
                    raise SampleError(f"{source}: has {number} lines, fewer than the "
                                      f"{params.skip_lines} of skip_lines")
            delimiter = _DELIMITERS.get(params.delimiter, params.delimiter)
            lines = (csv.reader(stream, delimiter=delimiter) if delimiter is not None
                     else (line.split() for line in stream))
            rows = [(number, row) for number, row in enumerate(lines, params.skip_lines + 1)
                    if any(cell.strip() for cell in row)]
    except OSError as error:
        raise BagError(f"{source}: cannot be read ({error.strerror})") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise SampleError(f"{source}: not a table of text: {error}") from None
    names = [str(i + 1) for i in range(len(rows[0][1]))] if rows else []
    if params.header and rows:
        names = [cell.strip() for cell in rows.pop(0)[1]]
    if len(rows) < 2:
        raise SampleError(f"{source}: {len(rows)} rows of numbers; is skip_lines or header right?")
    wanted = sorted(columns) + ([params.time.column] if params.time.column else [])
    for name in wanted:
        if names.count(name) != 1:
            raise ParameterError(
                f"{source}: {'no' if name not in names else 'more than one'} column '{name}'; "
                f"there are: {', '.join(names)}")
    table = {name: np.array([read_number(source, number, name, row, names.index(name))
                             for number, row in rows]) for name in columns}
    if params.time.column is None:
        last = params.time.start + len(rows) / params.time.rate
        if last > _LATEST:
            raise SampleError(f"{source}: {len(rows)} rows at {params.time.rate:g} Hz end at "
                              f"{last:g} s, which no stamp of ROS can hold (at most {_LATEST} s)")
        since = np.round(np.arange(len(rows)) * (NANOSECONDS / params.time.rate))
        return since.astype(np.int64) + round(params.time.start * NANOSECONDS), table
    place = names.index(params.time.column)
    times = [_stamp(source, number, row, place, params) for number, row in rows]
    if max(times) > _LATEST * NANOSECONDS:
        raise SampleError(f"{source}: column '{params.time.column}' ends at "
                          f"{max(times) / NANOSECONDS:g} s, which no stamp of ROS can hold (at "
                          f"most {_LATEST} s): is time.unit right?")
    stamps = np.array(times, dtype=np.int64)
    if stamps.min() < 0:
        raise SampleError(f"{source}: column '{params.time.column}' begins at "
                          f"{stamps.min() * 1e-9:g} s; stamps cannot be negative: give time.start")
    return stamps, table


def _cell(source, line, name, row, place):
    if place >= len(row):
        raise SampleError(f"{source}, line {line}: {len(row)} cells, column '{name}' is missing")
    return row[place].strip()


def read_number(source: str | Path, line: int, name: str, row: list[str], place: int) -> float:
    """The number in cell ``place`` of a row, NaN if empty; SampleError names what it is not."""
    text = _cell(source, line, name, row, place)
    if not text:
        return np.nan
    if not _NUMBER.fullmatch(text) and text.lower() not in _NOT_FINITE:
        raise SampleError(f"{source}, line {line}, column '{name}': '{text[:40]}' is not a number")
    return float(text)


def _stamp(source, line, row, place, params):
    text = _cell(source, line, params.time.column, row, place)
    try:
        # Seconds since 1970 exceed what a float tells apart in nanoseconds.
        since = Decimal(text if _NUMBER.fullmatch(text) else "").scaleb(
            TIME_UNITS[params.time.unit])
        if since.adjusted() < _DIGITS:    # before digits are made of an exponent
            return int(since.to_integral_value()) + round(params.time.start * NANOSECONDS)
    except (ArithmeticError, ValueError):
        pass
    raise SampleError(f"{source}, line {line}, column '{params.time.column}': '{text[:40]}' is "
                      "not a time")


def _changed(params):
    """The parameters that differ from their defaults."""
    defaults = type(params)().to_mapping()
    return {name: value for name, value in params.to_mapping().items()
            if value != defaults.get(name)}


def _parameters(sensors, given, stamps):
    """Nested ROS parameters of the estimator; the sample rate from the stamps if not given."""
    arrays = {s.topic.rpartition("/")[2]: {"position": list(s.params.position),
                                           **_changed(s.params)} for s in sensors
              if isinstance(s.params, AccelerometerParams)}
    values: dict[str, Any] = {"accelerometers": {"names": list(arrays), **arrays}}
    flat = flatten(given)
    for s in sensors:
        if isinstance(s.params, Sensor):
            values["use_gyro"] = True
            flat = {f"sensor.{name}": value for name, value in _changed(s.params).items()} | flat
    if "sample_rate" not in flat:
        step = np.median(np.diff(stamps))
        if step <= 0:
            raise SampleError("the times of the table do not increase; is time.unit right?")
        flat["sample_rate"] = float(NANOSECONDS / step)
    known = {info.name: info for cls in NODE_PARAMETERS for info in cls.infos()}
    for name, value in flat.items():
        # In the types that ROS asks for: 1 is no floating point number there.
        if name in known:
            value = known[name].check(value, "parameters")
        values[name] = list(value) if isinstance(value, tuple) else value
    return values
