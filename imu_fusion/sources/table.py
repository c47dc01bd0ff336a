"""Tables of numbers in text, in a file or line by line, read as a
:class:`~imu_fusion.sources.description.Description` says."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from imu_fusion.errors import SampleError
from imu_fusion.samples.logs import (
    AccelerometerLog,
    FixLog,
    ImuLog,
    Log,
    MagLog,
    PoseLog,
    VelocityLog,
)
from imu_fusion.sources import units
from imu_fusion.sources.description import IDENTITY, LATEST, Description
from imu_fusion.sources.source import (
    ARRAY_TOPIC,
    FIX_TOPIC,
    FIXED,
    IMU_TOPIC,
    MAG_TOPIC,
    NO_FIX,
    REFERENCE_TOPIC,
    VELOCITY_TOPIC,
    Block,
    Source,
    named,
)
from imu_fusion.sources.table_reader import Rows, TableReader
from imu_fusion.sources.times import NANOSECONDS

# m/s, where a speed and a course say nothing of the vertical.
UNKNOWN_CLIMB_SD = 100.0


class _Clock(NamedTuple):
    """How the times of a table stand: number of rows read, how often the counter of the times began
    anew and its last value, ns of the last row, how many times fell back, and line and ns of the
    first one that did."""

    rows: int = 0
    turns: int = 0
    last: int | None = None
    latest: int = 0
    falls: int = 0
    fall: tuple[int, int] = (0, 0)


class TableSource(Source):
    """A table, or lines of one, as a :class:`Description` says."""

    def __init__(self, description: Description, strict: bool = True, where: str = "table") -> None:
        super().__init__(strict)
        self._description = description
        self.topics = description.topics()
        self._clock = _Clock()
        self._reader: TableReader | None = None
        self._where = where

    def feed(self, data: bytes, part: str = "") -> list[Block]:
        if self._reader is None:
            self._where = part or self._where
            time = self._description.table.time
            wanted = () if self.strict else (*self._description.columns(), *filter(
                None, (time.column, time.week)))
            self._reader = TableReader(self._description.table, self._where, wanted)
        return self._blocks(self._reader.feed(data))

    def finish(self) -> list[Block]:
        blocks = []
        if self._reader is not None:
            blocks = self._blocks(self._reader.finish())
            self._reader.account(self.lost, self.strict)
        count, falls = self._clock.rows, self._clock.falls
        if self.strict and count < 2:
            raise SampleError(f"{self._where}: {count} rows of numbers; is skip_lines or header "
                              "right?")
        if falls:
            line, back = self._clock.fall
            self.remark(f"{falls} times fall back, the first in line {line} by "
                        f"{back / NANOSECONDS:.6g} s, and the samples are put in order of their "
                        "times: give time.wrap if that is a counter that began anew")
        return blocks

    def restart(self) -> None:
        """Names of columns stay: a device that sends them once does so at its start."""
        if self._reader is not None:
            self._reader.finish()

    def _blocks(self, rows: Rows) -> list[Block]:
        reader = self._reader
        assert reader is not None
        found = [block for part in reader.sound(rows, self._read) for block in part]
        if not self.strict:
            reader.account(self.lost, strict=False)
            if reader.skipped:
                self.lost["lines ahead of the column names"] = reader.skipped
        return found

    def _read(self, rows: Rows) -> list[Block]:
        reader, description = self._reader, self._description
        assert reader is not None
        columns = {name: reader.column(rows, name) for name in description.columns()}
        stamp, clock = self._stamps(rows)
        found = named(self._logs(stamp, columns))
        self._clock = clock    # not of rows that cannot be read
        return found

    def _logs(self, stamp: np.ndarray, columns: Mapping[str, np.ndarray]) -> dict[str, Log]:
        """What the rows hold, by topic; a sensor whose cells are all empty has no sample."""
        description, sensors = self._description, self._description.sensors
        body = str(description.parameters.get("body_frame", "body"))
        found: dict[str, Log] = {}
        for name, (sensor, axes) in description.array.items():
            acc = np.zeros((len(stamp), 3))
            for column, axis in zip(sensor.columns, axes):
                acc[:, axis] = columns[column] * (units.ACCELERATION[sensor.unit] / sensor.scale)
            found[ARRAY_TOPIC + name] = AccelerometerLog(stamp, acc, frame_id=body)
        gyr, force = self._vectors("gyroscope", columns), self._vectors("accelerometer", columns)
        if gyr is not None or force is not None:
            both: Any = ImuLog(stamp, *(gyr, force))    # type: ignore[arg-type]
            found[IMU_TOPIC] = (replace(both, frame_id=body) if description.array else
                                _present(both))
        mag = self._vectors("magnetometer", columns)
        if mag is not None:
            found[MAG_TOPIC] = _present(MagLog(stamp, mag))
        if "position" in sensors:
            found[FIX_TOPIC] = _fixes(self._where, sensors["position"], stamp, columns)
        if "velocity" in sensors:
            found[VELOCITY_TOPIC] = _velocities(sensors["velocity"], stamp, columns)
        if "reference" in sensors:
            quat = np.column_stack([columns[name] for name in sensors["reference"].columns])
            found[REFERENCE_TOPIC] = _present(PoseLog(stamp, quat, np.zeros((len(stamp), 3))))
        return found

    def _vectors(self, key: str, columns: Mapping[str, np.ndarray]) -> np.ndarray | None:
        """(n, 3) in SI of one of the sensors of three axes, None without it."""
        sensor = self._description.sensors.get(key)
        if sensor is None:
            return None
        known = {"accelerometer": units.ACCELERATION, "gyroscope": units.RATE,
                 "magnetometer": units.FIELD}[key]
        values = np.column_stack([columns[name] for name in sensor.columns])
        values = values * (known[sensor.unit] / sensor.scale)
        if sensor.rotation == IDENTITY:
            return values
        return values @ np.reshape(sensor.rotation, (3, 3)).T

    def _stamps(self, rows: Rows) -> tuple[np.ndarray, "_Clock"]:
        """(n,) int64 ns of rows, and how the clock stands after them."""
        time, reader, clock = self._description.table.time, self._reader, self._clock
        assert reader is not None
        if time.rate is not None:
            before = clock.rows + reader.broken    # which had their times, too
            since = np.round((before + np.arange(len(rows.lines)))
                             * (NANOSECONDS / time.rate)).astype(np.int64)
            stamps = (since + round(time.start * NANOSECONDS)).tolist()
        else:
            stamps = reader.stamps(rows, time)
        turns, last = clock.turns, clock.last
        if time.wrap is not None:
            length = round(time.wrap * (time.tick * NANOSECONDS if time.tick is not None
                                        else 10 ** units.TIME.get(time.unit, 9)))
            for k, stamp in enumerate(stamps):
                turns += last is not None and stamp < last - length // 2
                last = stamp
                stamps[k] = stamp + turns * length
        self._check(rows, stamps)
        found = np.array(stamps, dtype=np.int64)
        back = -np.diff(found, prepend=clock.latest)
        fall = clock.fall
        if (back > 0).any() and not clock.falls:
            k = int(np.argmax(back > 0))
            fall = rows.lines[k], int(back[k])
        return found, _Clock(clock.rows + len(rows.lines), turns, last, stamps[-1],
                             clock.falls + int((back > 0).sum()), fall)

    def _check(self, rows: Rows, stamps: list[int]) -> None:
        name = self._description.table.time.column
        what = f"{self._where}: column '{name}'" if name else f"{self._where}: the rows at the rate"
        if max(stamps) > LATEST * NANOSECONDS:
            raise SampleError(f"{what} ends at {max(stamps) / NANOSECONDS:g} s, which no stamp of "
                              f"ROS can hold (at most {LATEST} s): is time.unit right?")
        if min(stamps) < 0:
            raise SampleError(f"{what} begins at {min(stamps) * 1e-9:g} s; stamps cannot be "
                              "negative: give time.start")


def _present(log: Any) -> Any:
    """Without the rows that hold nothing of this sensor."""
    empty = np.isnan(log.flat()).any(axis=1)
    return log[~empty] if empty.any() else log


def variances(columns: Mapping[str, np.ndarray], names: tuple[str, ...], factor: float
              ) -> np.ndarray:
    """(n, 3, 3) of standard deviations horizontal and vertical (the same, if only one is there);
    zeros, unknown, where they are not above zero."""
    n = len(next(iter(columns.values())))
    cov = np.zeros((n, 3, 3))
    if names:
        horizontal, vertical = columns[names[0]] * factor, columns[names[-1]] * factor
        known = np.nan_to_num(np.minimum(horizontal, vertical), nan=-1.0, posinf=-1.0) > 0
        for k, sd in enumerate((horizontal, horizontal, vertical)):
            cov[known, k, k] = sd[known] ** 2
    return cov


def _fixes(where: str, sensor: Any, stamp: np.ndarray, columns: Mapping[str, np.ndarray]) -> FixLog:
    lat, lon, height = (columns[name] for name in sensor.columns)
    lat, lon = lat * units.ANGLE[sensor.unit], lon * units.ANGLE[sensor.unit]
    height = height * units.LENGTH[sensor.height_unit]
    if (np.abs(lat) > 90).any() or (np.abs(lon) > 360).any():
        bad = int(np.argmax((np.abs(lat) > 90) | (np.abs(lon) > 360)))
        raise SampleError(f"{where}: latitude {lat[bad]:g}, longitude {lon[bad]:g} are not "
                          "degrees: is position.unit right?")
    status = np.full(len(stamp), float(FIXED))
    if sensor.fix is not None:
        status[~(columns[sensor.fix] >= sensor.fix_at_least)] = NO_FIX
    for name in sensor.accuracy:    # as phones say that it is not valid
        status[columns[name] < 0] = NO_FIX
    log = FixLog(stamp, lat, lon, height,
                 variances(columns, sensor.accuracy, units.LENGTH[sensor.height_unit]), status)
    return log[np.isfinite(np.column_stack([lat, lon, height])).all(axis=1)]


def _velocities(sensor: Any, stamp: np.ndarray, columns: Mapping[str, np.ndarray]) -> VelocityLog:
    factor = units.SPEED[sensor.unit]
    cov = variances(columns, sensor.accuracy, factor)
    if sensor.frame == "course":
        speed, course = columns[sensor.columns[0]] * factor, columns[sensor.columns[1]]
        valid = (speed >= 0) & (course >= 0)
        angle = np.radians(course)
        vel = np.column_stack([speed * np.sin(angle), speed * np.cos(angle), 0.0 * speed])
        cov[cov[:, 0, 0] > 0, 2, 2] = UNKNOWN_CLIMB_SD ** 2
    else:
        vel = np.column_stack([columns[name] for name in sensor.columns]) * factor
        if sensor.frame == "ned":
            vel = vel[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
        valid = np.array(np.isfinite(vel).all(axis=1))
    return VelocityLog(stamp, vel, cov)[valid]
