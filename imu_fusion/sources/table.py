"""Tables of numbers in text, in a file or line by line, read as a
:class:`~imu_fusion.sources.description.Description` says."""

import csv
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from decimal import Decimal
from typing import Any, NamedTuple, TypeVar

import numpy as np

from imu_fusion.errors import ParameterError, SampleError
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
from imu_fusion.sources.description import (
    DELIMITERS,
    IDENTITY,
    LATEST,
    Description,
    TableParams,
    TimeParams,
)
from imu_fusion.sources.source import (
    ARRAY_TOPIC,
    BROKEN,
    FIX_TOPIC,
    FIXED,
    IMU_TOPIC,
    MAG_TOPIC,
    NO_FIX,
    REFERENCE_TOPIC,
    VELOCITY_TOPIC,
    Block,
    Lines,
    Source,
    is_number,
    named,
    numbers,
)
from imu_fusion.sources.times import NANOSECONDS, calendar

GPS_EPOCH = 315_964_800    # 1980-01-06 in Unix time
_WEEK = 7 * 86400
_DIGITS = 22           # of nanoseconds, with room
_MANY = 1000           # broken rows, after which the share is looked at before the end
# m/s, where a speed and a course say nothing of the vertical.
UNKNOWN_CLIMB_SD = 100.0


_NO_TEXT = ("not a table of text: zeros, carriage returns that end no line, or quotes without end "
            "are in it")
Result = TypeVar("Result")


class Rows(NamedTuple):
    """Rows of a table: numbers of their lines, and their cells."""

    lines: list[int]
    cells: list[list[str]]

    def part(self, first: int, end: int) -> "Rows":
        """Some of them."""
        return Rows(self.lines[first:end], self.cells[first:end])


class TableReader:
    """Cuts bytes into the rows of a table.

    Args:
        table: how it is written.
        where: what is named in errors.
        wanted: columns that tell the header of a stream that may begin in the middle; lines before
            it are ``skipped``.

    ``names`` are those of the columns once the header has come, ``broken`` counts rows that cannot
    be read.
    """

    def __init__(self, table: TableParams, where: str, wanted: Collection[str] = ()) -> None:
        self.names: list[str] | None = None
        self.skipped = 0
        self.broken = 0                     # rows that cannot be read
        self._count = 0                     # rows
        self._width = 0                     # most cells that a row may have
        self._why = ""                      # the first one cannot be read
        self._last_broken, self._cut = 0, -1    # lines: the latest of them, and one without an end
        self._wanted = set(wanted)
        self._table, self._where = table, where
        self._lines = Lines()
        self._delimiter = DELIMITERS.get(table.delimiter, table.delimiter)

    def feed(self, data: bytes) -> Rows:
        """The rows that are complete now."""
        return self._rows(self._lines.feed(data))

    def finish(self) -> Rows:
        """The last row, if no line end followed."""
        lines = self._lines.finish()
        self._cut = lines[-1][0] if lines else -1
        return self._rows(lines)

    def whole(self, data: bytes) -> Rows:
        """All rows of a table that is at hand as a whole."""
        rows, last = self.feed(data), self.finish()
        return Rows(rows.lines + last.lines, rows.cells + last.cells)

    def sound(self, rows: Rows, read: Callable[[Rows], Result]) -> list[Result]:
        """What ``read`` makes of rows, in parts around those of which it raises a SampleError:
        they are broken, and :meth:`account` tells of them.

        Raises:
            SampleError: so many are that something else is wrong.
        """
        if not rows.lines:
            return []
        try:
            self._check_widths(rows)
            return [read(rows)]
        except SampleError as error:
            if len(rows.lines) == 1:
                self._break(rows.lines[0], str(error) if rows.cells[0] else _NO_TEXT)
                return []
        half = len(rows.lines) // 2
        return [*self.sound(rows.part(0, half), read),
                *self.sound(rows.part(half, len(rows.lines)), read)]

    def account(self, lost: Counter[str], strict: bool = True) -> None:
        """Count the broken rows under words.

        Raises:
            SampleError: ``strict``, and so many are broken that something else is wrong: the first
                reason. A last line without an end was cut off, and tells nothing of the others.
        """
        if strict and self.broken - (self._cut == self._last_broken) > BROKEN * self._count:
            raise SampleError(self._why)
        if self.broken:
            lost[f"lines that cannot be read, the first: {self._why}"] = self.broken

    def _check_widths(self, rows: Rows) -> None:
        """Refuse a row that is wider than the names and the first one: two that ran together."""
        self._width = self._width or max(len(self.names or ()), len(rows.cells[0]))
        if max(map(len, rows.cells)) > self._width:
            line, cells = next((line, cells) for line, cells in zip(*rows)
                               if len(cells) > self._width)
            raise SampleError(f"{self._where}, line {line}: {len(cells)} cells, more than the "
                              f"{self._width} of the others")

    def _break(self, line: int, why: str) -> None:
        self._why = self._why or (f"{self._where}, line {line}: {why}" if why is _NO_TEXT else why)
        self.broken += 1
        self._last_broken = line
        if self.broken > max(_MANY, BROKEN * self._count) and not self._wanted:
            raise SampleError(self._why)

    def place(self, name: str) -> int:
        """The index of a column, or a ParameterError."""
        assert self.names is not None
        if self.names.count(name) != 1:
            raise ParameterError(
                f"{self._where}: {'no' if name not in self.names else 'more than one'} column "
                f"'{name}'; there are: {', '.join(self.names)}")
        return self.names.index(name)

    def texts(self, rows: Rows, name: str, label: str = "") -> list[str]:
        """The cells of a column, which errors call ``label``."""
        place = self.place(name)
        try:
            found = [cells[place] for cells in rows.cells]
        except IndexError:
            line, cells = next((line, cells) for line, cells in zip(rows.lines, rows.cells)
                               if len(cells) <= place)
            raise SampleError(f"{self._where}, line {line}: {len(cells)} cells, column "
                              f"'{label or name}' is missing") from None
        return found

    def column(self, rows: Rows, name: str) -> np.ndarray:
        """(n,) float64, NaN for empty cells."""
        return self.numbers(rows, name, self.pointed(self.texts(rows, name)))

    def numbers(self, rows: Rows, label: str, texts: list[str]) -> np.ndarray:
        """(n,) float64 of cells of those rows, NaN for empty ones."""
        return numbers(self._where, label, rows.lines, texts)

    def pointed(self, texts: list[str]) -> list[str]:
        """Cells with a decimal point."""
        if self._table.decimal == ",":
            return [text.replace(",", ".") for text in texts]
        return texts

    def stamps(self, rows: Rows, time: TimeParams) -> list[int]:
        """Times of the rows in ns since 1970, without what follows from those before."""
        assert time.column is not None
        texts = self.texts(rows, time.column)
        if time.unit != "iso8601":
            texts = self.pointed(texts)
        weeks = self.column(rows, time.week).tolist() if time.week else [0.0] * len(texts)
        return [_stamp(self._where, line, text, week, time)
                for line, text, week in zip(rows.lines, texts, weeks)]

    def _rows(self, lines: list[tuple[int, str]]) -> Rows:
        table, rows = self._table, Rows([], [])
        for line, text in lines:
            if line <= table.skip_lines or (table.comment and text.startswith(table.comment)):
                continue
            cells = self._cells(text)
            no_text = cells is None
            cells = cells or []
            if not any(cells) and not no_text:
                continue
            if no_text and self.names is None:
                self._count += 1
                self._break(line, _NO_TEXT)
                continue
            if self.names is None and not table.header:
                self.names = [str(i + 1) for i in range(len(cells))]
            elif self.names is None and not self._wanted <= set(cells):
                self.skipped += 1
                continue
            elif self.names is None or (table.header and cells == self.names):
                self.names = cells    # again, where a device began anew
                continue
            rows.lines.append(line)
            rows.cells.append(cells)
        self._count += len(rows.lines)
        return rows

    def _cells(self, text: str) -> list[str] | None:
        """Those of a line; None if it is none of a table."""
        if "\0" in text or "\r" in text:
            return None
        if self._delimiter is None:
            return text.split()
        if '"' not in text:
            return [cell.strip() for cell in text.split(self._delimiter)]
        try:
            found = next(csv.reader([text], delimiter=self._delimiter), [])
        except csv.Error:    # of a cell that is too long
            return None
        return [cell.strip() for cell in found]


def _stamp(where: str, line: int, text: str, week: float, time: TimeParams) -> int:
    text = text.strip()
    try:
        if time.unit == "iso8601":
            since = calendar(text)
        else:
            # Seconds since 1970 exceed what a float tells apart in nanoseconds.
            value = Decimal(text if is_number(text) else "")
            value = (value * Decimal(repr(time.tick)) * NANOSECONDS if time.tick is not None
                     else value.scaleb(units.TIME[time.unit]))
            if value.adjusted() >= _DIGITS:    # before digits are made of an exponent
                raise ValueError
            since = int(value.to_integral_value())
        if time.week:
            since += round((GPS_EPOCH + int(week) * _WEEK - time.leap_seconds) * 1000) * 1_000_000
        return since + round(time.start * NANOSECONDS)
    except (ArithmeticError, ValueError):
        raise SampleError(f"{where}, line {line}, column '{time.column}': '{text[:40]}' is not a "
                          "time") from None


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
