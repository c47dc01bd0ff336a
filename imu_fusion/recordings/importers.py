"""Files of two other programs as recordings: no description needed, they are recognised.

phyphox (a phone's sensors; https://phyphox.org), CSV export with comma and decimal point: a
folder with Accelerometer.csv (with gravity) and Gyroscope.csv, perhaps Magnetometer.csv and
Location.csv. Its times count from the start of the experiment, here from the arbitrary instant
``PHYPHOX_EPOCH``.

AvaNode (a logger for avalanches; https://github.com/AvaFrame/OpenNHM): a text file of an IMU
(counts, with the counts per unit in its header; microseconds since it was switched on, here
from ``AVANODE_EPOCH``) or of a GNSS receiver (UTC).

Nothing is made up: a phone's position without a valid accuracy or a receiver's without height is
no fix, a speed without direction no velocity, an accuracy that is not logged stays unknown.
"""

import csv
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from imu_fusion.errors import SampleError
from imu_fusion.messages.convert import fix_message, imu_message, mag_message, velocity_message
from imu_fusion.messages.layouts import FIX, IMU, MAG, NANOSECONDS, TWIST
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.csv_import import read_number
from imu_fusion.recordings.targets import refuse_source

Messages = Iterator[tuple[str, str, int, bytes]]    # topic, msgtype, stamp in ns, CDR
Importer = Callable[[Path], Messages]

PHYPHOX_EPOCH = AVANODE_EPOCH = 1_600_000_000_000_000_000
STANDARD_GRAVITY = 9.80665
IMU_FRAME, GNSS_FRAME, WORLD_FRAME = "imu_link", "gnss", "world"
NO_FIX, FIXED = -1, 0  # sensor_msgs/NavSatStatus

# Accelerometer samples further apart than this many usual intervals are not connected.
_GAP_FACTOR = 5.0
# A phone's ground speed comes without accuracy (receivers are within some 0.5 m/s) and says
# nothing of the vertical: standard deviations east, north, up in m/s.
_PHONE_VELOCITY_SD = np.array([0.5, 0.5, 100.0])
_MICROSECONDS_WRAP = 2 ** 32  # the logger's clock is a 32 bit counter
_FIX_3D = (3, 4)  # UBX fixType: 3-D, 3-D with dead reckoning
_IMU_COLUMNS = ("time", "acc x", "acc y", "acc z", "gyro x", "gyro y", "gyro z",
                "mag x", "mag y", "mag z")


def importer_of(source: str | Path) -> Importer | None:
    """The function of this module that yields (topic, msgtype, stamp, cdr) of a source.

    Returns:
        None if the source is neither a phyphox export nor an AvaNode log.
    """
    source = Path(source)
    if source.is_dir():
        recording = any(f.suffix in (".mcap", ".db3") for f in source.iterdir())
        known = any((source / f"{name}.csv").exists() for name in ("Accelerometer", "Gyroscope"))
        return phyphox if known and not recording else None
    if source.suffix.lower() == ".txt" and source.is_file():
        head = [line for _, line in zip(range(5), _lines(source))]
        if head and head[0].startswith("#microcontroller time"):
            return avanode_gnss
        if any(line.startswith("#Data contains time in (mus)") for line in head):
            return avanode_imu
    return None


def import_files(importer: Importer, source: str | Path, out: str | Path,
                 overwrite: bool = False) -> dict[str, int]:
    """Convert a source with what :func:`importer_of` gave for it: a rosbag2 directory ``out``.

    Returns:
        dict of topic to number of messages.

    Raises:
        SampleError: names the file and the line, column or unit that is wrong.
        BagError: ``out`` is in the way or cannot be written.
    """
    refuse_source(source, out)
    rows = sorted(importer(Path(source)), key=lambda row: row[2])
    with BagWriter(out, overwrite=overwrite, whole=True) as writer:
        for topic, msgtype, stamp, cdr in rows:
            writer.write(topic, msgtype, cdr, stamp)
    return dict(writer.counts)


def phyphox(folder: Path) -> Messages:
    """Messages of a phyphox export.

    The accelerometer is interpolated to the stamps of the gyroscope, whose samples are what is
    integrated; gyroscope samples outside of its span, or in its gaps, are left out. Accuracies
    are taken as standard deviations of each axis (phones mean 68 % of the circle, or do not say).
    """
    acc_stamp, acc = _phyphox_sensor(folder / "Accelerometer.csv", {"m/s^2": 1.0, "m/s²": 1.0})
    stamp, gyr = _phyphox_sensor(folder / "Gyroscope.csv", {"rad/s": 1.0})
    step = np.diff(acc_stamp)
    if len(step) == 0 or (step <= 0).any():
        raise SampleError(f"{folder / 'Accelerometer.csv'}, line "
                          f"{2 + int(np.argmax(np.r_[step <= 0, True]))}: no later time follows")
    keep, acc = _interpolated(stamp, acc_stamp, acc)
    if not keep.any():
        raise SampleError(f"{folder}: Accelerometer.csv and Gyroscope.csv have no time in common")
    for t, g, a in zip(stamp[keep], gyr[keep], acc[keep]):
        yield "/imu/data_raw", IMU.msgtype, int(t), imu_message(t, IMU_FRAME, g, a)
    if (folder / "Magnetometer.csv").exists():
        stamp, mag = _phyphox_sensor(folder / "Magnetometer.csv", {"µT": 1e-6, "μT": 1e-6})
        for t, m in zip(stamp, mag):
            yield "/imu/mag", MAG.msgtype, int(t), mag_message(t, IMU_FRAME, m)
    if (folder / "Location.csv").exists():
        yield from _phyphox_location(folder / "Location.csv")


def _phyphox_location(path):
    names, rows = _table(path)
    meters, degrees = {"m": 1.0}, {"°": 1.0}
    # Exports of iOS call the unit of the vertical accuracy a degree; it is metres.
    columns = [_column(path, names, rows, name, units) for name, units in (
        ("Time", {"s": 1.0}), ("Latitude", degrees), ("Longitude", degrees), ("Height", meters),
        ("Velocity", {"m/s": 1.0}), ("Direction", degrees), ("Horizontal Accuracy", meters),
        ("Vertical Accuracy", {"m": 1.0, "°": 1.0}))]
    for (line, _), (time, lat, lon, height, speed, direction, sd_h, sd_v) in zip(
            rows, np.column_stack(columns)):
        stamp = _phyphox_stamp(path, line, time)
        if np.isfinite([lat, lon, height]).all():
            if abs(lat) > 90 or abs(lon) > 360:
                raise SampleError(f"{path}, line {line}: latitude {lat:g}, longitude {lon:g} are "
                                  "not degrees")
            # Phones write -1 where position or height is not valid.
            valid = 0 < sd_h < np.inf and 0 < sd_v < np.inf
            cov = np.diag([sd_h ** 2, sd_h ** 2, sd_v ** 2]) if valid else None
            yield "/fix", FIX.msgtype, stamp, fix_message(
                stamp, GNSS_FRAME, lat, lon, height, cov, FIXED if valid else NO_FIX)
        if speed >= 0 and direction >= 0:
            course = np.radians(direction)  # clockwise from north
            velocity = [speed * np.sin(course), speed * np.cos(course), 0.0]
            yield "/fix_velocity", TWIST.msgtype, stamp, velocity_message(
                stamp, WORLD_FRAME, velocity, np.diag(_PHONE_VELOCITY_SD ** 2))


def _phyphox_sensor(path, units):
    """(stamp (n,) int64, values (n, 3) in SI) of one sensor's file."""
    names, rows = _table(path)
    time = _column(path, names, rows, "Time", {"s": 1.0})
    values = np.column_stack([_column(path, names, rows, axis, units) for axis in "XYZ"])
    return np.array([_phyphox_stamp(path, line, t) for (line, _), t in zip(rows, time)]), values


def _phyphox_stamp(path, line, time):
    if not 0 <= time < 1e9:
        raise SampleError(f"{path}, line {line}, column 'Time': {time:g} s is not a time since "
                          "the start of the experiment")
    return PHYPHOX_EPOCH + round(time * NANOSECONDS)


def _interpolated(stamp, source_stamp, values):
    """(mask of the stamps inside the source, values (n, k) there): linear, gaps stay open."""
    step = np.diff(source_stamp)
    after = np.clip(np.searchsorted(source_stamp, stamp), 1, len(step))
    keep = ((stamp >= source_stamp[0]) & (stamp <= source_stamp[-1])
            & (step[after - 1] <= _GAP_FACTOR * np.median(step)))
    since, source_since = ((s - source_stamp[0]) * 1e-9 for s in (stamp, source_stamp))
    return keep, np.column_stack([np.interp(since, source_since, v) for v in values.T])


def avanode_imu(path: Path) -> Messages:
    """Messages of an AvaNode IMU log.

    Its magnetometer is slower than its other sensors: a reading that only repeats the one
    before is left out. Axes are those of the log, which does not say whether the magnetometer's
    are those of the accelerometer.
    """
    lines = list(enumerate(_lines(path), 1))
    acc_factor, gyr_factor, mag_factor = _avanode_factors(path, lines)
    rows = [(line, text.split(",")) for line, text in lines
            if text.strip() and not text.startswith("#")]
    if not rows:
        raise SampleError(f"{path}: no samples")
    values = np.array([[read_number(path, line, name, row, k)
                        for k, name in enumerate(_IMU_COLUMNS)] for line, row in rows])
    if not np.isfinite(values[:, 0]).all():
        line = rows[int(np.argmin(np.isfinite(values[:, 0])))][0]
        raise SampleError(f"{path}, line {line}, column 'time': not a number")
    time = values[:, 0].astype(np.int64)
    wraps = np.cumsum(np.diff(time, prepend=time[0]) < -_MICROSECONDS_WRAP // 2)
    stamp = AVANODE_EPOCH + 1000 * (time + _MICROSECONDS_WRAP * wraps)
    acc = values[:, 1:4] / acc_factor * STANDARD_GRAVITY
    gyr = np.radians(values[:, 4:7] / gyr_factor)
    for t, g, a in zip(stamp, gyr, acc):
        yield "/imu/data_raw", IMU.msgtype, int(t), imu_message(t, IMU_FRAME, g, a)
    mag = values[:, 7:10] / mag_factor * 1e-6
    new = np.r_[True, (mag[1:] != mag[:-1]).any(axis=1)]
    for t, m in zip(stamp[new], mag[new]):
        yield "/imu/mag", MAG.msgtype, int(t), mag_message(t, IMU_FRAME, m)


def _avanode_factors(path, lines):
    """Counts per g, deg/s and uT: '#date,acc,gyro,mag,sync,id#'."""
    for line, text in lines:
        cells = text.strip().strip("#").split(",")
        if text.startswith("#") and len(cells) == 6 and not re.search("[a-z]", cells[1]):
            factors = [read_number(path, line, f"factor {name}", cells, k)
                       for k, name in enumerate(("acc", "gyro", "mag"), 1)]
            if not min(factors) > 0:
                raise SampleError(f"{path}, line {line}: factors {factors} must be above zero")
            return factors
    raise SampleError(f"{path}: no line '#date,factor acc,factor gyro,factor mag,sync,id#'")


def avanode_gnss(path: Path) -> Messages:
    """Messages of an AvaNode GNSS log; heights are taken as ellipsoidal.

    Stamps are UTC, its fraction from the receiver's time of week (they differ by whole seconds).
    Rows without a 3-D fix have no position and no velocity: NavSatStatus says so.
    """
    names, rows = _table(path)
    tow, fix_type, lon, lat, height, north, east, down = (
        _column(path, names, rows, name, {unit: factor}) for name, unit, factor in (
            ("iTow", "ms", 1.0), ("fixType", "0-5", 1.0), ("longitude", "deg", 1.0),
            ("latitude", "deg", 1.0), ("height", "mm", 1e-3), ("velN", "mm/s", 1e-3),
            ("velE", "mm/s", 1e-3), ("velD", "mm/s", 1e-3)))
    utc = _index(path, names, "utc", {"year:month:day:hour:minute:second": 1.0})[0]
    for k, (line, row) in enumerate(rows):
        fixed = fix_type[k] in _FIX_3D
        try:
            year, month, day, hour, minute, second = map(int, row[utc].split(":"))
            date = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
            stamp = int(date.timestamp()) * NANOSECONDS + round(tow[k] % 1000) * 1_000_000
        except (ValueError, TypeError, IndexError):
            if not fixed:
                continue  # the receiver does not know the date yet
            raise SampleError(f"{path}, line {line}, column 'utc': '{row[utc]}' is not a date, or "
                              f"iTow {tow[k]:g} not a time") from None
        yield "/fix", FIX.msgtype, stamp, fix_message(
            stamp, GNSS_FRAME, lat[k], lon[k], height[k], status=FIXED if fixed else NO_FIX)
        if fixed:
            yield "/fix_velocity", TWIST.msgtype, stamp, velocity_message(
                stamp, WORLD_FRAME, [east[k], north[k], -down[k]])


def _lines(path):
    try:
        with open(path, encoding="utf-8-sig", errors="replace", newline="") as stream:
            yield from (line.rstrip("\r\n") for line in stream)
    except OSError as error:
        raise SampleError(f"{path}: cannot be read ({error.strerror})") from None


def _table(path):
    """(column names, list of (line number, cells)) of a CSV with a line of names."""
    reader = csv.reader(_lines(path))
    rows = [(reader.line_num, cells) for cells in reader if cells]
    if len(rows) < 2:
        raise SampleError(f"{path}: no rows of numbers")
    return rows[0][1], rows[1:]


def _index(path, names, wanted, units):
    """(place, factor to SI) of the column 'wanted (unit)' or 'wanted[unit]'."""
    found = None
    # Newer exports write 'Acceleration x (m/s^2)'.
    prefix = "(?:.* )?" if len(wanted) == 1 else ""
    for place, name in enumerate(names):
        match = re.fullmatch(prefix + wanted + r"\s*[(\[](.*)[)\]]", name.strip(), re.IGNORECASE)
        if match and match[1] in units:
            return place, units[match[1]]
        found = match[1] if match else found
    if found is not None:
        raise SampleError(f"{path}: column '{wanted}' is in '{found}', expected "
                          + " or ".join(units))
    raise SampleError(f"{path}: no column '{wanted}'; there are: {', '.join(names)} (exported "
                      "with comma and decimal point?)")


def _column(path, names, rows, wanted, units):
    """(n,) values in SI, NaN for empty cells."""
    place, factor = _index(path, names, wanted, units)
    return factor * np.array([read_number(path, line, wanted, row, place) for line, row in rows])
