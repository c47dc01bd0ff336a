"""x-io x-IMU3: its messages, binary and text, live or in a .ximu3 file, and the CSV files that its
software makes of one.

A message ends with a line feed. A binary one begins with its letter + 0x80, then the time in
microseconds (uint64) and single precision numbers, little endian, with 0x0A and 0xDB escaped; a
text is ``I,<us>,<gx>,<gy>,<gz>,<ax>,<ay>,<az>`` (deg/s, g). Times count from when it was switched
on, here from :data:`~imu_fusion.sources.source.EPOCH`. Its magnetometer tells no tesla but
arbitrary units, in which the field where it was calibrated is 1: they are taken as 50 uT.
Source: x-IMU3 User Manual (x-io Technologies), "Data messages".
"""

import struct
from pathlib import PurePosixPath

import numpy as np

from imu_fusion.samples.logs import ImuLog, Log, MagLog
from imu_fusion.sources.description import Description
from imu_fusion.sources.source import (
    EPOCH,
    IMU_TOPIC,
    MAG_TOPIC,
    STANDARD_GRAVITY,
    Block,
    Source,
    WholeSource,
    is_number,
    named,
)
from imu_fusion.sources.table import TableSource

_LONGEST = 1024    # bytes of a message
_NUMBERS = {"I": 6, "M": 3}
_UNIT = 50e-6      # T
_UNIT_SAID = "the magnetometer of an x-IMU3 tells no tesla: its unit is taken as 50 uT"
_CSV_TIME = "Timestamp (us)"
#: Files of a session: what they hold, in which columns and unit.
_CSV_FILES: dict[str, dict[str, tuple[slice, str, float]]] = {
    "inertial": {"gyroscope": (slice(1, 4), "deg/s", 1.0),
                 "accelerometer": (slice(4, 7), "g", 1.0)},
    "magnetometer": {"magnetometer": (slice(1, 4), "T", 1.0 / _UNIT)}}
_CSV_UNITS = {"inertial": "(deg/s)", "magnetometer": "(a.u.)"}


class Ximu3(Source):
    """Inertial and magnetometer messages; others are left alone."""

    topics = (IMU_TOPIC, MAG_TOPIC)

    def __init__(self, strict: bool = False) -> None:
        super().__init__(False)    # a file is a stream that was kept
        self._rest = b""
        self.device = "x-IMU3"

    def restart(self) -> None:
        self._rest = b""

    def feed(self, data: bytes, part: str = "") -> list[Block]:
        *messages, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > _LONGEST:
            messages, self._rest = [*messages, self._rest], b""
        found: dict[str, list[tuple[int, tuple[float, ...]]]] = {"I": [], "M": []}
        for message in messages:
            read = _read(message)
            if read is None:
                self.lost["messages that are none of an x-IMU3"] += 1
            elif read[0] in found:
                found[read[0]].append(read[1:])
        logs: dict[str, Log] = {}
        for letter, topic in (("I", IMU_TOPIC), ("M", MAG_TOPIC)):
            if found[letter]:
                stamp = EPOCH + 1000 * np.array([us for us, _ in found[letter]], dtype=np.int64)
                values = np.array([v for _, v in found[letter]])
                logs[topic] = (MagLog(stamp, values * _UNIT) if letter == "M" else ImuLog(
                    stamp, np.radians(values[:, :3]), values[:, 3:] * STANDARD_GRAVITY))
        if found["M"]:
            self.remark(_UNIT_SAID)
        return named(logs)


def is_csv(stem: str, head: bytes) -> bool:
    """Whether a file called so is one of a session, by its beginning."""
    names = _names(head)
    return stem in _CSV_FILES and names[0] == _CSV_TIME and _CSV_UNITS[stem] in "".join(names[1:2])


class Ximu3Csv(WholeSource):
    """The CSV files of a session, of which those of other messages are left alone."""

    def finish(self) -> list[Block]:
        blocks: list[Block] = []
        for part, data in self.parts.items():
            stem = PurePosixPath(part).stem.lower()
            if not is_csv(stem, bytes(data[:_LONGEST])):
                continue
            names = _names(bytes(data[:_LONGEST]))
            table = TableSource(Description.from_mapping({
                "time": {"column": _CSV_TIME, "unit": "us", "start": EPOCH * 1e-9},
                **{key: {"columns": names[columns], "unit": unit, "scale": scale}
                   for key, (columns, unit, scale) in _CSV_FILES[stem].items()}}, part))
            blocks += table.feed(bytes(data), part) + table.finish()
            self.lost += table.lost
            for text in [*table.remarks, *([_UNIT_SAID] if stem == "magnetometer" else [])]:
                self.remark(text)
        return blocks


def _names(head: bytes) -> list[str]:
    return head.partition(b"\n")[0].decode("utf-8", "replace").strip().split(",")


def _read(message: bytes) -> tuple[str, int, tuple[float, ...]] | None:
    """(letter, us, numbers) of a message; of others the letter alone; None of what is none."""
    if not message:
        return None
    if message[0] & 0x80:
        letter = chr(message[0] & 0x7F)
        if letter not in _NUMBERS:
            return (letter, 0, ()) if letter.isalpha() else None
        body = message[1:].replace(b"\xdb\xdc", b"\n").replace(b"\xdb\xdd", b"\xdb")
        if len(body) != 8 + 4 * _NUMBERS[letter]:
            return None
        us, *values = struct.unpack(f"<Q{_NUMBERS[letter]}f", body)
    else:
        cells = message.rstrip(b"\r").decode("ascii", "replace").split(",")
        letter = cells[0]
        if letter not in _NUMBERS:
            return (letter, 0, ()) if message[:1] == b"{" or (
                len(letter) == 1 and letter.isalpha() and len(cells) > 2) else None
        if (len(cells) != 2 + _NUMBERS[letter] or not cells[1].isdecimal()
                or not cells[1].isascii() or not all(map(is_number, cells[2:]))):
            return None
        us, values = int(cells[1]), [float(cell) for cell in cells[2:]]
    # Beyond a century it is no time since it was switched on.
    return (letter, us, tuple(values)) if us < 3e15 and np.isfinite(values).all() else None
