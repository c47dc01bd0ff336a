"""Memory and time that a recording of gigabytes takes, most of it images beside the samples:

    python -m benchmarks.large_recording [MEGABYTES]

Compared with reading it: every message once, by this package's reader, doing nothing with it. What
process takes beside reading are its start, the same for any recording, and estimating and writing,
which go with the samples and not with the bytes around them.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.table import write_table
from imu_fusion.messages.convert import imu_message
from imu_fusion.messages.layouts import IMU
from imu_fusion.recordings.bag_writer import BagWriter

START = 1_700_000_000_000_000_000
STEP = 5_000_000              # ns between samples of the Imu: 200 Hz
EVERY = 7                     # of them comes with an image
IMAGE = 640 * 480
CHUNK = 786_432               # bytes, as rosbag2 has it

READ = """
import sys
from imu_fusion.recordings.bag_reader import open_bag
with open_bag(sys.argv[1]) as reader:
    for _ in reader.messages():
        pass
"""


def write(path: Path, megabytes: int) -> int:
    """Write the recording; returns the number of Imu samples in it."""
    rng = np.random.default_rng(0)
    noise = rng.normal(0.0, 0.02, (1000, 6)) + [0, 0, 0, 0, 0, 9.81]
    image = rng.bytes(IMAGE)
    count = megabytes * 1_000_000 * EVERY // IMAGE
    with BagWriter(path, compression="none", chunk_size=CHUNK) as writer:
        for i in range(count):
            stamp = START + i * STEP
            values = noise[i % len(noise)]
            writer.write("/imu/data_raw", IMU.msgtype,
                         imu_message(stamp, "imu", values[:3], values[3:]), stamp)
            if i % EVERY == 0:
                writer.write("/camera/image", "sensor_msgs/msg/Image",
                             b"\0\1\0\0" + stamp.to_bytes(8, "little") + image, stamp)
    return count


def run(*arguments: object) -> tuple[float, float, float]:
    """(CPU s, s, peak of the resident memory in MB) of a command of Python."""
    began = time.monotonic()
    process = subprocess.Popen([sys.executable, *map(str, arguments)], stdout=subprocess.DEVNULL,
                               stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"{arguments} ended with status {status}")
    return (usage.ru_utime + usage.ru_stime, time.monotonic() - began, usage.ru_maxrss / 1024)


def main(megabytes: str = "2000") -> None:
    """Write the table; the exit code says whether 1 GB was exceeded."""
    with tempfile.TemporaryDirectory(prefix="large_") as folder:
        bag = Path(folder, "bag")
        count = write(bag, int(megabytes))
        commands = {
            "reading": ("-c", READ, bag),
            "info": ("-m", "imu_fusion.cli", "info", bag),
            "process": ("-m", "imu_fusion.cli", "process", bag, Path(folder, "out")),
            "process, of the samples alone": ("-m", "imu_fusion.cli", "process",
                                              Path(folder, "small"), Path(folder, "out"),
                                              "--overwrite"),
            "process, of a second": ("-m", "imu_fusion.cli", "process", Path(folder, "second"),
                                     Path(folder, "out"), "--overwrite"),
            "report": ("-m", "imu_fusion.cli", "report", bag, "--out",
                       Path(folder, "report.html"))}
        write(Path(folder, "second"), 10)
        run("-m", "imu_fusion.cli", "convert", bag, Path(folder, "small"), "--topic",
            "/imu/data_raw")
        found = {name: run(*command) for name, command in commands.items()}
    reading = found["reading"]
    write_table("large_recording", ("what", "CPU, s", "s", "times reading (CPU)", "peak, MB"),
                [(name, f"{cpu:.1f}", f"{wall:.1f}", f"{cpu / reading[0]:.2f}", round(peak))
                 for name, (cpu, wall, peak) in found.items()],
                f"{megabytes} MB, {count} samples of an Imu; python -m benchmarks.large_recording")
    sys.exit(max(peak for *_, peak in found.values()) > 1000)


if __name__ == "__main__":
    main(*sys.argv[1:])
