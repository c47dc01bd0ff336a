"""phyphox (https://phyphox.org): exports of a phone's sensors.

They are a folder or an archive of CSV (comma, semicolon or tab; decimal point or comma), or an
Excel file, with a table per sensor and, from version 1.1.9 on, ``meta/time.csv`` with the phone's
clock; without it times count from :data:`~imu_fusion.sources.source.EPOCH`.
"""

import io
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import PurePosixPath

import numpy as np

from imu_fusion.errors import SampleError
from imu_fusion.sources.description import TableParams
from imu_fusion.sources.phone import LONGEST, UNIX, Phone, locations
from imu_fusion.sources.source import (
    BROKEN,
    EPOCH,
    IMU_TOPIC,
    LARGEST_WHOLE,
    Block,
    WholeSource,
)
from imu_fusion.sources.table_reader import Rows, TableReader
from imu_fusion.sources.times import NANOSECONDS

_ACCELERATION, _RATE, _FIELD = ("m/s^2", "m/s²"), ("rad/s",), ("µT", "μT")
_SENSORS = {"accelerometer": _ACCELERATION, "gyroscope": _RATE, "magnetometer": _FIELD}
_LINEAR = re.compile("lin[eé]a|without|ohne|sans", re.IGNORECASE)
# Columns of a location: names, and units (exports of iOS call that of the vertical accuracy a
# degree; it is metres).
_LOCATION = {"latitude": ("°",), "longitude": ("°",), "height|altitude": ("m",),
             "velocity|speed": ("m/s",), "direction": ("°",), "horizontal accuracy": ("m",),
             "vertical accuracy": ("m", "°")}
_XLS = b"\xd0\xcf\x11\xe0"


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
            self._check(rows, found, ~(np.abs(found[:, 1]) < LONGEST), lambda row: (
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
              if event == "START" and abs(t) < LONGEST and UNIX[0] < u < UNIX[1]]
    return starts or None


def _stamps(time: np.ndarray, clock: list[tuple[float, int]] | None) -> np.ndarray:
    zeros = clock or [(0.0, EPOCH)]
    stretch = np.clip(np.searchsorted([t for t, _ in zeros], time, "right") - 1, 0, None)
    return np.array([zero for _, zero in zeros])[stretch] + np.round(
        time * NANOSECONDS).astype(np.int64)
