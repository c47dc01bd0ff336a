"""Small sound files, and answers, of each device: what ``benchmarks.fuzz`` breaks."""

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from imu_fusion.errors import SampleError
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.inspect import inspect_topics
from imu_fusion.sources.phyphox_live import PhyphoxLive
from imu_fusion.sources.sensor_logger import SensorLoggerPush
from test.sources.exports import Server, batches, export, poll, sensor_logger, zipped
from test.sources.logs import ulog
from test.sources.test_exports import AVANODE_GNSS, AVANODE_IMU, LOCATION
from test.sources.test_splitting import STREAMS

Files = Mapping[str, bytes]


def table() -> bytes:
    """A table whose header says what it holds."""
    names = [f"{sensor} {axis} ({unit})" for sensor, unit in (
        ("Gyroscope", "rad/s"), ("Accelerometer", "m/s^2")) for axis in "XYZ"]
    time = np.arange(120) * 0.01
    rows = np.column_stack([time, 0.3 * np.sin(7 * time), 0 * time, 0.1 + 0 * time,
                            0.1 * np.sin(time), 0 * time, 9.81 + 0 * time])
    return "\n".join([",".join(["Time (s)", *names]), *(
        ",".join(f"{v:.6f}" for v in row) for row in rows)]).encode() + b"\n"


def _phone() -> Files:
    fixes = "".join(f"0.{k},47.0,11.0,600.0,1.0,90.0,5.0,8.0\n" for k in range(9))
    return export() | {"walk/Location.csv": (LOCATION + fixes).encode()}


def _avanode() -> Files:
    rows = "".join(f"{5000 * k},0,0,2048,{k},0,-16,100,-50,{k},1\n" for k in range(80))
    return {"C03.txt": (AVANODE_IMU + rows).encode()}


def _avanode_gnss() -> Files:
    rows = "".join(f"{k},{201115800 + 100 * k},2022:2:22:7:51:{30 + k // 10},3,11.3832481,47.31,"
                   "2321428,35,29,27,0\n" for k in range(40))
    return {"C07.txt": (AVANODE_GNSS + rows).encode()}


def _stream(name: str, suffix: str) -> tuple[Callable[[], Files], str]:
    """A file with what a device sends."""
    part = f"t.{suffix}"
    return lambda: {part: STREAMS[name][1]}, part


#: What makes the files, and which of them is broken.
DEVICES: dict[str, tuple[Callable[[], Files], str]] = {
    "phyphox": (_phone, "walk/Accelerometer.csv"),
    "phyphox_time": (_phone, "walk/meta/time.csv"),
    "phyphox_location": (_phone, "walk/Location.csv"),
    "sensor_logger": (sensor_logger, "log/Accelerometer.csv"),
    "sensor_logger_location": (sensor_logger, "log/Location.csv"),
    "sensor_logger_metadata": (sensor_logger, "log/Metadata.csv"),
    "zip": (lambda: {"walk.zip": zipped(_phone())}, "walk.zip"),
    "avanode_imu": (_avanode, "C03.txt"),
    "avanode_gnss": (_avanode_gnss, "C07.txt"),
    "ulog": (lambda: {"t.ulg": ulog()}, "t.ulg"),
    "gpx": _stream("gpx", "gpx"), "ubx": _stream("ubx", "ubx"), "nmea": _stream("nmea", "nmea"),
    "ximu3": _stream("ximu3", "ximu3"), "table": (lambda: {"t.csv": table()}, "t.csv")}


def write_device(kind: str, folder: Path) -> Path:
    """Write the files of a device; returns the one that is to be broken."""
    make, part = DEVICES[kind]
    for name, data in make().items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder / part


def read_device(kind: str, path: Path) -> None:
    """What ``info`` does with them: with all of a folder."""
    for _ in range(DEVICES[kind][1].count("/")):
        path = path.parent
    with open_bag(path) as reader:
        inspect_topics(reader)


def write_answer(folder: Path) -> Path:
    """What phyphox answers, on a request for its readings."""
    source, server = PhyphoxLive(), Server()
    poll(source, server)
    poll(source, server)
    server.now = 0.3
    path = folder / "answer.json"
    path.write_text(json.dumps(server.answer(source.request())))
    return path


def read_answer(path: Path) -> None:
    """A phone that answers so to everything, and one that does once it measures."""
    for sound in (0, 2):
        source, server = PhyphoxLive(), Server()
        for _ in range(sound):
            poll(source, server)
        for _ in range(3):
            with suppress(SampleError):    # the driver says so, and asks again
                source.feed(path.read_bytes(), source.request() or "")
        source.finish()


def write_push(folder: Path) -> Path:
    """What Sensor Logger pushes."""
    path = folder / "push.json"
    path.write_bytes(batches()[0])
    return path


def read_push(path: Path) -> None:
    """It comes first, and after another one."""
    for before in ([], batches()[:1]):
        source = SensorLoggerPush()
        for data in (*before, path.read_bytes(), batches()[1]):
            source.feed(data)
        source.finish()
