"""Recordings of accelerometer arrays from CSV: a description names columns, units and places.

    time: {column: t, unit: ms}
    sample_rate: 1000.0
    accelerometers:
      top: {columns: [a1x, a1y, a1z], unit: g, position: [0, 0, 0.83], axes: [1, 0, 0, 0, -1, ...]}
    gyroscope: {columns: [gx, gy, gz], unit: deg/s}       # optional

Everything else of an accelerometer or the gyroscope is a parameter of the estimator.
"""

import csv
from pathlib import Path

import numpy as np
import yaml

from imu_fusion.errors import SampleError
from imu_fusion.messages.acceleration_field_stream import GYROSCOPE_TOPIC, NODE, FieldConfiguration
from imu_fusion.messages.convert import imu_message
from imu_fusion.messages.layouts import IMU

_TIMES = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
_ACCELERATIONS = {"m/s^2": 1.0, "g": 9.80665, "mg": 9.80665e-3}
_RATES = {"rad/s": 1.0, "deg/s": np.pi / 180}


def convert_table(source, description, writer):
    """Write the accelerometers (and gyroscope) of a CSV file as topics.

    Args:
        source: CSV file with a header line; empty cells are missing readings.
        description: YAML file as above.
        writer: an open :class:`imu_fusion.messages.bag.BagWriter`.

    Returns:
        dict of ROS parameters of the acceleration field estimator, keyed by node name: what a
        parameter file holds.

    Raises:
        SampleError: files that cannot be read, columns or units that there are not, time that
            does not go forwards.
        ParameterError: unknown or wrong parameters of a sensor.
    """
    source, description = Path(source), Path(description)
    wanted = _load(description)
    table = _read(source)
    stamp = _stamps(wanted, table, source, description)
    topics, parameters = [], {k: v for k, v in wanted.items()
                              if k not in ("time", "accelerometers", "gyroscope")}
    parameters["accelerometers"] = {"names": list(wanted["accelerometers"])}
    for name, sensor in wanted["accelerometers"].items():
        values, rest = _columns(sensor, 3, _ACCELERATIONS, table, f"accelerometers.{name}",
                                source, description)
        parameters["accelerometers"][name] = rest
        topics.append((f"/accelerometers/{name}", name, None, values))
    if "gyroscope" in wanted:
        values, rest = _columns(wanted["gyroscope"], 3, _RATES, table, "gyroscope", source,
                                description)
        parameters["gyroscope"] = rest or {"range": 1e9}
        topics.append(("/" + GYROSCOPE_TOPIC, "gyroscope", values, None))
    FieldConfiguration.from_mapping(parameters, str(description))
    for n, t in enumerate(stamp.tolist()):
        for topic, frame, gyr, acc in topics:
            sample = (gyr if acc is None else acc)[n]
            if np.isfinite(sample).all():
                writer.write(topic, IMU.msgtype, imu_message(
                    t, frame, gyr if gyr is None else sample, acc if acc is None else sample), t)
    return {NODE: {"ros__parameters": parameters}}


def _load(path):
    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise SampleError(f"{path}: cannot be read as YAML: {error}") from None
    if not isinstance(content, dict) or not isinstance(content.get("accelerometers"), dict) \
            or not isinstance(content.get("time"), dict):
        raise SampleError(f"{path}: needs 'time' (column, unit) and 'accelerometers' (by name: "
                          "columns, unit, position, axes)")
    return content


def _read(path):
    try:
        with open(path, newline="") as stream:
            rows = list(csv.reader(stream))
    except (OSError, UnicodeDecodeError) as error:
        raise SampleError(f"{path}: cannot be read: {error}") from None
    if len(rows) < 2:
        raise SampleError(f"{path}: no rows below a header line")
    header = [name.strip() for name in rows[0]]
    table = {}
    for k, name in enumerate(header):
        cells = [row[k].strip() if k < len(row) else "" for row in rows[1:] if row]
        table[name] = cells
    return table


def _column(name, table, source, description):
    if name not in table:
        raise SampleError(f"{description}: column '{name}' is not in {source}; it has "
                          + ", ".join(table))
    values = np.empty(len(table[name]))
    for n, cell in enumerate(table[name]):
        try:
            values[n] = float(cell) if cell else np.nan
        except ValueError:
            raise SampleError(f"{source}: row {n + 2}, column '{name}': '{cell}' is not a "
                              "number") from None
    return values


def _unit(entry, units, what, description):
    unit = entry.get("unit")
    if unit not in units:
        raise SampleError(f"{description}: {what}: unit '{unit}'; there are {', '.join(units)}")
    return units[unit]


def _columns(sensor, count, units, table, what, source, description):
    """(values (n, count), the sensor's other entries)."""
    names = sensor.get("columns", ())
    if len(names) != count:
        raise SampleError(f"{description}: {what}: columns {list(names)}; need {count}, for x, y, "
                          "z (repeat one for an axis that is not measured, see measured_axes)")
    factor = _unit(sensor, units, what, description)
    values = factor * np.column_stack([_column(n, table, source, description) for n in names])
    return values, {k: v for k, v in sensor.items() if k not in ("columns", "unit")}


def _stamps(wanted, table, source, description):
    entry = wanted["time"]
    factor = _unit(entry, _TIMES, "time", description)
    values = _column(str(entry.get("column")), table, source, description)
    stamp = np.round(values * factor).astype(np.int64) if np.isfinite(values).all() else None
    if stamp is None or np.any(np.diff(stamp) <= 0):
        raise SampleError(f"{source}: column '{entry['column']}' does not go forwards from row to "
                          "row; sort the rows and remove repeats")
    return stamp
