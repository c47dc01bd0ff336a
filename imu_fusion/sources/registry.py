"""The formats: what they are called, how they are recognised, what reads them."""

import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

from imu_fusion.errors import ParameterError, SampleError
from imu_fusion.sources.avanode import AvanodeGnss, AvanodeImu
from imu_fusion.sources.description import Description
from imu_fusion.sources.gnss import Frames, Receiver
from imu_fusion.sources.gpx import Gpx
from imu_fusion.sources.phyphox import PhyphoxExport
from imu_fusion.sources.phyphox_live import PhyphoxLive
from imu_fusion.sources.sensor_logger import SensorLoggerExport, SensorLoggerPush
from imu_fusion.sources.sketch import sketch
from imu_fusion.sources.source import Source
from imu_fusion.sources.table import TableSource
from imu_fusion.sources.tables import Tables
from imu_fusion.sources.ulog import MAGIC, Ulog
from imu_fusion.sources.ximu3 import Ximu3, Ximu3Csv, is_csv

_SENTENCE = re.compile(rb"^\$G[A-Z]{4},", re.MULTILINE)
HEAD = 1 << 16    # bytes of each part by which a format is recognised
Heads = Mapping[str, bytes]
"""The first bytes of each part: of one file under its name, or of those of a folder or archive."""


@dataclass(frozen=True)
class Format:
    """One format.

    Attributes:
        name: of the parameter ``source`` of the driver. about: in words.
        recognises: whether these are the beginnings of its files.
        schemes: beginnings of the addresses of the transports that bring its stream.
        file, live: make the Source of a file, and of a stream, given ``platform`` and the like from
            the description; None where there is none.
    """

    name: str
    about: str
    recognises: Callable[[Heads], bool]
    file: Callable[..., Source] | None = None
    live: Callable[..., Source] | None = None
    options: tuple[str, ...] = ()
    schemes: tuple[str, ...] = ("serial", "tcp", "udp")


def _csvs(heads: Heads) -> dict[str, bytes]:
    return {PurePosixPath(part).stem.lower(): head for part, head in heads.items()
            if PurePosixPath(part).suffix.lower() == ".csv"}


def _is_sensor_logger(heads: Heads) -> bool:
    return any(re.match(rb"\xef\xbb\xbf?time,seconds_elapsed,|time,seconds_elapsed,", head)
               for head in _csvs(heads).values())


def _is_phyphox(heads: Heads) -> bool:
    if any(head.startswith(b"\xd0\xcf\x11\xe0") or (head.startswith(b"PK") and part.lower()
           .endswith(".xlsx")) for part, head in heads.items()):
        return len(heads) == 1
    names = _csvs(heads)
    if any(PurePosixPath(part).parts[-2:] == ("meta", "time.csv")
           and re.match(rb'(\xef\xbb\xbf)?"?event"?[,;\t]', head) for part, head in heads.items()):
        return True
    known = any(re.match(r"(accelerometer|gyroscope|raw data)$", name) for name in names)
    return known and any(re.match(rb'(\xef\xbb\xbf)?"?Time \(s\)"?[,;\t]', head)
                         for head in names.values())


def _is_receiver(heads: Heads) -> bool:
    if len(heads) != 1:
        return False
    head, = heads.values()
    # Sentences whose checksums are wrong, or missing, are to be told of as such.
    return len(Frames(Counter()).feed(head)) >= 2 or len(_SENTENCE.findall(head)) >= 2


def _is_ximu3(heads: Heads) -> bool:
    if len(heads) != 1:
        return False
    (part, head), = heads.items()
    source = Ximu3()
    found = sum(len(block.log) for block in source.feed(head[:8192]))
    return part.lower().endswith(".ximu3") or found > 2 * sum(source.lost.values()) + 2


def _is_ximu3_csv(heads: Heads) -> bool:
    return any(is_csv(stem, head) for stem, head in _csvs(heads).items())


def _starts(*beginnings: bytes) -> Callable[[Heads], bool]:
    return lambda heads: len(heads) == 1 and any(
        head.startswith(beginnings) for head in heads.values())


def _is_avanode_imu(heads: Heads) -> bool:
    return len(heads) == 1 and any(b"#Data contains time in (mus)" in head[:1000]
                                   for head in heads.values())


def _is_gpx(heads: Heads) -> bool:
    return len(heads) == 1 and any(b"<gpx" in head[:1000] for head in heads.values())


def _describe_themselves(heads: Heads) -> bool:
    for part, head in heads.items():
        try:
            if sketch(head, part).is_sure:
                return True
        except SampleError:
            continue
    return False


FORMATS = {known.name: known for known in (
    Format("phyphox", "phyphox, a phone's sensors (CSV or Excel, or its remote interface)",
           _is_phyphox, PhyphoxExport, PhyphoxLive, schemes=("http",)),
    Format("sensor_logger", "Sensor Logger, a phone's sensors (CSV, or pushed by HTTP)",
           _is_sensor_logger, SensorLoggerExport, SensorLoggerPush, ("platform",),
           ("http-push",)),
    Format("avanode_imu", "AvaNode, log of the IMU", _is_avanode_imu, AvanodeImu),
    Format("avanode_gnss", "AvaNode, log of the GNSS receiver", _starts(b"#microcontroller time"),
           AvanodeGnss),
    Format("ulog", "PX4 ULog", _starts(MAGIC), Ulog),
    Format("gpx", "GPX track", _is_gpx, Gpx),
    Format("ubx", "u-blox UBX and NMEA of a GNSS receiver", _is_receiver, Receiver, Receiver),
    Format("nmea", "NMEA of a GNSS receiver", lambda heads: False, Receiver, Receiver),
    Format("ximu3", "x-io x-IMU3", _is_ximu3, Ximu3, Ximu3),
    Format("ximu3_csv", "x-io x-IMU3, a session saved as CSV", _is_ximu3_csv, Ximu3Csv),
    Format("table", "table whose header names sensors, axes and units", _describe_themselves,
           Tables))}
"""By name, in the order in which they are tried."""


def recognise(heads: Heads) -> Format | None:
    """The format of a file, folder or archive; None if it is none that is known."""
    return next((known for known in FORMATS.values() if known.recognises(heads)), None)


def live_source(name: str, description: Mapping[str, Any] | None, where: str) -> Source:
    """The Source of a stream.

    Args:
        name: of FORMATS. description: content of the description file; a table needs one.
        where: what is named in errors.

    Raises:
        ParameterError: no such format, or the description does not fit.
    """
    if name == "table":
        if description is None:
            raise ParameterError("source table needs a description of its columns; imu_fusion "
                                 "describe FILE makes a first one of a file with such lines")
        return TableSource(Description.from_mapping(description, where), strict=False)
    known = FORMATS.get(name)
    if known is None or known.live is None:
        raise ParameterError((f"source '{name}' cannot be read live" if name else
                              "no source is given") + "; there are: " + ", ".join(
            [n for n, f in FORMATS.items() if f.live is not None] + ["table"]))
    return known.live(strict=False, **_options(known, description, where))


def check_transport(name: str, address: str) -> None:
    """Refuse a transport that cannot bring the stream of a format.

    Raises:
        ParameterError: names those that can.
    """
    schemes = FORMATS[name].schemes
    scheme = address.partition("://")[0]
    if scheme not in schemes and any(scheme in known.schemes for known in FORMATS.values()):
        raise ParameterError(f"transport '{address}': source {name} comes through "
                             + " or ".join(f"{known}://" for known in schemes))


def file_source(known: Format, description: Mapping[str, Any] | None = None,
                where: str = "") -> Source:
    """The Source of a file of a recognised format."""
    if known.file is None:
        raise ParameterError(f"{where}: {known.about} is no file format")
    return known.file(**_options(known, description, where))


def _options(known: Format, description: Mapping[str, Any] | None, where: str) -> dict[str, Any]:
    wrong = sorted(set(description or {}) - set(known.options))
    if wrong:
        raise ParameterError(f"{where}: '{wrong[0]}' says nothing to {known.about}"
                             + (f"; known: {', '.join(known.options)}" if known.options else
                                ", which needs no description"))
    return dict(description or {})
