"""Sensor Logger (https://www.tszheichoi.com/sensorlogger): a phone's sensors, exported or pushed.

An export is a folder or archive of CSV, a table per sensor, whose ``time`` is in nanoseconds since
1970; pushed are batches of the same readings in JSON, of which one may overtake another. Without
"Standardise Units & Frames" accelerations of iOS have the other sign, and uncalibrated ones are in
g: Metadata.csv tells, or ``platform``. The accelerometer of either system is without gravity:

    specific force = Accelerometer + Gravity, or TotalAcceleration; of iOS its negative

Facts: https://github.com/tszheichoi/awesome-sensor-logger (UNITS.md, COORDINATES.md, PUSHING.md).
"""

import csv
import json
import math
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from imu_fusion.errors import SampleError
from imu_fusion.samples.logs import FixLog, VelocityLog
from imu_fusion.sources.description import TableParams, TimeParams
from imu_fusion.sources.phone import Phone
from imu_fusion.sources.source import (
    FIX_TOPIC,
    FIXED,
    NO_FIX,
    STANDARD_GRAVITY,
    VELOCITY_TOPIC,
    Block,
    Source,
    WholeSource,
    named,
)
from imu_fusion.sources.table import UNKNOWN_CLIMB_SD
from imu_fusion.sources.table_reader import TableReader

_VECTORS = ("accelerometer", "gravity", "totalacceleration", "accelerometeruncalibrated",
            "gyroscope", "gyroscopeuncalibrated", "magnetometer", "magnetometeruncalibrated")
_LOCATION = ("latitude", "longitude", "altitude", "speed", "bearing", "horizontalaccuracy",
             "verticalaccuracy", "speedaccuracy")
_TIME = TimeParams(column="time", unit="ns")
_BATCHES = 5          # that may be overtaken
_LARGEST = 1 << 24    # bytes of one batch


class SensorLoggerExport(WholeSource):
    """A folder or archive.

    Args:
        platform: android or ios, where Metadata.csv does not tell.
    """

    def __init__(self, strict: bool = True, platform: str | None = None) -> None:
        super().__init__(strict)
        self._platform = platform

    def finish(self) -> list[Block]:
        tables = {PurePosixPath(part).stem.lower(): (part, bytes(data))
                  for part, data in self.parts.items()
                  if PurePosixPath(part).suffix.lower() == ".csv"}
        meta = _metadata(*tables.get("metadata", ("", b"")))
        self.device = meta.get("device name", "")[:80]
        vectors = {name: self._read(*tables[name], ("x", "y", "z")) for name in _VECTORS
                   if name in tables}
        sign, unit = self._convention(meta, vectors)
        phone, blocks = Phone(), []
        forces, rates = _forces(vectors, sign, unit), vectors.get("gyroscope") or vectors.get(
            "gyroscopeuncalibrated")
        if forces is not None:
            blocks += phone.vectors("accelerometer", *forces)
        if rates is not None:
            blocks += phone.vectors("gyroscope", *rates)
        mag = vectors.get("magnetometer") or vectors.get("magnetometeruncalibrated")
        if mag is not None:
            blocks += phone.vectors("magnetometer", mag[0], mag[1] * 1e-6)
        if "location" in tables:
            start = min((v[0][0] for v in vectors.values() if len(v[0])), default=0)
            blocks += self._locations(*self._read(*tables["location"], _LOCATION), start)
        blocks += phone.finish()
        for text in phone.remarks():
            self.remark(text)
        if rates is not None and forces is None:
            self.remark("no acceleration with gravity: neither TotalAcceleration nor "
                        "Accelerometer and Gravity were logged")
        return blocks

    def _convention(self, meta: dict[str, str], vectors: dict[str, Any]) -> tuple[float, float]:
        """(sign, factor of uncalibrated readings) of accelerations."""
        platform = (self._platform or meta.get("platform", "")).lower()
        if meta.get("standardisation", "").lower() == "true" or platform == "android":
            return 1.0, 1.0
        if platform == "ios":
            return -1.0, STANDARD_GRAVITY
        if not set(vectors) & {"accelerometer", "gravity", "totalacceleration",
                               "accelerometeruncalibrated"}:
            return 1.0, 1.0
        folder = str(PurePosixPath(next(iter(self.parts))).parent)
        raise SampleError(f"{folder}: Metadata.csv does not tell the platform, and with it the "
                          "sign of accelerations: put the file of the export back, or give a "
                          "description with 'platform: android' or 'platform: ios'")

    def _read(self, part: str, data: bytes, names: tuple[str, ...]
              ) -> tuple[np.ndarray, np.ndarray]:
        """(stamps (n,), values (n, k)) of a table, in order; NaN for columns that it lacks."""
        reader = TableReader(TableParams(), part)
        rows = reader.whole(data)
        known = {name.lower(): name for name in reader.names or ()}

        def read(rows):
            stamps = reader.stamps(rows, _TIME)
            if min(stamps) < 0 or max(stamps) >= 2**63:
                raise SampleError(f"{part}: column 'time' goes from {min(stamps):.4g} to "
                                  f"{max(stamps):.4g}, which are no nanoseconds since 1970")
            none = np.full(len(stamps), np.nan)
            return np.array(stamps, dtype=np.int64), np.column_stack(
                [reader.column(rows, known[name]) if name in known else none for name in names])

        found = [(np.empty(0, np.int64), np.empty((0, len(names)))), *reader.sound(rows, read)]
        reader.account(self.lost)
        stamp, values = (np.concatenate(parts) for parts in zip(*found))
        order = np.argsort(stamp, kind="stable")
        return stamp[order], values[order]

    def _locations(self, stamp: np.ndarray, values: np.ndarray, start: int) -> list[Block]:
        late = stamp >= start
        if not late.all():
            self.remark(f"{int((~late).sum())} locations of before the recording are left out")
        return locations(stamp[late], values[late])


def locations(stamp: np.ndarray, values: np.ndarray) -> list[Block]:
    """Fixes and velocities of rows (n, 8) of _LOCATION; negative means not valid."""
    lat, lon, height, speed, bearing, sd_h, sd_v, sd_speed = values.T
    valid, known = (sd_h > 0) & (sd_v > 0), sd_speed > 0
    cov = np.zeros((len(stamp), 3, 3))
    for k, sd in enumerate((sd_h, sd_h, sd_v)):
        cov[valid, k, k] = sd[valid] ** 2
    there = np.isfinite(values[:, :3]).all(axis=1)
    fixes = FixLog(stamp, lat, lon, height, cov, np.where(valid, FIXED, NO_FIX))[there]
    course = np.radians(bearing)
    with np.errstate(invalid="ignore", over="ignore"):    # of an infinite one
        vel = np.column_stack([speed * np.sin(course), speed * np.cos(course), 0.0 * speed])
    cov = np.zeros((len(stamp), 3, 3))
    for k in (0, 1):
        cov[known, k, k] = sd_speed[known] ** 2
    cov[known, 2, 2] = UNKNOWN_CLIMB_SD ** 2
    moves = (speed >= 0) & (bearing >= 0)
    return named({FIX_TOPIC: fixes, VELOCITY_TOPIC: VelocityLog(stamp, vel, cov)[moves]})


def _metadata(part: str, data: bytes) -> dict[str, str]:
    lines = data.decode("utf-8-sig", "replace").splitlines()[:2]
    try:
        rows = list(csv.reader(lines))
    except csv.Error:    # a cell that is too long
        rows = []
    return {k.strip(): v for k, v in zip(*rows)} if len(rows) == 2 else {}


def _forces(vectors, sign, unit):
    """(stamp, (n, 3)) of the specific force; None if gravity was not logged."""
    if "totalacceleration" in vectors:
        stamp, values = vectors["totalacceleration"]
        return stamp, sign * values
    if "accelerometer" in vectors and "gravity" in vectors:
        stamp, values = vectors["accelerometer"]
        at, gravity = vectors["gravity"]
        # One reading of the phone makes both; where one is missing there is no force.
        _, mine, theirs = np.intersect1d(stamp, at, return_indices=True)
        return stamp[mine], sign * (values[mine] + gravity[theirs])
    if "accelerometeruncalibrated" in vectors:
        stamp, values = vectors["accelerometeruncalibrated"]
        return stamp, sign * unit * values
    return None


class SensorLoggerPush(Source):
    """Batches that the phone pushes by HTTP, one a :meth:`feed`.

    Args:
        platform: android or ios; without "Standardise Units & Frames" iOS has other signs.
    """

    def __init__(self, strict: bool = False, platform: str | None = None) -> None:
        super().__init__(strict)
        self._platform = platform
        self._session = ""
        self._next: int | None = None
        self._batches: dict[int, list] = {}
        self._begin()
        if platform is None:
            self.remark("signs and units are taken as standardised: 'Standardise Units & Frames' "
                        "has to be on, or a description has to say platform: ios")

    def _begin(self) -> None:
        self._phone = Phone()
        self._halves: dict[int, tuple[str, np.ndarray]] = {}    # accelerometer or gravity alone
        self._total = False

    def feed(self, data: bytes, part: str = "") -> list[Block]:
        if len(data) > _LARGEST:
            self.lose("batches that are too large")
            return []
        try:
            batch = json.loads(data)
            number, session = int(batch["messageId"]), str(batch["sessionId"])
            payload = list(batch["payload"])
            if not 0 <= number < 2**53:
                raise ValueError
        except (ValueError, KeyError, TypeError, RecursionError, OverflowError):
            self.lose("batches that are not Sensor Logger's")
            return []
        self.device = f"Sensor Logger: {batch.get('deviceId', '')}"[:80]
        blocks = []
        if session != self._session:
            blocks = self.finish() if self._session else []
            self._session, self._next = session, None
            self._begin()
        if self._next is not None and number < self._next:
            self.lose("batches that came twice, or after those that had waited for them")
            return blocks
        self._batches[number] = payload
        self._next = number if self._next is None and number == 0 else self._next
        return blocks + self._in_order(len(self._batches) > _BATCHES)

    def finish(self) -> list[Block]:
        blocks = []
        while self._batches:
            blocks += self._in_order(True)
        return blocks + self._phone.finish()

    def _in_order(self, hurry: bool) -> list[Block]:
        """The batches that are complete up to a missing one, or after it if it does not come."""
        blocks: list[Block] = []
        if hurry and self._batches and self._next not in self._batches:
            first = min(self._batches)
            if self._next is not None:
                self.lost["batches that did not come"] += first - self._next
            self._next = first
        while self._next in self._batches:
            assert self._next is not None
            blocks += self._readings(self._batches.pop(self._next))
            self._next += 1
        return blocks

    def _readings(self, payload: list) -> list[Block]:
        rows: dict[str, list[tuple[int, list[float]]]] = {}
        for entry in payload:
            try:
                name = str(entry["name"]).lower()
                if name not in _VECTORS and name != "location":
                    continue
                values = {k.lower(): v for k, v in entry.get("values", entry).items()}
                names = _LOCATION if name == "location" else ("x", "y", "z")
                stamp = int(entry["time"])    # beyond what a float tells apart
                if not 0 <= stamp < 2**63:
                    raise ValueError
                row = [float(values.get(k, math.nan)) for k in names]
            except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
                self.lose("readings that are not Sensor Logger's")
                continue
            rows.setdefault(name, []).append((stamp, row))
        return self._samples({name: (np.array([s for s, _ in found], dtype=np.int64),
                                     np.array([v for _, v in found]))
                              for name, found in rows.items()})

    def _samples(self, vectors: dict[str, Any]) -> list[Block]:
        sign = -1.0 if self._platform == "ios" else 1.0
        self._total |= "totalacceleration" in vectors
        blocks: list[Block] = []
        forces = None
        if "totalacceleration" in vectors:
            forces = vectors["totalacceleration"]
        elif not self._total:
            forces = self._completed(vectors)
        if forces is not None:
            blocks += self._phone.vectors("accelerometer", forces[0], sign * forces[1])
        if "gyroscope" in vectors:
            blocks += self._phone.vectors("gyroscope", *vectors["gyroscope"])
        if "magnetometer" in vectors:
            stamp, values = vectors["magnetometer"]
            blocks += self._phone.vectors("magnetometer", stamp, values * 1e-6)
        if "location" in vectors:
            blocks += locations(*vectors["location"])
        return blocks

    def _completed(self, vectors: dict[str, Any]) -> tuple[np.ndarray, np.ndarray] | None:
        """Forces of the stamps of which both the acceleration and gravity have come."""
        found: dict[int, np.ndarray] = {}
        for name in ("accelerometer", "gravity"):
            for stamp, value in zip(*vectors.get(name, ((), ()))):
                other = self._halves.pop(int(stamp), None)
                if other is not None and other[0] != name:
                    found[int(stamp)] = other[1] + value
                else:
                    self._halves[int(stamp)] = name, value
        while len(self._halves) > 10_000:
            self._halves.pop(next(iter(self._halves)))
        if not found:
            return None
        stamps = sorted(found)
        return np.array(stamps, dtype=np.int64), np.array([found[s] for s in stamps])
