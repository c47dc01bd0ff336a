"""phyphox (https://phyphox.org): a phone's sensors, exported or asked for over its network.

Exports are a folder or an archive of CSV (comma, semicolon or tab; decimal point or comma), or an
Excel file, with a table per sensor and, from version 1.1.9 on, ``meta/time.csv`` with the phone's
clock; without it times count from :data:`~imu_fusion.sources.source.EPOCH`. Live, the phone is
asked for ``/config`` once, then for what is new in each buffer. All sensors of a phone have one
clock, each its own rate: forces are brought to the stamps of the gyroscope.

Nothing is made up: a position without a valid accuracy is no fix, a speed without direction no
velocity. Accuracies are taken as standard deviations of each axis (phones mean 68 % of the circle,
or do not say). Protocol: https://phyphox.org/wiki/index.php/Remote_interface_communication.
"""

import io
import json
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import PurePosixPath
from urllib.parse import quote

import numpy as np

from imu_fusion.errors import SampleError
from imu_fusion.samples.logs import FixLog, MagLog, VelocityLog
from imu_fusion.sources.description import TableParams
from imu_fusion.sources.pairing import Pairing
from imu_fusion.sources.source import (
    BROKEN,
    EPOCH,
    FIX_TOPIC,
    FIXED,
    IMU_TOPIC,
    LARGEST_WHOLE,
    MAG_TOPIC,
    NO_FIX,
    VELOCITY_TOPIC,
    Block,
    Source,
    WholeSource,
    named,
)
from imu_fusion.sources.table import UNKNOWN_CLIMB_SD, Rows, TableReader

NANOSECONDS = 1_000_000_000
_LONGEST = 1e9    # s, of an experiment
_UNIX = (1e8, 9e9)    # s, of a clock that has been set
# A phone's ground speed comes without accuracy; receivers are within some 0.5 m/s.
_SPEED_SD = 0.5
_ACCELERATION, _RATE, _FIELD = ("m/s^2", "m/s²"), ("rad/s",), ("µT", "μT")
_SENSORS = {"accelerometer": _ACCELERATION, "gyroscope": _RATE, "magnetometer": _FIELD}
_LINEAR = re.compile("lin[eé]a|without|ohne|sans", re.IGNORECASE)
# Columns of a location: names, and units (exports of iOS call that of the vertical accuracy a
# degree; it is metres).
_LOCATION = {"latitude": ("°",), "longitude": ("°",), "height|altitude": ("m",),
             "velocity|speed": ("m/s",), "direction": ("°",), "horizontal accuracy": ("m",),
             "vertical accuracy": ("m", "°")}
_TIME_ASKED = 3    # times; versions of phyphox that do not tell count from EPOCH
_XLS = b"\xd0\xcf\x11\xe0"


class Phone:
    """Readings of a phone's sensors, whose stamps are of one clock, to samples."""

    def __init__(self) -> None:
        self.pairing = Pairing()
        self._seen: set[str] = set()

    def vectors(self, kind: str, stamp: np.ndarray, values: np.ndarray) -> list[Block]:
        """Samples that readings (n, 3) in SI make complete; kind: accelerometer, gyroscope or
        magnetometer."""
        self._seen.add(kind)
        if kind == "magnetometer":
            return named({MAG_TOPIC: MagLog(stamp, values)})
        return named({IMU_TOPIC: self.pairing.add(**{
            "forces" if kind == "accelerometer" else "rates": (stamp, values)})})

    def remarks(self) -> list[str]:
        """What to say of the readings at the end."""
        there = [kind for kind in ("accelerometer", "gyroscope") if kind in self._seen]
        alone = [f"{IMU_TOPIC} needs accelerometer and gyroscope; there is the {there[0]} alone"
                 ] if len(there) == 1 else []
        return alone + self.pairing.remarks()

    def finish(self) -> list[Block]:
        """What waited for more."""
        return named({IMU_TOPIC: self.pairing.finish()})


def locations(stamp: np.ndarray, values: np.ndarray) -> list[Block]:
    """Fixes and velocities of a phone: (n, 7) latitude and longitude in degrees, height m, speed
    m/s, direction deg, accuracy horizontal and vertical m."""
    lat, lon, height, speed, direction, sd_h, sd_v = values.T
    valid = (sd_h > 0) & (sd_v > 0) & np.isfinite(sd_h) & np.isfinite(sd_v)
    cov = np.zeros((len(stamp), 3, 3))
    for k, sd in enumerate((sd_h, sd_h, sd_v)):
        cov[valid, k, k] = sd[valid] ** 2
    there = np.isfinite(values[:, :3]).all(axis=1)
    fixes = FixLog(stamp, lat, lon, height, cov, np.where(valid, FIXED, NO_FIX))[there]
    course = np.radians(direction)    # clockwise from north
    moves = (speed >= 0) & (direction >= 0)
    with np.errstate(invalid="ignore", over="ignore"):    # of an infinite one
        vel = np.column_stack([speed * np.sin(course), speed * np.cos(course), 0.0 * speed])
    cov = np.tile(np.diag([_SPEED_SD, _SPEED_SD, UNKNOWN_CLIMB_SD]) ** 2, (len(stamp), 1, 1))
    return named({FIX_TOPIC: fixes, VELOCITY_TOPIC: VelocityLog(stamp, vel, cov)[moves]})


class PhyphoxExport(WholeSource):
    """A folder, archive or Excel file."""

    def finish(self) -> list[Block]:
        sheets = dict(_sheets(self.parts))
        for name in [name for name, sheet in sheets.items() if not sheet.rows.lines]:
            sheet = sheets.pop(name)
            if _kind(name, sheet) in ("accelerometer", "gyroscope"):
                raise SampleError(f"{sheet.where}: no rows of numbers")
            self.remark(f"{sheet.where}: no rows of numbers")    # of a sensor that gave none
        clock = _clock(sheets.pop("time", None), self.lost)
        if clock is None:
            self.remark("the export tells no date (meta/time.csv): stamps begin at an arbitrary "
                        "instant")
        sheets.pop("device", None)
        phone, blocks = Phone(), []
        for name, sheet in sheets.items():
            kind = _kind(name, sheet)
            if kind == "location":
                time, values = sheet.read(_LOCATION, self.lost)
                blocks += locations(_stamps(time, clock), values)
            elif kind:
                time, values = sheet.read({axis: _SENSORS[kind] for axis in "xyz"}, self.lost,
                                          rising=kind == "accelerometer")
                values = values * (1e-6 if kind == "magnetometer" else 1.0)
                blocks += phone.vectors(kind, _stamps(time, clock), values)
        blocks += phone.finish()
        if phone.pairing.left_out and not any(block.topic == IMU_TOPIC for block in blocks):
            names = " and ".join(n for n in sheets if _kind(n, sheets[n]) in (
                "accelerometer", "gyroscope"))
            raise SampleError(f"{names} have no time in common")
        for text in phone.remarks():
            self.remark(text)
        return blocks


class _Sheet:
    """One table of an export: its name in errors, and its columns."""

    def __init__(self, where: str, reader: TableReader, rows: Rows) -> None:
        self.where, self.rows, self._reader = where, rows, reader
        self.names = reader.names or []

    def read(self, wanted: Mapping[str, tuple[str, ...]], lost: Counter[str],
             rising: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """(times (n,) in s, values (n, k)) of the columns 'name (unit)'; rows that cannot be read
        are counted in ``lost``, and so are those that no later one follows, if times are to be
        ``rising``."""
        names = [self._name("time|zeit|temps", ("s",)) if "time" in self.names[0].lower()
                 else self.names[0], *(self._name(*item) for item in wanted.items())]
        found = self._sound(names, "latitude" in wanted)
        self._reader.account(lost)
        line, time, values = found[:, 0], found[:, 1], found[:, 2:]
        if not rising:
            return time, values
        followed = np.r_[np.diff(time) > 0, np.full(min(len(time), 1), len(time) > 1)]
        alone = np.flatnonzero(~followed)
        if len(alone) > BROKEN * len(time):
            raise SampleError(f"{self.where}, line {line[alone[0]]:.0f}: no later time follows")
        if len(alone):
            lost[f"readings of {self.where} that no later time follows"] += len(alone)
        return time[followed], values[followed]

    def events(self, names: list[str], lost: Counter[str]) -> list[tuple[str, float, float]]:
        """(event, two numbers) of each row of the times of measuring that can be read; others are
        counted in ``lost``."""
        parts = self._reader.sound(self.rows, lambda rows: list(zip(
            self._reader.texts(rows, names[0]), *(self._column(rows, n) for n in names[1:]))))
        self._reader.account(lost, strict=False)
        return [row for part in parts for row in part]

    def _sound(self, names: list[str], degrees: bool) -> np.ndarray:
        """(m, 1 + k) of rows that can be read: line, and numbers of columns of which the first is
        the time."""
        def read(rows):
            found = np.column_stack([rows.lines, *(self._column(rows, name) for name in names)])
            self._check(rows, found, ~(np.abs(found[:, 1]) < _LONGEST), lambda row: (
                f", column 'Time': {row[1]:g} s is not a time since the start of the experiment"))
            if degrees:
                self._check(rows, found, (np.abs(found[:, 2]) > 90) | (np.abs(found[:, 3]) > 360),
                            lambda row: f": latitude {row[2]:g}, longitude {row[3]:g} are not "
                                        "degrees")
            return found

        return np.concatenate([np.empty((0, 1 + len(names))),
                               *self._reader.sound(self.rows, read)])

    def _check(self, rows: Rows, found: np.ndarray, bad: np.ndarray,
               words: Callable[[np.ndarray], str]) -> None:
        if bad.any():
            k = int(np.argmax(bad))
            raise SampleError(f"{self.where}, line {rows.lines[k]}{words(found[k])}")

    def _column(self, rows: Rows, name: str) -> np.ndarray:
        """(n,) numbers of a column, which errors call by its name without the unit."""
        texts = self._reader.pointed(self._reader.texts(rows, name, _bare(name)))
        return self._reader.numbers(rows, _bare(name), texts)

    def _name(self, wanted: str, permitted: tuple[str, ...]) -> str:
        found = None
        # Newer exports write 'Acceleration x (m/s^2)'.
        prefix = "(?:.* )?" if len(wanted) == 1 else ""
        for name in self.names:
            match = re.fullmatch(rf"{prefix}(?:{wanted})\s*\((.*)\)", name, re.IGNORECASE)
            if match and match[1] in permitted:
                return name
            found = match[1] if match else found
        label = wanted.partition("|")[0].title()
        if found is not None:
            raise SampleError(f"{self.where}: column '{label}' is in '{found}', expected "
                              + " or ".join(permitted))
        raise SampleError(f"{self.where}: no column '{label}'; there are: "
                          + ", ".join(self.names))


def _bare(name: str) -> str:
    return re.sub(r"\s*\([^()]*\)$", "", name)


def _sheets(parts):
    """(name without folder and suffix, _Sheet) of the tables of an export."""
    for part, data in parts.items():
        data, path = bytes(data), PurePosixPath(part)
        if data.startswith((_XLS, b"PK")):
            yield from _excel(part, data)
        elif path.suffix.lower() == ".csv":
            reader = TableReader(_dialect(data), part)
            rows = reader.whole(data)
            yield path.stem if path.parent.name == "meta" else str(path), _Sheet(part, reader, rows)


def _dialect(data: bytes) -> TableParams:
    """phyphox writes comma, semicolon or tab; a decimal comma stands between digits."""
    first, _, rest = data.partition(b"\n")
    delimiter = next((d for d in ("\t", ";") if d in first.decode("utf-8", "replace")), ",")
    comma = delimiter != "," and re.search(rb"\d,\d", rest[:4096]) is not None
    return TableParams(delimiter={"\t": "tab"}.get(delimiter, delimiter),
                       decimal="," if comma else ".")


def _excel(part: str, data: bytes):
    try:
        from python_calamine import CalamineWorkbook
    except ImportError:
        raise SampleError(f"{part}: reading Excel files needs python-calamine: pip install "
                          "'imu_fusion[devices]', or export CSV instead") from None
    _check_unpacked(part, data)
    try:
        book = CalamineWorkbook.from_filelike(io.BytesIO(data))
        tables = {name: book.get_sheet_by_name(name).to_python() for name in book.sheet_names}
    except Exception as error:    # of the library: it has no common root
        raise SampleError(f"{part}: no Excel file that can be read ({error})") from None
    for name, rows in tables.items():
        text = "\n".join("\t".join(str(cell).replace("\t", " ").replace("\n", " ") for cell in row)
                         for row in rows)
        reader = TableReader(TableParams(delimiter="tab"), f"{part}, sheet {name}")
        found = reader.whole(text.encode())
        if reader.names:
            meta = {"Metadata Time": "time", "Metadata Device": "device"}.get(name, name)
            yield meta, _Sheet(f"{part}, sheet {name} (Excel files of phyphox are known, others "
                               "have to be saved as CSV)", reader, found)


def _check_unpacked(part: str, data: bytes) -> None:
    """An .xlsx is an archive, which its reader unpacks at once."""
    if data.startswith(b"PK"):
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                size = sum(entry.file_size for entry in archive.infolist())
        except (zipfile.BadZipFile, ValueError) as error:
            raise SampleError(f"{part}: no Excel file that can be read ({error})") from None
        if size > min(LARGEST_WHOLE, 1000 * len(data)):
            raise SampleError(f"{part}: would unpack to {size >> 20} MB")


def _kind(name: str, sheet: _Sheet) -> str:
    """What a table holds: a key of _SENSORS, location, or '' for nothing that is used."""
    text = " ".join((PurePosixPath(name).stem, *sheet.names))
    if re.search("latitude", text, re.IGNORECASE):
        return "location"
    if _LINEAR.search(text):
        return ""
    # Names are in the language of the phone, or of whoever made the experiment; units are not.
    written = {match[1] for name in sheet.names if (match := re.search(r"\(([^()]*)\)$", name))}
    for kind, stem in (("accelerometer", "acc|beschleu"), ("gyroscope", "gyr"),
                       ("magnetometer", "mag")):
        if written & set(_SENSORS[kind]) or re.search(stem, text, re.IGNORECASE):
            return kind
    return ""


def _clock(sheet: _Sheet | None, lost: Counter[str]) -> list[tuple[float, int]] | None:
    """(experiment time s, Unix time of its zero in ns) from which each stretch of measuring
    counts: the phone's clock goes on while it pauses."""
    if sheet is None or "event" not in sheet.names:
        return None
    names = [next((n for n in sheet.names if n.startswith(wanted)), "")
             for wanted in ("event", "experiment time", "system time")]
    if not all(names):
        return None
    starts = [(float(t), round(u * 1000) * 1_000_000 - round(t * NANOSECONDS))
              for event, t, u in sheet.events(names, lost)
              if event == "START" and abs(t) < _LONGEST and _UNIX[0] < u < _UNIX[1]]
    return starts or None


def _stamps(time: np.ndarray, clock: list[tuple[float, int]] | None) -> np.ndarray:
    zeros = clock or [(0.0, EPOCH)]
    stretch = np.clip(np.searchsorted([t for t, _ in zeros], time, "right") - 1, 0, None)
    return np.array([zero for _, zero in zeros])[stretch] + np.round(
        time * NANOSECONDS).astype(np.int64)


class PhyphoxLive(Source):
    """The remote interface of a running experiment: feed it what was asked for, under the path
    that :meth:`request` gave."""

    def __init__(self, strict: bool = False) -> None:
        super().__init__(strict)
        self.restart()

    def restart(self) -> None:
        """Ask anew which buffers there are."""
        self._phone = Phone()
        self._buffers: dict[str, dict[str, str]] = {}    # sensor -> {output: buffer}
        self._last: dict[str, float] = {}                # sensor -> time of its last reading
        self._session = ""
        self._measures = False
        self._asked_time = 0     # how often since it was started
        self._zero: int | None = None

    def request(self) -> str | None:
        if not self._buffers:
            return "/config"
        if self._zero is None and self._measures and self._asked_time < _TIME_ASKED:
            return "/time"
        parts = []
        for sensor, outputs in self._buffers.items():
            time = outputs["t"]
            last = self._last.get(sensor)
            after = "full" if last is None else repr(last)
            parts.append(f"{quote(time)}={after}")
            parts += [f"{quote(name)}={after}" + (f"%7C{quote(time)}" if last is not None else "")
                      for output, name in outputs.items() if output != "t"]
        return "/get?" + "&".join(parts)

    def feed(self, data: bytes, part: str = "") -> list[Block]:
        self._asked_time += part.startswith("/time")
        try:
            answer = json.loads(data)
            if part.startswith("/config"):
                self._learn(answer)
            elif part.startswith("/time"):
                self._set_clock(answer)
            elif part.startswith("/get"):
                return self._readings(answer)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError,
                OverflowError) as error:
            if isinstance(error, SampleError):
                raise
            if part.startswith("/config"):
                raise SampleError("the answer to /config is not phyphox's; is it the phone that "
                                  "has this address?") from None
            self.lose("answers that are not phyphox's", part[:20])
        return []

    def finish(self) -> list[Block]:
        return self._phone.finish()

    def _learn(self, config):
        known = {"accelerometer": "xyzt", "gyroscope": "xyzt", "magnetic_field": "xyzt"}
        for entry in config["inputs"]:
            outputs = {output: str(name) for pair in entry["outputs"]
                       for output, name in pair.items() if output != "abs"}
            source = str(entry["source"])
            if source in known and set(known[source]) <= outputs.keys():
                self._buffers[source] = {axis: outputs[axis] for axis in known[source]}
            elif source == "location" and {"lat", "lon", "t"} <= outputs.keys():
                self._buffers[source] = outputs
        if not self._buffers:
            raise SampleError("the running experiment of phyphox has none of accelerometer, "
                              "gyroscope, magnetometer and location with times: open one that has, "
                              "such as config/imu_fusion.phyphox")
        self.device = f"phyphox: {config.get('title', '')}"[:80]

    def _set_clock(self, events):
        starts = [e for e in events if e.get("event") == "START"]
        if starts:
            last = starts[-1]
            since, unix = float(last["experimentTime"]), float(last["systemTime"])
            if not (abs(since) < _LONGEST and _UNIX[0] < unix < _UNIX[1]):
                raise ValueError
            self._zero = round(unix * 1000) * 1_000_000 - round(since * NANOSECONDS)

    def _readings(self, answer):
        status = answer.get("status", {})
        session = str(status.get("session", ""))
        if self._session and session != self._session:
            self._begin_anew("sessions of phyphox that were left: the experiment began anew")
        self._session = session
        measures = bool(status.get("measuring"))
        if measures and not self._measures:
            self._zero, self._asked_time = None, 0    # started, or gone on with after a pause
        self._measures = measures
        if self._zero is None and (not measures or self._asked_time < _TIME_ASKED):
            return []    # the readings are asked for again when their zero is known
        blocks: list[Block] = []
        arrays = {name: np.array([np.nan if not isinstance(v, (int, float)) else v
                                  for v in entry["buffer"]], dtype=np.float64)
                  for name, entry in answer["buffer"].items()}
        for sensor, outputs in self._buffers.items():
            time = arrays.get(outputs["t"])
            if time is None or not len(time):
                continue
            last = self._last.get(sensor)
            if last is not None and time[-1] < last:
                self._begin_anew("stretches of phyphox that were left: it was cleared")
                last = None
            columns = {o: arrays.get(name, np.empty(0)) for o, name in outputs.items()}
            # A reading may have reached some of its buffers when the phone answers.
            n = min(len(c) for o, c in columns.items() if len(c) or o in "xyzt")
            new = np.flatnonzero((time[:n] >= 0) & (time[:n] < _LONGEST) & (time[:n] > (
                -np.inf if last is None else last)))
            if len(new):
                self._last[sensor] = float(time[new[-1]])
                blocks += self._samples(sensor, time[new], {
                    o: c[new] for o, c in columns.items() if len(c) >= n})
        return blocks

    def _samples(self, sensor, time, columns):
        stamp = (EPOCH if self._zero is None else self._zero) + np.round(
            time * NANOSECONDS).astype(np.int64)
        if sensor == "location":
            none = np.full(len(time), np.nan)
            height = "zwgs84" if "zwgs84" in columns else "z"
            return locations(stamp, np.column_stack([columns.get(name, none) for name in (
                "lat", "lon", height, "v", "dir", "accuracy", "zAccuracy")]))
        values = np.column_stack([columns[axis] for axis in "xyz"])
        if sensor == "magnetic_field":
            return self._phone.vectors("magnetometer", stamp, values * 1e-6)
        return self._phone.vectors(sensor, stamp, values)

    def _begin_anew(self, why):
        self.lost[why] += 1
        self._phone, self._last, self._zero, self._asked_time = Phone(), {}, None, 0
