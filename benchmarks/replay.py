"""A 10-minute recording through the nodes at rate 0, in processes: what is lost, how fast.

    python -m benchmarks.replay [runs]
"""

import os
import resource
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from imu_fusion.messages.convert import imu_message, mag_message
from imu_fusion.nodes.processes import NodeProcesses
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.logs import read_log

DURATION = 600  # s
RATE = 286  # Hz, of each topic
BAG = Path(__file__).resolve().parents[1] / "bags" / "broad_06_fast_rotation"
RESULT = Path(__file__).parent / "results" / "replay.md"
TOPICS = ("imu/data_raw", "imu/mag", "imu/data")


def long_recording(path):
    """The movement of ``BAG``, repeated and resampled in time, as 10 minutes at 286 Hz."""
    with open_bag(BAG) as reader:
        imu, mag = read_log(reader, "imu/data_raw"), read_log(reader, "imu/mag")
    stamps = imu.stamp[0] + np.round(np.arange(DURATION * RATE) * 1e9 / RATE).astype(np.int64)
    with BagWriter(path) as writer:
        for i, stamp in enumerate(stamps.tolist()):
            k = i % min(len(imu), len(mag))
            writer.write("/imu/data_raw", "sensor_msgs/msg/Imu",
                         imu_message(stamp, "imu_link", imu.gyr[k], imu.acc[k]), stamp)
            writer.write("/imu/mag", "sensor_msgs/msg/MagneticField",
                         mag_message(stamp, "imu_link", mag.mag[k]), stamp)
    return stamps


def replay_once(bag, stamps, out):
    """One replay: (messages lost per topic, seconds first to last message, CPU seconds)."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with NodeProcesses(logs=out.parent / f"{out.name}_logs") as nodes:
        nodes.start("recorder", out=str(out), topics=TOPICS)
        nodes.start("orientation_estimator", qos="reliable")
        nodes.start("replayer", bag=str(bag), rate=0.0, wait_for_subscribers=0,
                    wait_for_nodes=("recorder", "orientation_estimator"), wait_timeout=60.0)
        nodes.wait("replayer", 900)
        nodes.wait("recorder", 60)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    lost = {}
    with open_bag(out) as reader:
        for topic in TOPICS:
            found = read_log(reader, topic).stamp
            if not np.array_equal(found, np.intersect1d(found, stamps)):
                raise SystemExit(f"{topic}: stamps out of order, repeated or invented")
            lost[topic] = len(stamps) - len(found)
        return lost, (reader.end_time - reader.start_time) * 1e-9, cpu


def main(runs=10):
    """Run and write the table."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="replay_") as folder:
        folder = Path(folder)
        stamps = long_recording(folder / "bag")
        for i in range(runs):
            started = time.monotonic()
            lost, seconds, cpu = replay_once(folder / "bag", stamps, folder / f"out{i}")
            rows.append((lost, seconds, time.monotonic() - started, cpu, os.getloadavg()[0]))
            print(i + 1, *rows[-1], flush=True)
            shutil.rmtree(folder / f"out{i}")
    seconds = np.array([row[1] for row in rows])
    messages = len(TOPICS) * len(stamps)
    lines = [
        f"{DURATION} s at {RATE} Hz Imu and MagneticField (the samples of bags/{BAG.name}, "
        "repeated) at rate 0 through replayer, orientation_estimator and recorder: three "
        f"processes over Fast DDS on {os.cpu_count()} cores that others used too (load: mean "
        f"number of processes that want a core, ours included). {messages} messages recorded per run, "
        "compared by their stamps. The first run may compile kernels.",
        "",
        "| run | lost imu/data_raw | lost imu/mag | lost imu/data | first to last message s | "
        "with start and end s | CPU s of the three | load | real-time factor | "
        "recorded messages/s |",
        "|---|---|---|---|---|---|---|---|---|---|"]
    for i, (lost, took, total, cpu, load) in enumerate(rows):
        cells = [str(i + 1), *(str(lost[t]) for t in TOPICS), f"{took:.1f}", f"{total:.1f}",
                 f"{cpu:.0f}", f"{load:.1f}", f"{DURATION / took:.1f}", f"{messages / took:.0f}"]
        lines.append("| " + " | ".join(cells) + " |")
    lines += ["", f"Lost in {runs} runs: {sum(sum(row[0].values()) for row in rows)}. "
              f"Real-time factor: median {DURATION / np.median(seconds):.1f}, "
              f"worst {DURATION / seconds.max():.1f}, best {DURATION / seconds.min():.1f}."]
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text("\n".join(lines) + "\n")
    print(RESULT.read_text())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
