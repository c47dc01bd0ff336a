"""What is done to the nodes while they work, and what comes of it: the fault matrix.

    python -m benchmarks.faults [PART OF A SITUATION'S NAME]

Real processes of replayer, orientation estimator or smoother, and recorder; one situation after
the other, each in a ROS domain of its own. Amiss is whatever does not end, any traceback, a
recording that cannot be read, and anything that is missing in one while the exit codes of replayer
and recorder are 0.
"""

import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks import hostile_peers
from benchmarks.flow import DRIVER
from benchmarks.replay import beside
from benchmarks.table import table
from imu_fusion.errors import BagError
from imu_fusion.messages.convert import fix_message, imu_message, mag_message
from imu_fusion.nodes.processes import NodeProcesses
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.losses import read_losses

PATIENCE = 90.0  # s, for anything to happen
STOPPED = 30.0  # s, in which a process is stopped
START, STEP = 1_700_000_000_000_000_000, 5_000_000  # ns
COUNT = 1600  # Imu samples of the recording; a magnetometer sample with every fourth
SENSORS = ("/imu/data_raw", "/imu/mag")
NOTHING = "nothing"  # of a recording that was not to be
PAGE = Path(__file__).parents[1] / "docs" / "faults.md"
TEXT = """<!-- written by python -m benchmarks.faults -->
# What can happen to the nodes

Real processes of replayer, orientation estimator or smoother, and recorder, each situation in a ROS
domain of its own. *Amiss* would be a process that does not end, a traceback, a recording that cannot
be read, or anything missing while the exit codes of replayer and recorder are 0.

Exit code 3 says that something was lost; 130 is SIGINT, as any node is ended that would live on; -9
is kill -9. *Recorded* are messages of Imu and magnetometer, of those in the recording that is
played; the lines that a recording tells of its losses are those that `imu_fusion info` shows. What
hostile peers send: `benchmarks/hostile_peers.py`.

"""


def write_bag(path: Path, count: int = COUNT) -> Path:
    """A body at rest, with fixes at 10 Hz."""
    noise = np.random.default_rng(0).normal(0.0, 0.01, (count, 6))
    with BagWriter(path) as writer:
        for i in range(count):
            stamp = START + i * STEP
            writer.write("/imu/data_raw", "sensor_msgs/msg/Imu", imu_message(
                stamp, "imu_link", noise[i, :3], noise[i, 3:] + (0.0, 0.0, 9.81)), stamp)
            if i % 4 == 0:
                writer.write("/imu/mag", "sensor_msgs/msg/MagneticField", mag_message(
                    stamp, "imu_link", (0.0, 2e-5, -4e-5)), stamp)
            if i % 20 == 0:
                writer.write("/fix", "sensor_msgs/msg/NavSatFix", fix_message(
                    stamp, "gnss", 47.0, 11.0, 500.0, np.diag([1.0, 1.0, 4.0])), stamp)
    return path


@dataclass
class Trial:
    """The processes of a situation, and what has come of them.

    ``codes``: (name, exit code) in the order in which they were waited for; ``amiss``: in words.
    """

    folder: Path
    nodes: NodeProcesses
    codes: list[tuple[str, int]] = field(default_factory=list)
    amiss: list[str] = field(default_factory=list)
    recorded: list[str] = field(default_factory=list)

    @property
    def out(self) -> Path:
        """The recording."""
        return self.folder / "out"

    def play(self, estimator: str = "orientation_estimator", rate: float = 1.0,
             **recording: object) -> None:
        """Start recorder, estimator and replayer; returns when something was recorded."""
        own = {"smooth_at_end": True} if estimator == "smoother" else {}
        self.nodes.start("recorder", out=str(self.out), chunk_size=4096, **recording)
        self.nodes.start(estimator, qos="reliable", **own)
        self.nodes.start("replayer", bag=str(self.folder.parent / "bag"), rate=rate,
                         wait_for_subscribers=0, wait_for_nodes=("recorder", estimator))
        self.until(lambda: size_of(self.out) > 30_000 or not self.runs("replayer"))

    def until(self, condition: Callable[[], bool], what: str = "nothing happens") -> None:
        """Wait for an event."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            if time.monotonic() > deadline:
                self.amiss.append(what)
                return
            time.sleep(0.02)

    def runs(self, node: str) -> bool:
        """Whether it has not ended."""
        return self.nodes.process(node).poll() is None

    def signal(self, node: str, number: int) -> None:
        """Send a signal."""
        self.nodes.process(node).send_signal(number)

    def end(self, *names: str, number: int | None = None) -> None:
        """Wait until nodes have ended, of themselves or by a signal."""
        for node in names:
            if number is not None:
                self.signal(node, number)
            process = self.nodes.process(node)
            try:
                process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                self.amiss.append(f"{node} does not end")
                process.kill()
                process.wait()
            self.codes.append((node, process.returncode))
            if "Traceback" in self.nodes.log(node):
                self.amiss.append(f"traceback of {node}: {self.nodes.log(node)[-1500:]}")

    def compare(self, out: Path | None = None, sent: int = COUNT + COUNT // 4) -> None:
        """What is in a recording of a replay that has ended."""
        out = self.out if out is None else out
        try:
            with open_bag(out) as reader:
                found = sum(reader.topics[t].count for t in SENSORS if t in reader.topics)
                told = len(read_losses(reader))
        except BagError as error:
            self.recorded.append(NOTHING)
            if out.exists():
                self.amiss.append(str(error))
            return
        self.recorded.append(f"{found} of {sent}" + (f", {told} lines told" if told else ""))
        if found < sent and not any(code for node, code in self.codes
                                    if node in ("replayer", "recorder")):
            self.amiss.append(f"{sent - found} missing, and nobody says so")


def size_of(recording: Path) -> int:
    """Bytes of its file so far."""
    return sum(file.stat().st_size for file in recording.glob("*.mcap"))


def killed(node: str, again: bool, trial: Trial) -> None:
    """kill -9 in mid-session, and a start under the same name."""
    trial.play()
    trial.end(node, number=signal.SIGKILL)
    out = trial.out
    if again:
        if node == "recorder":
            out = trial.folder / "again"
        trial.nodes.start(node, **({"out": str(out)} if node == "recorder" else {}))
    others = [n for n in ("replayer", "recorder") if n != node or (again and n == "recorder")]
    trial.end(*others)
    if node != "orientation_estimator" or again:
        trial.end("orientation_estimator", number=signal.SIGINT)
    trial.compare(out)


def stopped(node: str, trial: Trial) -> None:
    """SIGSTOP, longer than the lease of a node in the graph, then SIGCONT."""
    trial.play(rate=0.5)
    trial.signal(node, signal.SIGSTOP)
    time.sleep(STOPPED)
    trial.signal(node, signal.SIGCONT)
    trial.end("replayer", "recorder")
    trial.end("orientation_estimator", number=signal.SIGINT)
    trial.compare()


def disk_full(trial: Trial) -> None:
    """No file of the recorder may grow any more."""
    trial.play()
    limit = size_of(trial.out) + 2000
    resource.prlimit(trial.nodes.process("recorder").pid, resource.RLIMIT_FSIZE, (limit, limit))
    trial.end("recorder", "replayer")
    trial.end("orientation_estimator", number=signal.SIGINT)
    trial.compare()


def unwritable(trial: Trial) -> None:
    """The recording is to be where none can be."""
    trial.nodes.start("recorder", out="/proc/nowhere")
    trial.end("recorder")
    trial.recorded.append(NOTHING)


def smoother_killed(trial: Trial) -> None:
    """The process that smooths is killed at it."""
    trial.play("smoother", rate=0.0, expected_sources=("smoother",))
    pid = trial.nodes.process("smoother").pid
    children = Path(f"/proc/{pid}/task/{pid}/children")

    def kill() -> bool:
        for child in children.read_text().split():
            if "spawn_main" in Path(f"/proc/{child}/cmdline").read_text():
                os.kill(int(child), signal.SIGKILL)
                return True
        return False

    trial.until(kill, "nothing is smoothed")
    trial.end("replayer", "smoother")
    trial.end("recorder", number=signal.SIGINT)
    trial.compare()


def before_and_after(trial: Trial) -> None:
    """A replay that waits for nobody by name begins before estimator and recorder are there."""
    trial.nodes.start("replayer", bag=str(trial.folder.parent / "bag"), wait_for_subscribers=1)
    time.sleep(2.0)
    trial.nodes.start("recorder", out=str(trial.out))
    trial.nodes.start("orientation_estimator")
    trial.end("replayer", "recorder")
    trial.end("orientation_estimator", number=signal.SIGINT)
    trial.compare()


def two_graphs(together: bool, trial: Trial) -> None:
    """Two replays and recordings at once, in one domain or in two."""
    with NodeProcesses(trial.folder / "other", trial.nodes.domain if together else None) as nodes:
        other = Trial(trial.folder / "second", nodes)
        other.folder.mkdir()
        (other.folder.parent / "bag").symlink_to(trial.folder.parent / "bag")
        trial.play()
        other.play()
        for part in (trial, other):
            part.end("replayer", "recorder")
        for part in (trial, other):
            part.end("orientation_estimator", number=signal.SIGINT)
            part.compare()
    trial.codes += other.codes
    trial.amiss += other.amiss
    trial.recorded += other.recorded


def loop(trial: Trial) -> None:
    """A replay without end, ended."""
    trial.nodes.start("recorder", out=str(trial.out), chunk_size=4096)
    trial.nodes.start("replayer", bag=str(trial.folder.parent / "bag"), rate=0.0, loop=True,
                      wait_for_nodes=("recorder",))
    trial.until(lambda: size_of(trial.out) > 1_000_000)
    trial.end("replayer", number=signal.SIGINT)
    trial.end("recorder")
    trial.compare()


def hostile(kind: str, trial: Trial) -> None:
    """Nodes that live on beside a publisher of the kind, and then with a sensor."""
    trial.nodes.start("recorder", out=str(trial.out), chunk_size=4096,
                      topics=("/imu/data", *SENSORS))
    trial.nodes.start("orientation_estimator")
    trial.nodes.start("smoother")
    trial.until(trial.out.exists)
    with beside(trial.nodes, "-m", "benchmarks.hostile_peers", kind) as peer:
        peer.wait(PATIENCE)
    with beside(trial.nodes, "-c", DRIVER):
        grown = size_of(trial.out) + 20_000
        trial.until(lambda: size_of(trial.out) > grown, "no sensor is heard any more")
    trial.end("orientation_estimator", "smoother", "recorder", number=signal.SIGINT)
    with open_bag(trial.out) as reader:
        made = reader.topics["/imu/data"].count if "/imu/data" in reader.topics else 0
    trial.recorded.append(f"{made} of /imu/data")
    if not made or any(code != 130 for _, code in trial.codes):
        trial.amiss.append("a node has ended, or made nothing of the sensor")


def hostile_session(kind: str, trial: Trial) -> None:
    """The same beside a replay."""
    trial.play(rate=0.4)
    with beside(trial.nodes, "-m", "benchmarks.hostile_peers", kind):
        trial.end("replayer", "recorder")
    trial.end("orientation_estimator", number=signal.SIGINT)
    trial.compare()


Situation = Callable[[Trial], None]
_NODES = ("replayer", "recorder", "orientation_estimator")
SITUATIONS: dict[str, Situation] = {
    **{f"kill -9 of the {node}": partial(killed, node, False) for node in _NODES},
    **{f"kill -9 of the {node}, started again under its name": partial(killed, node, True)
       for node in _NODES[1:]},
    **{f"the {node} stopped for {STOPPED:g} s": partial(stopped, node) for node in _NODES},
    "disk full": disk_full,
    "a recording where none can be": unwritable,
    "the smoother killed while it smooths": smoother_killed,
    "a replay before the others are there": before_and_after,
    "two graphs in one domain": partial(two_graphs, True),
    "two graphs in two domains": partial(two_graphs, False),
    "a loop, ended": loop,
    **{f"hostile peer: {kind}": partial(hostile, kind) for kind in hostile_peers.KINDS},
    **{f"hostile peer beside a replay: {kind}": partial(hostile_session, kind)
       for kind in ("values", "wrong_type", "forged")}}


def try_out(situation: Situation, folder: Path) -> Trial:
    """One situation, in a folder of its own beside the recording ``bag``."""
    folder.mkdir()
    with NodeProcesses(folder / "logs") as nodes:
        trial = Trial(folder, nodes)
        situation(trial)
    return trial


def main(part: str = "") -> None:
    """Those whose name has ``part``; the table is written if it is all of them."""
    rows = []
    with tempfile.TemporaryDirectory(prefix="faults_") as folder:
        write_bag(Path(folder, "bag"))
        for number, (name, situation) in enumerate(SITUATIONS.items()):
            if part in name:
                trial = try_out(situation, Path(folder, str(number)))
                rows.append([name, ", ".join(f"{node} {code}" for node, code in trial.codes),
                             "; ".join(trial.recorded), "; ".join(trial.amiss) or "nothing"])
                print(*rows[-1], sep=" | ", flush=True)
    if not part:
        PAGE.write_text(TEXT + table(["what is done", "exit codes", "recorded", "amiss"], rows))


if __name__ == "__main__":
    main(*sys.argv[1:])
