"""Sessions between real processes, disturbed: what is lost, and whether that is said.

    python -m benchmarks.flow [PART OF A SITUATION'S NAME [SESSIONS]]

Orientation and acceleration field estimator and smoother live on through all sessions of a
situation; each session has a new replayer and a new recorder. What was recorded is compared byte
by byte with the recording that was played, and with what `process` makes of that. *Silent* is a
session in which something is missing, added or altered while every exit code is 0 and the
recorder tells no count that explains it; or one that did not end.
"""

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.recording_of_all import write_parameters, write_recording
from benchmarks.table import write_table
from imu_fusion.batch import process
from imu_fusion.nodes.processes import NodeProcesses
from imu_fusion.recordings.bag_reader import open_bag

SECONDS = 2.0  # of recorded time
PATIENCE = 60.0  # s, for a session to end
ESTIMATORS = ("orientation_estimator", "acceleration_field_estimator", "smoother")
BOTH = ("recorder", *ESTIMATORS)
NOT_COMPARED = ("/diagnostics", "/recorder/summary", "/clock")
DRIVER = """
import time, rclpy
from sensor_msgs.msg import Imu
rclpy.init()
node = rclpy.create_node("driver")
out = node.create_publisher(Imu, "/imu/data_raw", 10)
while True:
    message = Imu()
    message.header.stamp = node.get_clock().now().to_msg()
    message.header.frame_id = "imu_link"
    message.linear_acceleration.z = 9.81
    out.publish(message)
    time.sleep(0.02)
"""


def messages(path):
    """{topic: Counter of the bytes of its messages, padded to four as DDS does}."""
    found = {}
    with open_bag(path) as reader:
        for topic, _, _, cdr in reader.messages():
            if topic not in NOT_COMPARED:
                found.setdefault(topic, Counter())[bytes(cdr) + bytes(-len(cdr) % 4)] += 1
    return found


class Expected:
    """A recording to play, and all messages that a recording of its replay should have."""

    def __init__(self, folder):
        self.bag, self.parameters = folder / "bag", folder / "parameters.yaml"
        self.topics, _ = write_recording(self.bag, write_parameters(self.parameters), SECONDS)
        self.messages = self.of(self.bag)

    def of(self, bag):
        """What is in a recording of these topics, and what its estimates should be."""
        with tempfile.TemporaryDirectory() as out:
            process(bag, out, self.parameters, without=("smoother",), overwrite=True)
            played = {topic: found for topic, found in messages(bag).items()
                      if topic in self.topics}
            return played | messages(out)


@dataclass
class Session:
    """What came out of one session."""

    codes: list[tuple[str, int]] = field(default_factory=list)
    lacks: int = 0  # messages
    told: int = 0  # of these, that the recorder tells the number of
    surplus: int = 0
    told_surplus: int = 0
    seconds: float = 0.0
    stalled: bool = False

    def compare(self, expected, outs, said):
        """Take into account what was recorded, in all recordings of the session together, and
        what their recorders printed."""
        found = {}
        for out in outs:
            for topic, here in messages(out).items():
                found[topic] = found.get(topic, Counter()) | here
        for topic, all_of_it in expected.items():
            here = found.get(topic, Counter())
            self.lacks += (all_of_it - here).total()
            self.surplus += (here - all_of_it).total()
        self.told = sum(map(int, re.findall(r"joined after (\d+)", said)
                            + re.findall(r"(\d+) LOST", said)))
        self.told_surplus = sum(map(int, re.findall(r"(\d+) not of the sessions", said)))

    @property
    def silent(self):
        """Whether something is wrong and not said."""
        if self.stalled:
            return True
        wrong = self.lacks > self.told or self.surplus > self.told_surplus
        return wrong and all(code == 0 for _, code in self.codes)


class Run:
    """The processes of a situation."""

    def __init__(self, folder, expected, nodes):
        self.folder, self.expected, self.nodes = folder, expected, nodes
        self.session = Session()
        self.outs, self.said = [], ""  # recordings of the session; what their recorders printed

    def start(self, node, **parameters):
        """A node, under its name."""
        if node in ESTIMATORS:
            parameters["params_file"] = self.expected.parameters
        if node == "recorder":
            self.outs.append(self.folder / f"out{time.monotonic_ns()}")
            parameters |= {"out": str(self.outs[-1]), "chunk_size": 4096}
        self.nodes.start(node, **parameters)

    def end(self, node, how=None):
        """Wait until a node has ended, of itself or by a signal."""
        running = self.nodes.process(node)
        if how is not None:
            running.send_signal(how)
        try:
            running.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            print(f"{node} does not end: {self.nodes.log(node)[-500:]}", flush=True)
            self.session.stalled = True
            running.kill()
            running.wait()
        self.session.codes.append((node, running.returncode))
        said = self.nodes.log(node)
        for line in said.splitlines():
            if "Traceback" in line:
                print(said, flush=True)
        if node == "recorder":
            self.said += said

    def until_recorded(self, size):
        """Until the recorder has written so many bytes."""
        deadline = time.monotonic() + PATIENCE
        while not any(f.stat().st_size > size for f in self.outs[-1].glob("*.mcap")):
            if time.monotonic() > deadline:
                self.session.stalled = True
                return
            time.sleep(0.02)

    def play(self, act=lambda run: None, rate=0.0, wait_for=BOTH, recorder="first",
             stopped=False):
        """One session; the recorder is there first, or starts at once, or late. ``stopped``: it is
        not played to its end, but orderly so."""
        self.session, self.outs, self.said = Session(), [], ""
        began = time.monotonic()
        if recorder != "late":
            self.start("recorder")
        if recorder == "first":
            self.until_recorded(-1)  # its file is there
            time.sleep(1.0)
        self.start("replayer", bag=str(self.expected.bag), rate=rate,
                   wait_for_subscribers=0, wait_for_nodes=wait_for)
        if recorder == "late":
            time.sleep(3.0)
            self.start("recorder")
        act(self)
        for node in ("replayer", "recorder"):
            if self.nodes.process(node).returncode is None or node == "recorder":
                self.end(node)
        self.session.seconds = time.monotonic() - began
        if not self.session.stalled:
            expected = self.expected.messages
            if stopped:  # the recording is as long as what was played
                expected = self.expected.of(self.outs[0])
                sent = sum(map(int, re.findall(r"(\d+) messages to", self.nodes.log("replayer"))))
                self.session.lacks = sent - sum(expected[t].total() for t in self.expected.topics)
            self.session.compare(expected, self.outs, self.said)
        return self.session


def disturb(node, how, again):
    """In mid-session, end a node, and start it again."""
    def act(run):
        run.until_recorded(50_000)
        run.end(node, how)
        if again:
            run.start(node)
    return act


@dataclass(frozen=True)
class Situation:
    """``act`` happens in each session; ``beside``: Python programs that run all the time."""

    name: str
    sessions: int
    act: Callable = lambda run: None
    options: dict = field(default_factory=dict)
    beside: tuple[str, ...] = ()


def situations():
    """All of them."""
    busy = ("while True: pass",) * (os.cpu_count() or 1)
    at_once, nobody = {"recorder": "at once"}, {"wait_for": ()}
    yield Situation("one after the other", 20, options=at_once)
    yield Situation("a busy process on each core", 20, options=at_once, beside=busy)
    yield Situation("no names to wait for", 10, options=nobody)
    yield Situation("no names to wait for, busy cores", 5, options=nobody, beside=busy)
    yield Situation("no names to wait for, recorder at once", 5, options=at_once | nobody | {
        "rate": 1.0})
    yield Situation("a second publisher of imu/data_raw", 2, beside=(DRIVER,))
    yield Situation("the recorder joins late", 2, options={
        "rate": 0.25, "wait_for": ESTIMATORS, "recorder": "late"})
    slowly = {"rate": 0.25}  # a node starts within 2 s, on idle cores
    for node in ("orientation_estimator", "acceleration_field_estimator", "smoother", "recorder"):
        for how, said in ((signal.SIGINT, "stopped"), (signal.SIGKILL, "kill -9")):
            yield Situation(f"{node}: {said}, started again", 1, disturb(node, how, True),
                            slowly)
    yield Situation("replayer: stopped", 1, disturb("replayer", signal.SIGINT, False),
                    slowly | {"stopped": True})
    yield Situation("replayer: kill -9", 1, disturb("replayer", signal.SIGKILL, False), slowly)


def run(situation, expected, folder):
    """Sessions of a situation, and the exit codes of the nodes that lived on."""
    folder.mkdir()
    sessions = []
    with ExitStack() as stack:
        nodes = stack.enter_context(NodeProcesses(folder / "logs"))
        environment = dict(os.environ, ROS_DOMAIN_ID=str(nodes.domain),
                           ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST")
        for program in situation.beside:
            beside = subprocess.Popen([sys.executable, "-c", program], env=environment)
            stack.callback(beside.wait)
            stack.callback(beside.kill)
        run_ = Run(folder, expected, nodes)
        for node in ESTIMATORS:
            run_.start(node)
        for _ in range(situation.sessions):
            sessions.append(run_.play(situation.act, **situation.options))
            print(f"  {sessions[-1]}{' SILENT' if sessions[-1].silent else ''}", flush=True)
            for out in run_.outs:
                if not sessions[-1].silent:
                    subprocess.run(["rm", "-r", str(out)], check=False)
        last = run_.session = Session()
        for node in ESTIMATORS:
            run_.end(node, signal.SIGINT)
        if any(s.silent for s in sessions):
            for node in (*ESTIMATORS, "replayer", "recorder"):
                print(f"--- {node}\n{nodes.log(node)[-1500:]}", flush=True)
    return sessions, last


def codes(sessions, node):
    """Exit codes of a node, and how often each."""
    counts = Counter(code for session in sessions for name, code in session.codes if name == node)
    return ", ".join(f"{code} ({count})" for code, count in sorted(counts.items()))


def main(part="", count=None):
    """Run those whose name has ``part``; the table is written if it is all of them."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="flow_") as folder:
        folder = Path(folder)
        expected = Expected(folder)
        for i, situation in enumerate(situations()):
            if part not in situation.name:
                continue
            print(situation.name, flush=True)
            if count:
                situation = Situation(situation.name, int(count), situation.act,
                                      situation.options, situation.beside)
            sessions, last = run(situation, expected, folder / str(i))
            rows.append([
                situation.name, len(sessions), sum(s.lacks for s in sessions),
                sum(s.told for s in sessions), sum(s.surplus for s in sessions),
                sum(s.told_surplus for s in sessions), codes(sessions, "replayer"),
                codes(sessions, "recorder"),
                "; ".join(codes([*sessions, last], node) for node in ESTIMATORS),
                f"{np.median([s.seconds for s in sessions]):.1f}",
                sum(s.silent for s in sessions)])
            print(rows[-1], flush=True)
    total = sum(counts.total() for counts in expected.messages.values())
    if not part:
        write_table("flow", [
            "situation", "sessions", "messages missing", "told by the recorder", "too many",
            "told", "exit codes of the replayers", "of the recorders",
            f"of {', '.join(ESTIMATORS)}", "s per session", "silent"], rows,
            f"`python -m benchmarks.flow`: {SECONDS:g} s of four accelerometers at 1 kHz, Imu and "
            f"magnetometer at 200 Hz and fixes at 10 Hz, {total} messages to be recorded in each "
            "session; at rate 0 where nothing is done to nodes, else slower than real time. In brackets: "
            "how often. Exit code 3 says that something is missing, 130 and -9 are ours. A recorder "
            "tells numbers only where it knows them: not what a vanished node would have sent.")


if __name__ == "__main__":
    main(*sys.argv[1:])
