"""x-io x-IMU3: its messages, binary and text, live or in a .ximu3 file.

A message ends with a line feed. A binary one begins with its letter + 0x80, then the time in
microseconds (uint64) and single precision numbers, little endian, with 0x0A and 0xDB escaped; a
text is ``I,<us>,<gx>,<gy>,<gz>,<ax>,<ay>,<az>`` (deg/s, g). Times count from when it was switched
on, here from :data:`~imu_fusion.sources.source.EPOCH`. Its magnetometer tells no tesla but
arbitrary units, in which the field where it was calibrated is 1: they are taken as 50 uT.
Source: x-IMU3 User Manual (x-io Technologies), "Data messages".
"""

import struct

import numpy as np

from imu_fusion.samples.logs import ImuLog, Log, MagLog
from imu_fusion.sources.source import (
    EPOCH,
    IMU_TOPIC,
    MAG_TOPIC,
    STANDARD_GRAVITY,
    Block,
    Source,
    is_number,
    named,
)

_LONGEST = 1024    # bytes of a message
_NUMBERS = {"I": 6, "M": 3}
_UNIT = 50e-6      # T


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
            self.remark("the magnetometer of an x-IMU3 tells no tesla: its unit is taken as 50 uT")
        return named(logs)


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
