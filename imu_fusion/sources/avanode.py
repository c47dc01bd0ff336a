"""AvaNode, a logger for avalanches (https://github.com/AvaFrame/OpenNHM): text files.

That of its IMU holds counts, with the counts per unit in its header, and microseconds since it was
switched on, here from :data:`~imu_fusion.sources.source.EPOCH`; that of its GNSS receiver UTC.
A receiver's row without height is no fix; accuracies are not logged and stay unknown.
"""

import math
import re
from datetime import UTC, datetime

import numpy as np

from imu_fusion.errors import SampleError
from imu_fusion.samples.logs import FixLog, ImuLog, MagLog, VelocityLog
from imu_fusion.sources.description import TableParams
from imu_fusion.sources.source import (
    EPOCH,
    FIX_TOPIC,
    FIXED,
    IMU_TOPIC,
    MAG_TOPIC,
    NO_FIX,
    STANDARD_GRAVITY,
    VELOCITY_TOPIC,
    Block,
    Source,
    named,
    number,
    numbers,
)
from imu_fusion.sources.table_reader import Rows, TableReader

_WRAP = 2 ** 32    # of the clock of microseconds
_FIX_3D = (3, 4)   # UBX fixType: 3-D, 3-D with dead reckoning
_COLUMNS = ("time", "acc x", "acc y", "acc z", "gyro x", "gyro y", "gyro z",
            "mag x", "mag y", "mag z")


class AvanodeImu(Source):
    """The log of the IMU.

    Its magnetometer is slower than its other sensors: a reading that only repeats the one before
    is left out. Axes are those of the log, which does not say whether the magnetometer's are those
    of the accelerometer.
    """

    def __init__(self, strict: bool = True) -> None:
        super().__init__(strict)
        self._reader: TableReader | None = None
        self._factors: list[float] | None = None
        self._last: int | None = None
        self._turns = 0
        self._mag: np.ndarray | None = None
        self._count = 0
        self._part = ""

    def feed(self, data: bytes, part: str = "") -> list[Block]:
        if self._reader is None:
            self._part = part
            self._reader = TableReader(TableParams(header=False), part)
        return self._read(self._reader.feed(data))

    def finish(self) -> list[Block]:
        blocks = []
        if self._reader is not None:
            blocks = self._read(self._reader.finish())
            self._reader.account(self.lost)
        if self._factors is None:
            raise SampleError(f"{self._part}: no line '#date,factor acc,factor gyro,factor mag,"
                              "sync,id#'")
        if not self._count:
            raise SampleError(f"{self._part}: no samples")
        return blocks

    def _read(self, rows: Rows) -> list[Block]:
        assert self._reader is not None
        samples = Rows([], [])
        for line, cells in zip(*rows):
            if cells and cells[0].startswith("#"):
                self._header(line, cells)
            elif self._factors is None:
                raise SampleError(f"{self._part}, line {line}: no line '#date,factor acc,factor "
                                  "gyro,factor mag,sync,id#' before it")
            else:
                samples.lines.append(line)
                samples.cells.append(cells)
        return [block for part in self._reader.sound(samples, self._samples) for block in part]

    def _samples(self, rows: Rows) -> list[Block]:
        assert self._factors is not None
        values = np.column_stack([self._column(rows, k) for k in range(len(_COLUMNS))])
        bad = ~((values[:, 0] >= 0) & (values[:, 0] < _WRAP))
        if bad.any():
            raise SampleError(f"{self._part}, line {rows.lines[int(np.argmax(bad))]}, column "
                              "'time': not a number of its clock")
        self._count += len(values)
        stamp = self._stamps(values[:, 0].astype(np.int64))
        acc_factor, gyr_factor, mag_factor = self._factors
        imu = ImuLog(stamp, np.radians(values[:, 4:7] / gyr_factor),
                     values[:, 1:4] / acc_factor * STANDARD_GRAVITY)
        mag = values[:, 7:10] / mag_factor * 1e-6
        before = np.vstack([[np.nan] * 3 if self._mag is None else self._mag, mag[:-1]])
        self._mag = mag[-1]
        return named({IMU_TOPIC: imu, MAG_TOPIC: MagLog(stamp, mag)[(mag != before).any(axis=1)]})

    def _column(self, rows: Rows, place: int) -> np.ndarray:
        name = _COLUMNS[place]
        for line, cells in zip(*rows):
            if len(cells) <= place:
                raise SampleError(f"{self._part}, line {line}: {len(cells)} cells, column '{name}' "
                                  "is missing")
        return numbers(self._part, name, rows.lines, [cells[place] for cells in rows.cells])

    def _stamps(self, time: np.ndarray) -> np.ndarray:
        before = np.r_[time[0] if self._last is None else self._last, time[:-1]]
        turns = self._turns + np.cumsum(time - before < -_WRAP // 2)
        self._turns, self._last = int(turns[-1]), int(time[-1])
        return EPOCH + 1000 * (time + _WRAP * turns)

    def _header(self, line: int, cells: list[str]) -> None:
        """Counts per g, deg/s and uT: '#date,acc,gyro,mag,sync,id#'."""
        if self._factors is not None or len(cells) != 6 or re.search("[a-z]", cells[1]):
            return
        factors = [number(self._part, f"factor {name}", line, cells[k])
                   for k, name in enumerate(("acc", "gyro", "mag"), 1)]
        if not min(factors) > 0:
            raise SampleError(f"{self._part}, line {line}: factors {factors} must be above zero")
        self._factors = factors


class AvanodeGnss(Source):
    """The log of the GNSS receiver; heights are taken as ellipsoidal.

    Stamps are UTC, its fraction from the receiver's time of week (they differ by whole seconds).
    Rows without a 3-D fix have no position and no velocity: NavSatStatus says so.
    """

    _WANTED = (("iTow", "ms", 1.0), ("fixType", "0-5", 1.0), ("longitude", "deg", 1.0),
               ("latitude", "deg", 1.0), ("height", "mm", 1e-3), ("velN", "mm/s", 1e-3),
               ("velE", "mm/s", 1e-3), ("velD", "mm/s", 1e-3))

    def __init__(self, strict: bool = True) -> None:
        super().__init__(strict)
        self._reader: TableReader | None = None
        self._part = ""

    def feed(self, data: bytes, part: str = "") -> list[Block]:
        if self._reader is None:
            self._part = part
            self._reader = TableReader(TableParams(), part)
        return self._read(self._reader.feed(data))

    def finish(self) -> list[Block]:
        if self._reader is None:
            return []
        blocks = self._read(self._reader.finish())
        self._reader.account(self.lost)
        return blocks

    def _read(self, rows: Rows) -> list[Block]:
        assert self._reader is not None
        return [block for part in self._reader.sound(rows, self._solutions) for block in part]

    def _solutions(self, rows: Rows) -> list[Block]:
        assert self._reader is not None
        tow, fix_type, lon, lat, height, north, east, down = (
            factor * self._reader.numbers(rows, name, self._reader.texts(
                rows, self._name(name, unit), name)) for name, unit, factor in self._WANTED)
        utc = self._reader.texts(rows, self._name("utc", "year:month:day:hour:minute:second"))
        fixed = np.isin(fix_type, _FIX_3D)
        stamps = [self._stamp(line, text, ms, has) for line, text, ms, has in zip(
            rows.lines, utc, tow, fixed)]
        known = np.array([stamp is not None for stamp in stamps])
        stamp = np.array([s for s in stamps if s is not None], dtype=np.int64)
        fixed = fixed[known]
        vel = np.column_stack([east, north, -down])[known]
        fixes = FixLog(stamp, lat[known], lon[known], height[known],
                       np.zeros((len(stamp), 3, 3)), np.where(fixed, FIXED, NO_FIX))
        velocities = VelocityLog(stamp, vel, np.zeros((len(stamp), 3, 3)))
        return named({FIX_TOPIC: fixes, VELOCITY_TOPIC: velocities[fixed]})

    def _stamp(self, line: int, text: str, tow: float, fixed: bool) -> int | None:
        try:
            year, month, day, hour, minute, second = map(int, text.split(":"))
            date = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
            stamp = int(date.timestamp()) * 10**9 + round(math.fmod(tow, 1000)) * 1_000_000
            if 0 <= stamp < 2**63:
                return stamp
            raise ValueError
        except (ValueError, TypeError, OverflowError):
            if not fixed:
                return None    # the receiver does not know the date yet
            raise SampleError(f"{self._part}, line {line}, column 'utc': '{text}' is not a date, "
                              f"or iTow {tow:g} not a time") from None

    def _name(self, wanted: str, unit: str) -> str:
        assert self._reader is not None
        names = self._reader.names or []
        found = None
        for name in names:
            match = re.fullmatch(wanted + r"\s*\[(.*)\]", name.lstrip("#"), re.IGNORECASE)
            if match and match[1] == unit:
                return name
            found = match[1] if match else found
        if found is not None:
            raise SampleError(f"{self._part}: column '{wanted}' is in '{found}', expected {unit}")
        raise SampleError(f"{self._part}: no column '{wanted}'; there are: {', '.join(names)}")
