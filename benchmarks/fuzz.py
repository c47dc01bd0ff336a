"""Broken files by the thousand: ``python -m benchmarks.fuzz [--count N] [--seed S] [KIND ...]``.

KIND may be ``files`` or ``devices``: all kinds of a group.

Each kind of file that the package reads is mutated as disks, cables and people do it (bytes,
lengths, pages of zeros, parts that are missing, repeated or moved, a cut end), and handed to what
reads it. The only answer permitted beside a result is one of the package's own errors, within 10 s
of computing and 1 GB. What fails is kept in ``--keep DIR`` with its mutation; results of a group
go to benchmarks/results/fuzz_<group>.md.
"""

import argparse
import random
import re
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from benchmarks.fuzz_devices import (
    DEVICES,
    read_answer,
    read_device,
    read_push,
    write_answer,
    write_device,
    write_push,
)
from benchmarks.table import write_table
from imu_fusion.errors import ImuFusionError
from imu_fusion.messages.convert import fix_message, imu_message, mag_message, velocity_message
from imu_fusion.messages.layouts import FIX, IMU, MAG, TWIST
from imu_fusion.messages.typestore import TYPES
from imu_fusion.parameters.file import load
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.convert import convert
from imu_fusion.recordings.inspect import inspect_topics
from imu_fusion.surfaces.file import load_surface

START = 1_700_000_000_000_000_000
SECONDS, MEGABYTES = 10, 1000
Mutation = tuple


def messages(count: int = 300):
    """(topic, msgtype, stamp, CDR) of an Imu at 100 Hz and slower sensors beside it."""
    for i in range(count):
        stamp = START + i * 10_000_000
        yield ("/imu/data_raw", IMU.msgtype, stamp,
               imu_message(stamp, "imu", [0.1, 0.0, i * 1e-3], [0.0, 0.0, 9.81]))
        if i % 2 == 0:
            yield "/imu/mag", MAG.msgtype, stamp, mag_message(stamp, "imu", [2e-5, i * 1e-9, 0.0])
        if i % 20 == 0:
            yield "/fix", FIX.msgtype, stamp, fix_message(stamp, "gnss", 47.0, 11.0, 600.0)
            yield ("/fix_velocity", TWIST.msgtype, stamp,
                   velocity_message(stamp, "world", np.zeros(3)))


def write_mcap(folder: Path, compression: str) -> Path:
    """A small MCAP file in many chunks."""
    with BagWriter(folder / "bag", compression=compression, chunk_size=8192) as writer:
        for topic, msgtype, stamp, cdr in messages():
            writer.write(topic, msgtype, cdr, stamp)
    return folder / "bag" / "bag_0.mcap"


def write_db3(folder: Path) -> Path:
    """A small sqlite3 file of rosbag2."""
    with Ros2Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {}
        for topic, msgtype, stamp, cdr in messages():
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=TYPES)
            writer.write(connections[topic], stamp, cdr)
    return folder / "bag" / "bag.db3"


def write_ros1(folder: Path, chunks: int = 16384) -> Path:
    """A small ROS 1 bag in several chunks."""
    noetic = get_typestore(Stores.ROS1_NOETIC)
    header_type = noetic.types["std_msgs/msg/Header"]
    writer = Ros1Writer(folder / "t.bag")
    writer.chunk_threshold = chunks
    with writer:
        connections = {}
        for i, (topic, msgtype, stamp, cdr) in enumerate(messages()):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=noetic)
            message = TYPES.deserialize_cdr(cdr, msgtype)
            message.header = header_type(seq=i, stamp=message.header.stamp, frame_id="imu")
            writer.write(connections[topic], stamp, noetic.serialize_ros1(message, msgtype))
    return folder / "t.bag"


DESCRIPTION = """\
time: {column: t, unit: ms, start: 1700000000.0}
position_unit: mm
accelerometers:
  front: {columns: [ax, ay, az], unit: g, position: [150, 0, 0]}
  back: {columns: [bx, by, bz], unit: g, position: [-150, 0, 0]}
  top: {columns: [cx, cy, cz], unit: g, position: [0, 0, 100]}
  side: {columns: [dx, dy, dz], unit: g, position: [0, 80, 0]}
"""
PARAMETERS = """\
/**:
  ros__parameters: {sensor: {gyro_noise_density: 1.0e-3}}
orientation_estimator:
  ros__parameters:
    method: fusion
    lag: 0.5
"""
SURFACE = """\
type: plane
origin: {latitude: 47.0, longitude: 11.0, height: 600.0}
sigma: 0.1
aspect_deg: 90.0
slope_deg: 20.0
"""


def write_csv(folder: Path) -> Path:
    """A table of four accelerometers; its description lies beside it."""
    (folder / "table.yaml").write_text(DESCRIPTION)
    names = [f"{sensor}{axis}" for sensor in "abcd" for axis in "xyz"]
    rows = ["t," + ",".join(names)]
    rows += [f"{i * 10}," + ",".join(f"{np.sin(i + k):.6f}" for k in range(12))
             for i in range(60)]
    (folder / "table.csv").write_text("\n".join(rows) + "\n")
    return folder / "table.csv"


def write_text(folder: Path, name: str, text: str) -> Path:
    """A file of text."""
    (folder / name).write_text(text)
    return folder / name


def read_recording(path: Path) -> None:
    """What ``info`` does."""
    with open_bag(path) as reader:
        inspect_topics(reader)


def read_csv(path: Path) -> None:
    """What ``convert --csv`` does with a table."""
    convert(path, path.with_name("out"), path.with_name("table.yaml"), overwrite=True)


def read_description(path: Path) -> None:
    """What ``convert --csv`` does with a description."""
    convert(path.with_name("table.csv"), path.with_name("out"), path, overwrite=True)


Kind = tuple[Callable[[Path], Path], Callable[[Path], object]]
FILES: dict[str, Kind] = {
    "mcap_none": (lambda f: write_mcap(f, "none"), read_recording),
    "mcap_lz4": (lambda f: write_mcap(f, "lz4"), read_recording),
    "mcap_zstd": (lambda f: write_mcap(f, "zstd"), read_recording),
    "db3": (write_db3, read_recording),
    "ros1": (write_ros1, read_recording),
    "csv": (write_csv, read_csv),
    "csv_description": (lambda f: write_csv(f).with_name("table.yaml"), read_description),
    "parameters": (lambda f: write_text(f, "p.yaml", PARAMETERS), load),
    "surface": (lambda f: write_text(f, "s.yaml", SURFACE), load_surface),
}
GROUPS: dict[str, dict[str, Kind]] = {"files": FILES, "devices": {
    **{kind: (partial(write_device, kind), partial(read_device, kind)) for kind in DEVICES},
    "phyphox_live": (write_answer, read_answer),
    "sensor_logger_push": (write_push, read_push),
}}
KINDS = {name: kind for group in GROUPS.values() for name, kind in group.items()}
_TEXT = (".csv", ".yaml", ".txt", ".gpx", ".nmea", ".json")

_WORDS = (b"0", b"-1", b"1e999999", b"nan", b"inf", b"1_0", b"9" * 400, b"'", b'"', b"[", b"{",
          b"}", b"&a ", b"*a", b"!!python/object/apply:os.system [x]", b"\t", b"\0", b"\xff\xfe",
          "\u0663".encode(), b"<<: ", b"---\n", b"%", b"? ", b"null", b"2001-13-45", b",,,,")


def mutated(data: bytes, rng: random.Random, suffix: str) -> tuple[bytes, list[Mutation]]:
    """A broken copy of the content of a file with that suffix, and what was done to it."""
    data, done = bytearray(data), []
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        size = max(len(data), 1)
        at = rng.randrange(size)
        kind = rng.choice(("byte", "bit", "u32", "u64", "zero", "rand", "splice", "drop", "twice",
                           "trunc", *(("word",) * 8 if suffix in _TEXT else ())))
        if kind == "byte":
            data[at:at + 1] = bytes([rng.randrange(256)])
        elif kind == "bit":
            data[at:at + 1] = bytes([(data[at] if at < len(data) else 0) ^ 1 << rng.randrange(8)])
        elif kind in ("u32", "u64"):
            code, width = ("<I", 32) if kind == "u32" else ("<Q", 64)
            value = rng.choice((0, 1, 2 ** (width - 1), 2 ** width - 1, len(data), 2 ** 31 - 1,
                                rng.randrange(2 ** width), rng.randrange(65536)))
            data[at:at + width // 8] = struct.pack(code, value)
        elif kind == "zero":
            length = rng.choice((1, 16, 512, 4096))
            data[at:at + length] = bytes(len(data[at:at + length]))
        elif kind == "rand":
            length = rng.choice((1, 4, 64, 1024))
            data[at:at + length] = rng.randbytes(len(data[at:at + length]))
        elif kind == "splice":
            length, source = rng.choice((4, 64, 1024, 4096)), rng.randrange(size)
            data[at:at + length] = data[source:source + length]
        elif kind == "drop":
            del data[at:at + rng.choice((1, 4, 512, 4096))]
        elif kind == "twice":
            length = rng.choice((1, 64, 4096))
            data[at:at] = data[at:at + length]
        elif kind == "word":
            data[at:at + rng.choice((0, 1, 4))] = rng.choice(_WORDS)
        else:
            del data[at:]
        done.append((kind, at))
    return bytes(data), done


def _timed_out(*_):
    raise TimeoutError(f"longer than {SECONDS} s")


def outcome(read: Callable[[Path], object], path: Path) -> str:
    """"read", "refused", or the place and kind of what went wrong."""
    signal.signal(signal.SIGPROF, _timed_out)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        read(path)
        return "read"
    except ImuFusionError as error:
        cause = error.__cause__
        if "damaged beyond reading (" in str(error) and cause is not None:
            return f"unforeseen {_where(cause)}"    # caught at the boundary, but to be looked at
        return "refused"
    except Exception as error:
        return f"FAILED {_where(error)}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _where(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "imu_fusion" in f.filename] or frames
    return f"{type(error).__name__} at {Path(ours[-1].filename).name}:{ours[-1].lineno}"


def run(kind: str, count: int, seed: int, keep: Path | None) -> dict:
    """Mutate and read ``count`` files of one kind; returns counts and figures."""
    write, read = KINDS[kind]
    found: Counter[str] = Counter()
    slowest = 0.0
    rng = random.Random(f"{seed} {kind}")
    with tempfile.TemporaryDirectory() as name:
        original = write(Path(name))
        data = original.read_bytes()
        if outcome(read, original) != "read":
            sys.exit(f"{kind}: the sound file cannot be read")
        (original.parent / "metadata.yaml").unlink(missing_ok=True)
        for _ in range(count):
            broken, done = mutated(data, rng, original.suffix)
            original.write_bytes(broken)
            began = time.perf_counter()
            result = outcome(read, original)
            slowest = max(slowest, time.perf_counter() - began)
            found[result] += 1
            if keep is not None and result.startswith(("FAILED", "unforeseen")) and (
                    found[result] <= 3):
                folder = keep / f"{kind}_{re.sub('[^A-Za-z0-9]+', '_', result)}_{found[result]}"
                folder.mkdir(parents=True, exist_ok=True)
                (folder / original.name).write_bytes(broken)
                (folder / "WHY.txt").write_text(f"{result}\n{done}\n")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    failed = sum(n for what, n in found.items() if what.startswith("FAILED"))
    return {"mutations": count, "read": found.pop("read", 0), "refused": found.pop("refused", 0),
            "failed": failed, "details": dict(found), "slowest_s": round(slowest, 2),
            "peak_mb": round(peak)}


def tabulate(group: str, results: dict[str, dict], count: int, seed: int) -> None:
    """Write the table of a group."""
    write_table(f"fuzz_{group}", ("file", "mutations", "read, at least in part", "refused in one line",
                         "tracebacks, hangs", "unforeseen, but caught", "slowest, s", "peak, MB"),
                [(kind, r["mutations"], r["read"], r["refused"], r["failed"],
                  sum(r["details"].values()) - r["failed"], r["slowest_s"], r["peak_mb"])
                 for kind, r in results.items()],
                f"python -m benchmarks.fuzz {group} --count {count} --seed {seed}")


def main() -> None:
    """Run the kinds named, all without any; the exit code says whether one failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kinds", nargs="*", metavar="KIND", default=[*GROUPS],
                        help=", ".join([*GROUPS, *KINDS]))
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path)
    arguments = parser.parse_args()
    results = {}
    for kind in (kind for name in arguments.kinds for kind in GROUPS.get(name, (name,))):
        results[kind] = run(kind, arguments.count, arguments.seed, arguments.keep)
        print(kind, results[kind], flush=True)
    for group, kinds in GROUPS.items():
        if kinds.keys() <= results.keys():
            tabulate(group, {kind: results[kind] for kind in kinds}, arguments.count,
                     arguments.seed)
    sys.exit(any(r["failed"] or r["peak_mb"] > MEGABYTES for r in results.values()))


if __name__ == "__main__":
    main()
