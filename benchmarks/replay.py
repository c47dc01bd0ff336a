"""The nodes as processes: how fast a recording passes through them, and what they cost live.

    python -m benchmarks.replay [RUNS [ANOTHER CHECKOUT]]

With another checkout, its nodes take turns with ours. CPU is that of the processes (user and
system), as the difference of two durations: neither their start nor other work on the machine
counts.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from benchmarks.acceleration_field_live import cpu_seconds
from benchmarks.recording_of_all import write_parameters, write_recording
from benchmarks.table import RESULTS
from imu_fusion.estimation.orientation.estimator import OrientationParams
from imu_fusion.messages.convert import imu_message, mag_message
from imu_fusion.messages.layouts import ACCEL, FIX, IMU, VECTOR3
from imu_fusion.messages.point_cloud import POINT_CLOUD_TYPE
from imu_fusion.nodes.processes import NodeProcesses
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.logs import read_log
from imu_fusion.streams.orientation import OrientationStream, warm_up

HERE = Path(__file__).resolve().parents[1]
BAG = HERE / "bags" / "broad_06_fast_rotation"
RATE = 286  # Hz, of each topic
BLOCK = 1000  # messages that an estimator takes at once at rate 0, about
LONG, SHORT, LIVE = 240, 40, 30  # s of recorded time
STARTED = 5 * 10**9  # ns, after which delays count: an orientation begins with a second at once
TOPICS = ("imu/data_raw", "imu/mag", "imu/data")
AT_RATE_ZERO = ("replayer", "orientation_estimator", "recorder")
BOUND = ("first", "middle", "last")
ALL = ("orientation_estimator", "acceleration_field_estimator", "smoother")
MAG = "sensor_msgs/msg/MagneticField"
# What these take and publish with each sample of the topic that they answer, which stands last.
BARE = {"orientation_estimator": ({"fix": FIX.msgtype, "imu/mag": MAG, "imu/data_raw": IMU.msgtype},
                                  {"imu/data": IMU.msgtype, "imu/rpy/filtered": VECTOR3.msgtype}),
        "acceleration_field_estimator": (
            {"imu/data_raw": IMU.msgtype} | {f"accelerometers/{name}": IMU.msgtype
                                             for name in ("top", "left", "front", "back")},
            {"acceleration_field/imu": IMU.msgtype, "acceleration_field/accel": ACCEL.msgtype,
             "acceleration_field/points": POINT_CLOUD_TYPE}),
        "smoother": ({"imu/mag": MAG, "fix": FIX.msgtype, "imu/data_raw": IMU.msgtype}, {})}
DRIVER = """
import sys, time
import rclpy
from imu_fusion.nodes.base import message_class
from imu_fusion.nodes.flow import reliable_qos
from imu_fusion.recordings.bag_reader import open_bag
rclpy.init()
node = rclpy.create_node("driver")
with open_bag(sys.argv[1]) as reader:
    outs = {t: node.create_publisher(message_class(i.msgtype), t, reliable_qos())
            for t, i in reader.topics.items()}
    while not all(out.get_subscription_count() >= 2 for out in outs.values()):
        time.sleep(0.1)
    time.sleep(1.0)
    messages = list(reader.messages())
start, first = time.monotonic(), messages[0][2]
for topic, _, stamp, cdr in messages:
    wait = start + (stamp - first) * 1e-9 - time.monotonic()
    if wait > 0:
        time.sleep(wait)
    outs[topic].publish(bytes(cdr))
time.sleep(1.0)
"""


@contextmanager
def nodes_of(checkout, logs):
    """NodeProcesses that run the code of a checkout."""
    before, path = Path.cwd(), os.environ.get("PYTHONPATH")
    os.chdir(checkout)  # Python looks there first
    os.environ["PYTHONPATH"] = str(checkout)
    try:
        with NodeProcesses(logs) as nodes:
            yield nodes
    finally:
        os.chdir(before)
        os.environ.pop("PYTHONPATH")
        if path is not None:
            os.environ["PYTHONPATH"] = path


def write_orientation(path, seconds):
    """The movement of ``BAG``, repeated and resampled in time: stamps."""
    with open_bag(BAG) as reader:
        imu, mag = read_log(reader, "imu/data_raw"), read_log(reader, "imu/mag")
    stamps = imu.stamp[0] + np.round(np.arange(seconds * RATE) * 1e9 / RATE).astype(np.int64)
    with BagWriter(path) as writer:
        for i, stamp in enumerate(stamps.tolist()):
            k = i % min(len(imu), len(mag))
            writer.write("/imu/data_raw", "sensor_msgs/msg/Imu",
                         imu_message(stamp, "imu_link", imu.gyr[k], imu.acc[k]), stamp)
            writer.write("/imu/mag", "sensor_msgs/msg/MagneticField",
                         mag_message(stamp, "imu_link", mag.mag[k]), stamp)
    return stamps


def watch(processes):
    """CPU seconds of each, when all have ended."""
    used = dict.fromkeys(processes, 0.0)
    while any(p.poll() is None for p in processes.values()):
        for name, process in processes.items():
            if process.poll() is None:
                used[name] = cpu_seconds(process)
        time.sleep(0.05)
    return used


def replay_once(checkout, bag, stamps, seconds, folder):
    """One replay: (messages lost, messages recorded per second, {node: CPU seconds})."""
    with tempfile.TemporaryDirectory(dir=folder) as own:
        out = Path(own) / "out"
        with nodes_of(checkout, Path(own) / "logs") as nodes:
            nodes.start("recorder", out=str(out), topics=TOPICS)
            nodes.start("orientation_estimator", qos="reliable")
            nodes.start("replayer", bag=str(bag), rate=0.0, wait_for_subscribers=0,
                        duration=float(seconds), wait_timeout=60.0,
                        wait_for_nodes=("recorder", "orientation_estimator"))
            estimator = nodes.process("orientation_estimator")
            ending = {n: nodes.process(n) for n in ("replayer", "recorder")}
            used = watch(ending)
            used["orientation_estimator"] = cpu_seconds(estimator)
        sent = stamps[stamps < stamps[0] + seconds * 10**9]
        lost = 0
        with open_bag(out) as reader:
            for topic in TOPICS:
                found = read_log(reader, topic).stamp
                if not np.array_equal(found, np.intersect1d(found, sent)):
                    raise SystemExit(f"{topic}: stamps out of order, repeated or invented")
                lost += len(sent) - len(found)
            took = (reader.end_time - reader.start_time) * 1e-9
        return lost, (3 * len(sent) - lost) / took, used


def bound_once(count):
    """The three processes of publish_and_take: (messages per second, {role: CPU seconds})."""
    domain = {"ROS_DOMAIN_ID": "99", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    processes = {role: subprocess.Popen(
        [sys.executable, "-m", "benchmarks.publish_and_take", role, str(count)], cwd=HERE,
        env=os.environ | domain | {"PYTHONPATH": str(HERE)}, stdout=subprocess.PIPE, text=True)
        for role in reversed(BOUND)}
    used = watch(processes)
    return float(processes[BOUND[-1]].communicate()[0]), used


def work_alone(bag, folder):
    """CPU seconds per 100,000 recorded messages of what the nodes do beside passing: (reading,
    decoding, estimating and encoding, writing)."""
    warm_up(OrientationParams())
    times = [time.process_time()]
    with open_bag(bag) as reader:
        messages = [(topic.lstrip("/"), stamp, cdr) for topic, _, stamp, cdr in reader.messages()]
    times.append(time.process_time())
    stream = OrientationStream()
    stream.reset(TOPICS[:2])
    made = []
    for i in range(0, len(messages), BLOCK):
        block = {topic: [cdr for name, _, cdr in messages[i:i + BLOCK] if name == topic]
                 for topic in TOPICS[:2]}
        made += [part for part in stream.take(block) if part.topic == TOPICS[2]]
    times.append(time.process_time())
    with BagWriter(folder / "work") as writer:
        for topic, stamp, cdr in messages:
            writer.write(f"/{topic}", stream.inputs[topic].layout.msgtype, cdr, stamp)
        for part in made:
            for stamp, cdr in zip(part.stamp.tolist(), part.cdrs):
                writer.write(f"/{part.topic}", IMU.msgtype, cdr, stamp)
    times.append(time.process_time())
    return np.diff(times) * 1e5 / (3 * RATE * LONG)


def per_100_000(long, short, names):
    """CPU seconds per 100,000 recorded messages, of each process."""
    messages = 3 * RATE * (LONG - SHORT)
    return [(long[name] - short[name]) * 1e5 / messages for name in names]


def published(path):
    """{topic: {header stamp: time of publication, ns}} of the topics of Imu messages."""
    found = {}
    for file in path.glob("*.mcap"):
        with open(file, "rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages():
                if schema.name == IMU.msgtype:
                    stamp = IMU.decode(message.data)[0]
                    found.setdefault(channel.topic, {})[stamp] = message.publish_time
    return found


@contextmanager
def beside(nodes, *arguments):
    """A process of Python in the domain of the nodes."""
    process = subprocess.Popen([sys.executable, *arguments], cwd=HERE, env=os.environ | {
        "PYTHONPATH": str(HERE), "ROS_DOMAIN_ID": str(nodes.domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"})
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def live_once(checkout, bag, nodes_there, folder):
    """A driver in real time: ({node: share of a core}, {output: its delays, ms}); of bare nodes in
    their place if there is no checkout."""
    with tempfile.TemporaryDirectory(dir=folder) as own, nodes_of(
            checkout or HERE, Path(own) / "logs") as nodes, ExitStack() as held:
        nodes.start("recorder", out=f"{own}/out")
        there = {}
        for node in nodes_there:
            if checkout is None:
                there[node] = held.enter_context(beside(
                    nodes, "-m", "benchmarks.bare_node", *map(json.dumps, BARE[node])))
            else:
                preset = Path(own) / "parameters.yaml"
                write_parameters(preset, checkout / "config")
                nodes.start(node, params_file=preset, qos="reliable")
                there[node] = nodes.process(node)
        driver = held.enter_context(beside(nodes, "-c", DRIVER, str(bag)))
        recorded = Path(own) / "out" / "out_0.mcap"
        while not recorded.exists() or recorded.stat().st_size < 500_000:
            time.sleep(0.1)
            if driver.poll() is not None:
                raise SystemExit("nothing was recorded")
        time.sleep(3.0)
        began = time.monotonic()
        before = {n: cpu_seconds(process) for n, process in there.items()}
        time.sleep(15.0)
        took = time.monotonic() - began
        share = {n: (cpu_seconds(process) - before[n]) / took for n, process in there.items()}
        driver.wait(120)
        nodes.process("recorder").send_signal(2)
        nodes.process("recorder").wait(60)
        times = published(Path(own) / "out")
    delays = {}
    for output, source in (("/imu/data", "/imu/data_raw"),
                           ("/acceleration_field/imu", "/accelerometers/back")):
        made, came = times.get(output, {}), times.get(source, {})
        if made:
            begin = min(made) + STARTED
            delays[output] = [(made[s] - came[s]) * 1e-6 for s in made if s in came and s > begin]
    return share, delays


def at_rate_zero(checkouts, runs, folder):
    """Lines of the table."""
    stamps = write_orientation(folder / "bag", LONG)
    lines = ["| | lost | recorded messages/s: median, each | CPU s per 100,000 recorded: "
             "replayer, estimator, recorder | sum | load |", "|---|---|---|---|---|---|"]
    found = {name: [] for name in checkouts}
    bounds = []
    for _ in range(runs):
        long, short = (bound_once(RATE * s) for s in (LONG, SHORT))
        bounds.append((long[0], per_100_000(long[1], short[1], BOUND)))
        print("bound", *bounds[-1], flush=True)
        for name, checkout in checkouts.items():
            long, short = (replay_once(checkout, folder / "bag", stamps, s, folder)
                           for s in (LONG, SHORT))
            found[name].append((long[0] + short[0], long[1],
                                per_100_000(long[2], short[2], AT_RATE_ZERO), os.getloadavg()[0]))
            print(name, *found[name][-1], flush=True)
    for name, rows in found.items():
        speeds = [row[1] for row in rows]
        cpu = np.median([row[2] for row in rows], axis=0)
        lines.append(
            f"| {name} | {sum(row[0] for row in rows)} | {statistics.median(speeds):.0f}: "
            + ", ".join(f"{s:.0f}" for s in speeds) + " | "
            + ", ".join(f"{c:.1f}" for c in cpu) + f" | {cpu.sum():.1f} | "
            + ", ".join(f"{row[3]:.1f}" for row in rows) + " |")
    cpus = np.median([cpu for _, cpu in bounds], axis=0), work_alone(folder / "bag", folder)
    for label, speed, cpu in (
            ("bytes published and taken, no work",
             f"{statistics.median(speed for speed, _ in bounds):.0f}", cpus[0]),
            ("the work in one process, nothing published or taken", "", cpus[1])):
        lines.append(f"| {label} | | {speed} | " + ", ".join(f"{c:.1f}" for c in cpu)
                     + f" | {cpu.sum():.1f} | |")
    return lines


def live(checkouts, runs, folder):
    """Lines of the table."""
    write_orientation(folder / "orientation", LIVE)
    write_recording(folder / "all", write_parameters(folder / "p.yaml"), LIVE)
    lines = ["| live | | CPU, % of a core: median | together | delay of imu/data ms: p50, p99 | of "
             "acceleration_field/imu | load |", "|---|---|---|---|---|---|---|"]
    compared = checkouts | {"plain rclpy, no work": None}
    for bag, nodes in (("orientation", ALL[:1]), ("all", ALL)):
        found = {name: [] for name in compared}
        for _ in range(runs):
            for name, checkout in compared.items():
                found[name].append((*live_once(checkout, folder / bag, nodes, folder),
                                    os.getloadavg()[0]))
                print(bag, name, found[name][-1][0], flush=True)
        for name, rows in found.items():
            shares = [100 * statistics.median(row[0][n] for row in rows) for n in nodes]
            delays = []
            for output in ("/imu/data", "/acceleration_field/imu"):
                both = [np.percentile(row[1][output], [50, 99]) for row in rows if output in row[1]]
                delays.append("{:.2f}, {:.2f}".format(*np.median(both, axis=0)) if both else "")
            lines.append(f"| {', '.join(nodes)} | {name} | "
                         + ", ".join(f"{s:.0f}" for s in shares) + f" | {sum(shares):.0f} | "
                         + " | ".join(delays) + " | "
                         + ", ".join(f"{row[2]:.1f}" for row in rows) + " |")
    return lines


def main(runs=3, other=None):
    """Run and write the tables."""
    checkouts = {"this one": HERE} | ({"before": Path(other).resolve()} if other else {})
    with tempfile.TemporaryDirectory(prefix="replay_") as folder:
        folder = Path(folder)
        tables = [at_rate_zero(checkouts, int(runs), folder), live(checkouts, int(runs), folder)]
    text = "\n".join([
        f"`python -m benchmarks.replay {runs} OTHER`; \"before\" is another checkout, whose nodes "
        "took turns with these. "
        f"{os.cpu_count()} cores, which others used, too (load: mean number of processes that "
        "want a core, ours included).", "",
        f"{LONG} s at {RATE} Hz Imu and MagneticField (bags/{BAG.name}, repeated) at rate 0 through "
        "replayer, orientation_estimator and recorder, three processes over Fast DDS; recorded "
        "messages are compared by their stamps.", "", *tables[0], "",
        f"A driver in real time, a recorder beside: Imu and MagneticField at {RATE} Hz through the "
        "orientation estimator; and four accelerometers at 1 kHz, Imu and MagneticField at 200 Hz "
        "and fixes at 10 Hz through all three. Delays are between the publication of a "
        "sample and that of its estimate, from the fifth second on.", "", *tables[1], ""])
    (RESULTS / "replay.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main(*sys.argv[1:])
