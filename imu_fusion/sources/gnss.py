"""GNSS receivers: NMEA 0183, and u-blox UBX between it.

NMEA tells no accuracies unless GST is on, and no vertical velocity: what it does not tell stays
unknown. A u-blox that also speaks UBX tells all of it in NAV-PVT, which is then used alone. Framing
and checksums are ours, so that damage costs a frame and not the stream; the contents are read by
pyubx2 and pynmeagps.
"""

import math
import re
from collections import Counter
from dataclasses import replace
from datetime import UTC, date, datetime, time, timedelta
from typing import Any

import numpy as np

from imu_fusion.errors import SampleError
from imu_fusion.samples.logs import FixLog, ImuLog, Log, VelocityLog
from imu_fusion.sources.source import (
    EPOCH,
    FIX_TOPIC,
    FIXED,
    IMU_TOPIC,
    NO_FIX,
    VELOCITY_TOPIC,
    Block,
    Source,
)
from imu_fusion.sources.table import UNKNOWN_CLIMB_SD

_SYNC = b"\xb5\x62"
_LONGEST_UBX = 8192     # bytes of a payload; longer ones are none of a receiver
_LONGEST_NMEA = 256     # bytes; the standard says 82
_START = re.compile(rb"\xb5\x62|\$")
_FIX_3D = (3, 4)        # with dead reckoning
_SPEED_SD = 0.5         # m/s, of receivers that do not tell
_KNOT = 1852 / 3600
_SOME_DAY = datetime.fromtimestamp(EPOCH / 1e9, UTC).date()
_MOST_UNDATED = 200_000    # samples of a file that wait for a date: hours
_UNDATED = "epochs of NMEA before a date came (RMC or ZDA)"
# ESF-MEAS and ESF-RAW data types: gyroscope x, y, z in deg/s, accelerometer x, y, z in m/s^2.
_ESF = {14: ("gyr", 0, 2.0 ** -12 * math.pi / 180), 13: ("gyr", 1, 2.0 ** -12 * math.pi / 180),
        5: ("gyr", 2, 2.0 ** -12 * math.pi / 180), 16: ("acc", 0, 2.0 ** -10),
        17: ("acc", 1, 2.0 ** -10), 18: ("acc", 2, 2.0 ** -10)}
_PVT, _MEAS, _RAW = (0x01, 0x07), (0x10, 0x02), (0x10, 0x03)
# Time tags of ESF-RAW are those of the sensor chip (BMI160 data sheet: 39.0625 us, 24 bits).
_TICK, _TICKS = 39_062.5, 1 << 24    # ns
_ASTRAY = 1_000_000_000    # ns that tags may be away from the receiver's own milliseconds


def _needs(name: str) -> Any:
    """The module of a library that only these formats need."""
    try:
        if name == "pyubx2":
            from pyubx2 import UBXReader
            return UBXReader
        from pynmeagps import NMEAReader
        return NMEAReader
    except ImportError:
        raise SampleError(f"reading a receiver needs {name}: pip install 'imu_fusion[devices]'"
                          ) from None


class Frames:
    """Cuts bytes into frames of UBX and sentences of NMEA that are sound.

    ``lost`` counts, in words, what was not.
    """

    def __init__(self, lost: Counter[str]) -> None:
        self.lost, self._rest = lost, b""

    def restart(self) -> None:
        """What was incomplete will not be completed."""
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """The frames that are complete now."""
        found: list[bytes] = []
        data, position = self._rest + data, 0
        while True:
            start = _START.search(data, position)
            if start is None:
                # The last byte may be the first of a frame.
                position = len(data) - (data[-1:] == _SYNC[:1])
                break
            length = self._length(data, start.start())
            if length is None:
                position = start.start()
                break
            position = start.start() + max(length, 1)
            if length:
                found.append(data[start.start():position])
        self._rest = data[position:]
        return found

    def _length(self, data: bytes, at: int) -> int | None:
        """Bytes of the frame at a place: None if it is not complete, 0 if it is none."""
        if data[at:at + 1] == b"$":
            return self._length_nmea(data, at)
        if len(data) - at < 6:
            return None
        length = int.from_bytes(data[at + 4:at + 6], "little")
        if length > _LONGEST_UBX:
            self.lost["frames of UBX whose length is wrong"] += 1
            return 0
        if len(data) - at < length + 8:
            return None
        if _checksum(data[at + 2:at + length + 6]) != data[at + length + 6:at + length + 8]:
            self.lost["frames of UBX whose checksum is wrong"] += 1
            return 0
        return length + 8

    def _length_nmea(self, data: bytes, at: int) -> int | None:
        end = data.find(b"\n", at, at + _LONGEST_NMEA)
        body = data[at + 1:end if end >= 0 else at + _LONGEST_NMEA]
        if any(byte > 126 or byte == 36 for byte in body):    # 36: the next sentence
            return 0
        if end < 0:
            return None if len(body) < _LONGEST_NMEA - 1 else 0
        if not _nmea_is_sound(body):
            self.lost["sentences of NMEA whose checksum is wrong"] += 1
            return 0
        return end + 1 - at


class _Axes:
    """Readings of single axes with one time tag: ``gyr`` (3,) rad/s and ``acc`` (3,) m/s^2, NaN
    where none has come."""

    def __init__(self) -> None:
        self.gyr, self.acc = np.full(3, np.nan), np.full(3, np.nan)

    def add(self, kind: int, word: int) -> None:
        """Take a reading of a type of _ESF: the lower 24 bits of a word, with sign."""
        if kind in _ESF:
            sensor, axis, factor = _ESF[kind]
            value = word & 0xFFFFFF
            getattr(self, sensor)[axis] = (value - ((value >> 23) << 24)) * factor


class Receiver(Source):
    """NMEA and UBX, mixed as they come from a port or stand in a file.

    Stamps are UTC. NMEA is left alone from the first NAV-PVT on. Before RMC or ZDA has told the
    date, its epochs wait for it in a file (``strict``), and are lost in a stream.
    """

    topics = (FIX_TOPIC, VELOCITY_TOPIC, IMU_TOPIC)

    def __init__(self, strict: bool = True) -> None:
        super().__init__(False)    # a file of a receiver is a stream that was kept
        self._frames = Frames(self.lost)
        self._ubx_reader: Any = None
        self._nmea_reader: Any = None
        self._speaks_ubx = False
        self._is_file = strict
        # Of the latest epoch; times have no date before RMC or ZDA tells one.
        self._day, self._at, self._is_dated = _SOME_DAY, time(), False
        self._undated: list[Block] = []
        self._epoch: dict[str, Any] = {}
        self._axes = _Axes()
        self._has_raw = False
        self._last_tag: int | None = None    # of ESF-MEAS, or of ESF-RAW once that has come
        self._turns = 0                      # how often tags of ESF-MEAS began anew
        self._since = 0.0                    # ns of the latest tag of ESF-RAW

    def restart(self) -> None:
        self._frames.restart()
        self._epoch = {}

    def feed(self, data: bytes, part: str = "") -> list[Block]:
        found: list[Block] = []
        for frame in self._frames.feed(data):
            found += self._ubx(frame) if frame[:1] == _SYNC[:1] else self._nmea(frame)
        return _joined(found)

    def finish(self) -> list[Block]:
        found = self._flush()
        if self._undated and self._speaks_ubx:    # which has its dates
            self.lost[_UNDATED] += len(self._undated)
        elif self._undated:
            self.remark("NMEA told no date (RMC and ZDA are off): the times are right, of an "
                        "arbitrary day")
            found, self._undated = self._undated, []
        return _joined(found)

    def _ubx(self, frame: bytes) -> list[Block]:
        kind = frame[2], frame[3]
        if kind == _RAW:
            return self._readings(frame[6:-2])
        if kind not in (_PVT, _MEAS) or (kind == _MEAS and self._has_raw):
            return []
        self._ubx_reader = self._ubx_reader or _needs("pyubx2")
        try:
            message = self._ubx_reader.parse(frame)
            if kind == _MEAS:
                return self._measurements(message)
            self._speaks_ubx, self.device = True, "u-blox"
            return self._solution(message)
        except Exception:    # of the library, whose errors have no common root
            self.lost["frames of UBX that cannot be read"] += 1
            return []

    def _solution(self, m: Any) -> list[Block]:
        """NAV-PVT: all of a solution, with accuracies."""
        if not (m.validDate and m.validTime):
            self.lost["solutions before the receiver knows the time"] += 1
            return []
        whole = datetime(m.year, m.month, m.day, m.hour, m.min, m.second, tzinfo=UTC)
        stamp = int(whole.timestamp()) * 10**9 + int(m.nano)
        fixed = bool(m.gnssFixOk) and m.fixType in _FIX_3D
        cov = np.diag([m.hAcc, m.hAcc, m.vAcc]) ** 2 * 1e-6
        blocks = [_fix(stamp, (m.lat, m.lon, m.height * 1e-3), cov, fixed)]
        if fixed:
            vel = np.array([m.velE, m.velN, -m.velD]) * 1e-3
            blocks.append(_velocity(stamp, vel, np.eye(3) * (m.sAcc * 1e-3) ** 2))
        return blocks

    def _measurements(self, m: Any) -> list[Block]:
        """ESF-MEAS: single axes, put together where all six have one time tag, in ms."""
        tag = int(m.timeTag)
        if tag != self._last_tag:
            self._axes = _Axes()
            self._turns += self._last_tag is not None and tag < self._last_tag - 2**31
            self._last_tag = tag
        for k in range(int(m.numMeas)):
            self._axes.add(int(getattr(m, f"dataType_{k + 1:02d}", -1)),
                           int(getattr(m, f"dataField_{k + 1:02d}")))
        return self._imu(EPOCH + (tag + self._turns * 2**32) * 1_000_000)

    def _readings(self, payload: bytes) -> list[Block]:
        """ESF-RAW: the receiver's ms since it was switched on, then axes of one sample or more,
        each with the chip's time tag."""
        if not self._has_raw:
            self._has_raw, self._last_tag = True, None
        whole = len(payload) >= 12 and len(payload) % 8 == 4
        if not whole:
            self.lost["frames of UBX that cannot be read"] += 1
            return []
        ms, *words = np.frombuffer(payload, "<u4").tolist()
        blocks: list[Block] = []
        for k, (word, tag) in enumerate(zip(words[::2], words[1::2])):
            tag %= _TICKS
            if tag != self._last_tag:
                self._axes = _Axes()
                self._since += ((tag - (self._last_tag or 0)) % _TICKS) * _TICK
                self._last_tag = tag
            # At the start, and where frames were lost for so long that tags began anew.
            if not k and abs(self._since - ms * 1e6) > _ASTRAY:
                self._since = ms * 1e6
            self._axes.add(word >> 24, word)
            blocks += self._imu(EPOCH + round(self._since))
        return blocks

    def _imu(self, stamp: int) -> list[Block]:
        """The sample of the axes that have come, if they are all there."""
        if not np.isfinite([self._axes.gyr, self._axes.acc]).all():
            return []
        self.remark("times of the receiver's inertial sensors are its own, not UTC")
        log = ImuLog(np.array([stamp]), self._axes.gyr[None], self._axes.acc[None])
        self._axes = _Axes()
        return [Block(IMU_TOPIC, log, "sensors")]

    def _nmea(self, frame: bytes) -> list[Block]:
        if self._speaks_ubx or frame[3:6] not in (b"RMC", b"GGA", b"GST", b"ZDA"):
            return []
        self._nmea_reader = self._nmea_reader or _needs("pynmeagps")
        kind = frame[3:6].decode()
        try:
            message = self._nmea_reader.parse(frame)
            at = getattr(message, "time", None)
            if not isinstance(at, time):
                return []
            day = date(int(message.year), int(message.month), int(message.day)) if (
                kind == "ZDA") else getattr(message, "date", None)
            if isinstance(day, date) and not 1980 <= day.year <= 2100:
                raise ValueError
        except Exception:    # of the library, too
            self.lost["sentences of NMEA that cannot be read"] += 1
            return []
        self.device = self.device or "NMEA receiver"
        # The sentences of one epoch have one time.
        done = self._flush() if self._epoch and self._epoch["time"] != at else []
        self._epoch.setdefault("time", at)
        if isinstance(day, date):
            done += self._date(day)
        self._epoch[kind] = message
        return done

    def _date(self, day: date) -> list[Block]:
        """Take the date of the present epoch; returns what has waited for one."""
        shift = (day - self._day_of(self._epoch["time"])).days * 86_400_000_000_000
        self._day, self._at, self._is_dated = day, self._epoch["time"], True
        waited, self._undated = self._undated, []
        return [block._replace(log=replace(block.log, stamp=block.log.stamp + shift))
                for block in waited]

    def _day_of(self, at: time) -> date:
        """The day of a time that follows the latest one: the next one, where the clock has passed
        midnight."""
        return self._day + timedelta(days=_hours(at) < _hours(self._at) - 12.0)

    def _flush(self) -> list[Block]:
        """The samples of an epoch that is over."""
        epoch, self._epoch = self._epoch, {}
        gga, rmc, gst = (epoch.get(kind) for kind in ("GGA", "RMC", "GST"))
        if not epoch or (gga is None and rmc is None):
            return []
        if not self._is_dated and not (self._is_file and len(self._undated) < _MOST_UNDATED):
            self.lost[_UNDATED] += 1
            return []
        self._day, self._at = self._day_of(epoch["time"]), epoch["time"]
        stamp = _nanoseconds(self._day, epoch["time"])
        blocks = []
        if gga is not None and _known(gga.lat, gga.lon, gga.alt):
            separation = gga.sep if _known(gga.sep) else 0.0
            if not _known(gga.sep):
                self.remark("heights are above sea level: the receiver tells no geoid")
            sd = (gst.stdLong, gst.stdLat, gst.stdAlt) if gst is not None else ()
            cov = np.diag(np.square(sd)) if sd and _known(*sd) else np.zeros((3, 3))
            if not cov.any():
                self.remark("NMEA tells no accuracies (GST is off): their covariance is unknown")
            fixed = bool(int(gga.quality or 0))
            blocks.append(_fix(stamp, (gga.lat, gga.lon, gga.alt + separation), cov, fixed))
        if rmc is not None and rmc.status == "A" and _known(rmc.spd, rmc.cog):
            course, speed = math.radians(rmc.cog), rmc.spd * _KNOT
            vel = np.array([speed * math.sin(course), speed * math.cos(course), 0.0])
            # Nothing is known of the vertical; a covariance of zeros would leave it at zero.
            cov = np.diag([_SPEED_SD, _SPEED_SD, UNKNOWN_CLIMB_SD]) ** 2
            self.remark("NMEA tells no vertical velocity and no accuracy of speed: .5 m/s is taken "
                        f"for it, {UNKNOWN_CLIMB_SD:g} m/s for the vertical")
            blocks.append(_velocity(stamp, vel, cov))
        if not self._is_dated:
            self._undated += blocks
            return []
        return blocks


def _fix(stamp: int, place: tuple[float, float, float], cov: np.ndarray, fixed: bool) -> Block:
    lat, lon, height = np.array(place)[:, None]
    return Block(FIX_TOPIC, FixLog(np.array([stamp]), lat, lon, height, cov[None],
                                   np.array([FIXED if fixed else NO_FIX])))


def _velocity(stamp: int, vel: np.ndarray, cov: np.ndarray) -> Block:
    return Block(VELOCITY_TOPIC, VelocityLog(np.array([stamp]), vel[None], cov[None]))


def _checksum(body: bytes) -> bytes:
    """Fletcher's, as UBX has it."""
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return bytes((a, b))


def _nmea_is_sound(text: bytes) -> bool:
    """Whether the text between $ and the line's end has the checksum that it says."""
    body, star, given = text.strip().rpartition(b"*")
    if not star or len(given) != 2:
        return False
    total = 0
    for byte in body:
        total ^= byte
    return f"{total:02X}".encode() == given.upper()


def _nanoseconds(day: date, at: time) -> int:
    whole = datetime.combine(day, at.replace(microsecond=0), tzinfo=UTC)
    return int(whole.timestamp()) * 10**9 + at.microsecond * 1000


def _hours(at: time) -> float:
    return at.hour + at.minute / 60.0


def _known(*values: Any) -> bool:
    return all(isinstance(v, (int, float)) and math.isfinite(v) for v in values)


def _joined(blocks: list[Block]) -> list[Block]:
    """Blocks of one topic that follow each other, as one."""
    found: dict[tuple[str, str], list] = {}
    for topic, log, clock in blocks:
        found.setdefault((topic, clock), []).append(log)
    return [Block(topic, Log.joined(logs), clock) for (topic, clock), logs in found.items()]
