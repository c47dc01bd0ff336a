"""Descriptions of tables: what is in which column, in which unit, in which axes.

    delimiter: ","             # one character, "tab" or "space" (any white space)
    decimal: "."               # or ","
    comment: "#"               # lines that begin so are left out
    skip_lines: 0              # ahead of the line of column names
    header: true               # false: there are no names, columns are numbered from 1
    time: {column: t, unit: ms, start: 1700000000.0}     # or {rate: 1000.0}
    accelerometer: {columns: [ax, ay, az], unit: g, scale: 2048}     # counts per unit
    gyroscope: {columns: [gx, gy, gz], unit: deg/s, rotation: [0, 1, 0, 1, 0, 0, 0, 0, -1]}
    magnetometer: {columns: [mx, my, mz], unit: uT}
    position: {columns: [lat, lon, h], unit: 1e-7 deg, height_unit: mm, accuracy: [hAcc, vAcc]}
    velocity: {columns: [vn, ve, vd], unit: mm/s, frame: ned, accuracy: [sAcc]}
    reference: {columns: [qx, qy, qz, qw]}
    accelerometers: {front: {columns: [a1x, a1y, a1z], unit: g}}     # of an array

Accelerometer and gyroscope are imu/data_raw, magnetometer imu/mag, position fix, velocity
fix_velocity, reference the orientation world <- imu on reference/pose. What else stands at a sensor
of an array, and below ``parameters``, is for the estimator; ``position_unit`` is that of positions
of accelerometers.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_fusion.errors import ParameterError
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.sources import units
from imu_fusion.sources.source import (
    ARRAY_TOPIC,
    FIX_TOPIC,
    IMU_TOPIC,
    MAG_TOPIC,
    REFERENCE_TOPIC,
    VELOCITY_TOPIC,
)

DELIMITERS = {"tab": "\t", "space": None}
AXES = ("x", "y", "z")
LATEST = 2**31 - 1    # seconds since 1970 in builtin_interfaces/Time
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class TimeParams(Parameters):
    """``time.*``: when the rows were measured."""

    column: str | None = param(None, doc="Column of the times; without one, give the rate.")
    unit: str = param("s", choices=(*units.TIME, "tick", "iso8601"), doc="Unit of the times; a "
                      "tick lasts `tick`; a time of ISO 8601 without a zone is taken as UTC, "
                      "hours alone count from midnight.")
    tick: float | None = param(None, unit="s", low=1e-9, high=1.0, doc="Length of a tick.")
    wrap: float | None = param(
        None, low=1.0, doc="Value, in the unit of the column, at which the counter begins anew, "
        "such as 4294967296.")
    week: str | None = param(
        None, doc="Column of GPS weeks: the times are those of the week.")
    leap_seconds: float = param(18.0, unit="s", low=0, high=100, doc="GPS time minus UTC.")
    start: float = param(
        0.0, unit="s", low=0.0, high=float(LATEST),
        doc="Added to the times. Give the Unix time of their zero.")
    rate: float | None = param(
        None, unit="Hz", low=1e-3, doc="Rate of the rows, if the table has no times.")


@dataclass(frozen=True)
class TableParams(Parameters):
    """How the table is written."""

    delimiter: str = param(",", doc="Between two cells: one character, 'tab' or 'space'.")
    decimal: str = param(".", choices=(".", ","), doc="Sign ahead of decimals.")
    comment: str | None = param(None, doc="Lines that begin so are left out.")
    skip_lines: int = param(0, low=0, doc="Lines ahead of the column names.")
    header: bool = param(True, doc="Whether a line of column names leads the rows.")
    position_unit: str = param("m", choices=tuple(units.LENGTH), doc="Unit of the positions.")
    time: TimeParams = TimeParams()


def _vector(units_known: Mapping[str, float], default: str) -> type[Parameters]:
    """The keys of a sensor of three axes."""

    @dataclass(frozen=True)
    class Vector(Parameters):
        columns: tuple[str, ...] = param((), length=3, doc="Columns of x, y and z.")
        unit: str = param(default, choices=tuple(units_known), doc="Unit of the columns.")
        scale: float = param(1.0, low=1e-12, doc="Counts per unit.")
        rotation: tuple[float, ...] = param(
            IDENTITY, length=9, low=-1.0, high=1.0,
            doc="R of v_imu = R v_columns, row by row; orthonormal, either handedness.")

    return Vector


@dataclass(frozen=True)
class _Array(Parameters):
    columns: tuple[str, ...] = param((), doc="Columns of the measured axes, x before y before z.")
    unit: str = param("m/s^2", choices=tuple(units.ACCELERATION), doc="Unit of the columns.")
    scale: float = param(1.0, low=1e-12, doc="Counts per unit.")


@dataclass(frozen=True)
class _Position(Parameters):
    columns: tuple[str, ...] = param((), length=3, doc="Columns of latitude, longitude, height.")
    unit: str = param("deg", choices=tuple(units.ANGLE), doc="Unit of latitude and longitude.")
    height_unit: str = param("m", choices=tuple(units.LENGTH), doc="Unit of height and accuracy.")
    accuracy: tuple[str, ...] = param(
        (), length=(0, 1, 2), doc="Columns of the standard deviation: horizontal, vertical.")
    fix: str | None = param(None, doc="Column that tells whether there is a fix.")
    fix_at_least: float = param(3.0, doc="Its least value with one.")


@dataclass(frozen=True)
class _Velocity(Parameters):
    columns: tuple[str, ...] = param(
        (), length=(2, 3), doc="Columns of the components; of speed and course with frame course.")
    unit: str = param("m/s", choices=tuple(units.SPEED), doc="Unit of the speeds.")
    frame: str = param("enu", choices=("enu", "ned", "course"),
                       doc="Order of the components; course: degrees clockwise from north.")
    accuracy: tuple[str, ...] = param(
        (), length=(0, 1, 2), doc="Columns of the standard deviation: horizontal, vertical.")


@dataclass(frozen=True)
class _Reference(Parameters):
    columns: tuple[str, ...] = param(
        (), length=4, doc="Columns of the quaternion x, y, z, w, world <- imu.")


_SENSORS: dict[str, type[Parameters]] = {
    "accelerometer": _vector(units.ACCELERATION, "m/s^2"),
    "gyroscope": _vector(units.RATE, "rad/s"), "magnetometer": _vector(units.FIELD, "uT"),
    "position": _Position, "velocity": _Velocity, "reference": _Reference}
_TOPICS = {"accelerometer": IMU_TOPIC, "gyroscope": IMU_TOPIC, "magnetometer": MAG_TOPIC,
           "position": FIX_TOPIC, "velocity": VELOCITY_TOPIC, "reference": REFERENCE_TOPIC}


@dataclass(frozen=True)
class Description:
    """A table: how it is written, its sensors by name of the key, those of an array by their name
    with their measured axes, and what is said for the estimator."""

    table: TableParams
    sensors: dict[str, Any]
    array: dict[str, tuple[Any, tuple[int, ...]]]
    own: dict[str, dict[str, Any]]
    parameters: dict[str, Any]

    @classmethod
    def from_mapping(cls, content: Any, source: str) -> "Description":
        """Of the content of a YAML file; ``source`` names it in errors.

        Raises:
            ParameterError: a name, unit or value is wrong.
        """
        if not isinstance(content, dict):
            raise ParameterError(f"{source}: must map names to values; see the documentation of "
                                 "convert")
        content = dict(content)
        arrays = _mapping(content.pop("accelerometers", None), "accelerometers", source)
        given = _mapping(content.pop("parameters", None), "parameters", source)
        own: dict[str, dict[str, Any]] = {}
        sensors = {}
        for key, kind in _SENSORS.items():
            values = _mapping(content.pop(key, None), key, source)
            if values:
                sensors[key], own[key] = _split(values, kind, f"{source}: {key}",
                                                bool(arrays) and key == "gyroscope")
        table = TableParams.from_mapping(_texts(content, "time", ("column", "week")), source)
        _check_table(table, source)
        array = {}
        for name, values in arrays.items():
            array[name], own[name] = _array_sensor(name, values, source)
        if not sensors and not array:
            raise ParameterError(f"{source}: names no sensors: "
                                 f"{', '.join(_SENSORS)} or accelerometers")
        if given and not array:
            raise ParameterError(f"{source}: 'parameters' are those of the acceleration field, "
                                 "but it names no accelerometers")
        return cls(table, sensors, array, own, given)

    def topics(self) -> tuple[str, ...]:
        """Topics that the table holds."""
        return (*(ARRAY_TOPIC + name for name in self.array),
                *dict.fromkeys(_TOPICS[key] for key in self.sensors))

    def columns(self) -> list[str]:
        """Names of the columns of numbers."""
        names = [name for sensor, _ in self.array.values() for name in sensor.columns]
        for sensor in self.sensors.values():
            names += [*sensor.columns, *getattr(sensor, "accuracy", ())]
            if getattr(sensor, "fix", None):
                names.append(sensor.fix)
        return list(dict.fromkeys(names))


def _mapping(value, name, source):
    if not isinstance(value or {}, dict):
        raise ParameterError(f"{source}: '{name}' must map names to values")
    return value or {}


def _texts(content, group, keys):
    """Columns may be numbers: as the texts that they are in the description."""
    if isinstance(content.get(group), dict):
        content[group] = {k: str(v) if k in keys and v is not None else v
                          for k, v in content[group].items()}
    return content


def _split(values, kind, source, keep_others):
    """What the table says of a sensor, and the other values: what the estimator must know."""
    names = {info.name for info in kind.infos()}
    own = {key: value for key, value in values.items() if key in names or not keep_others}
    for key in ("columns", "accuracy"):
        if isinstance(own.get(key), list):
            own[key] = [str(column) for column in own[key]]
    if not isinstance(own.get("columns"), list):
        raise ParameterError(f"{source}: 'columns' must list the columns of the table")
    own = _texts({"": own}, "", ("fix",))[""]
    made: Any = kind.from_mapping(own, source)
    if kind is _Velocity and (len(made.columns) == 2) != (made.frame == "course"):
        raise ParameterError(f"{source}: frame course has two columns, enu and ned have three")
    rotation = np.reshape(getattr(made, "rotation", IDENTITY), (3, 3))
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise ParameterError(f"{source}: 'rotation' is not orthonormal")
    return made, {k: v for k, v in values.items() if k not in names and keep_others}


def _array_sensor(name, values, source):
    values = _mapping(values, f"accelerometers.{name}", source)
    if not str(name).isidentifier() or not str(name).isascii():
        raise ParameterError(f"{source}: accelerometer '{name}' would be part of a topic: letters, "
                             "digits and underscores only, no digit first")
    read, own = _split(values, _Array, f"{source}: accelerometers.{name}", True)
    measured = own.get("measured_axes", AXES)
    axes = tuple(k for k, axis in enumerate(AXES) if axis in measured)
    if len(read.columns) != len(axes):
        raise ParameterError(f"{source}: accelerometers.{name}: {len(read.columns)} columns for "
                             f"the measured axes {', '.join(AXES[k] for k in axes)}")
    return (read, axes), own


def _check_table(table, source):
    time = table.time
    if (time.column is None) == (time.rate is None):
        raise ParameterError(f"{source}: give either time.column or time.rate")
    if (time.tick is None) == (time.unit == "tick"):
        raise ParameterError(f"{source}: time.tick belongs to time.unit tick, and the other way "
                             "round")
    if len(table.delimiter) != 1 and table.delimiter not in DELIMITERS:
        raise ParameterError(f"{source}: delimiter '{table.delimiter}' is not one character, "
                             + " or ".join(f"'{name}'" for name in DELIMITERS))
    if table.delimiter == table.decimal:
        raise ParameterError(f"{source}: '{table.decimal}' cannot be both delimiter and decimal")
