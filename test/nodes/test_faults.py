"""What is done to real processes of the nodes: benchmarks.faults, situation by situation."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks import faults
from imu_fusion.kernels import NOTICE
from imu_fusion.nodes.processes import NodeProcesses
from imu_fusion.recordings.bag_reader import open_bag

QUICK = ("disk full", "a recording where none can be")


@pytest.mark.parametrize("name", [
    name if name in QUICK else pytest.param(name, marks=pytest.mark.slow)
    for name in faults.SITUATIONS])
def test_nothing_is_lost_in_silence(tmp_path, monkeypatch, name):
    monkeypatch.setattr(faults, "STOPPED", 8.0)    # longer than a lease
    faults.write_bag(tmp_path / "bag")
    trial = faults.try_out(faults.SITUATIONS[name], tmp_path / "trial")
    assert not trial.amiss, trial


def children_of(pid):
    """Processes below one, as far down as they go."""
    found = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in task.read_text().split():
            found += [int(child), *children_of(int(child))]
    return found


def is_alive(pid):
    """Whether it runs, and is none that its parent has not looked after."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def until(condition, process):
    """Wait for an event in the life of a process."""
    deadline = time.monotonic() + 120.0
    while not condition():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)


COMMANDS = {
    "demo": ("demo", "orientation", "--out", "{tmp}/demo"),
    "pipeline": ("pipeline", "{tmp}/bag", "{tmp}/out"),
    "play": ("play", "{tmp}/bag", "--rate", "0.01", "--ros-args", "-p", "wait_for_subscribers:=0"),
    "record": ("record", "{tmp}/out")}
STAGES = {
    "start": lambda process, tmp: time.sleep(0.4),
    "imports": lambda process, tmp: time.sleep(1.2),
    "children": lambda process, tmp: until(lambda: children_of(process.pid), process),
    "work": lambda process, tmp: until(lambda: len(children_of(process.pid)) >= 3, process)}


ENDING = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]    # one handler: each where its turn is


@pytest.mark.slow
@pytest.mark.parametrize("command, stage, number", [
    (*place, ENDING[k % 3]) for k, place in enumerate([
        *((command, stage) for command in COMMANDS for stage in ("start", "imports")),
        ("demo", "children"), ("demo", "work"), ("pipeline", "children"), ("pipeline", "work")])])
def test_signals_end_every_command_at_every_stage(tmp_path, command, stage, number):
    faults.write_bag(tmp_path / "bag")
    arguments = [word.format(tmp=tmp_path) for word in COMMANDS[command]]
    process = subprocess.Popen([sys.executable, "-m", "imu_fusion.cli", *arguments], text=True,
                               stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    STAGES[stage](process, tmp_path)
    children = children_of(process.pid)
    process.send_signal(number)
    said, _ = process.communicate(timeout=60)
    # Before Python runs a line of ours the signal itself ends it: for a shell the same.
    assert process.returncode in (128 + number, -number), said
    assert "Traceback" not in said or process.returncode == -number, said
    assert not any(is_alive(child) for child in children)
    if command == "record" and (tmp_path / "out").exists():
        with open_bag(tmp_path / "out") as reader:
            assert not reader.warnings
    if command == "pipeline":
        assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_signal_ends_a_pipeline_that_compiles(tmp_path):
    faults.write_bag(tmp_path / "bag")
    process = subprocess.Popen(
        [sys.executable, "-m", "imu_fusion.cli", "pipeline", tmp_path / "bag", tmp_path / "out"],
        text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")})
    assert process.stdout.readline() == f"{NOTICE}\n"
    until(lambda: len(children_of(process.pid)) >= 3, process)
    children = children_of(process.pid)
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM
    assert not any(is_alive(child) for child in children)


@pytest.mark.slow
def test_a_replayer_whose_recorder_has_died_does_not_play_on(tmp_path):
    faults.write_bag(tmp_path / "bag")
    with NodeProcesses(tmp_path / "logs") as nodes:
        trial = faults.Trial(tmp_path / "trial", nodes)
        nodes.start("recorder", out=str(trial.out), chunk_size=4096)
        nodes.start("replayer", bag=str(tmp_path / "bag"), rate=0.02, wait_for_nodes=("recorder",))
        trial.until(lambda: faults.size_of(trial.out) > 10_000)
        trial.end("recorder", number=signal.SIGKILL)
        trial.end("replayer")    # four hundred seconds before its time
    assert trial.codes == [("recorder", -9), ("replayer", 3)] and not trial.amiss


@pytest.mark.parametrize("command", ["pipeline", pytest.param("demo", marks=pytest.mark.slow)])
def test_kill_9_of_a_command_ends_what_it_has_started(tmp_path, command):
    faults.write_bag(tmp_path / "bag")
    arguments = [word.format(tmp=tmp_path) for word in COMMANDS[command]]
    process = subprocess.Popen([sys.executable, "-m", "imu_fusion.cli", *arguments],
                               stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    until(lambda: len(children_of(process.pid)) >= 3, process)
    children = children_of(process.pid)
    process.kill()
    process.wait()
    deadline = time.monotonic() + 120.0
    while any(is_alive(child) for child in children):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert not (tmp_path / "out").exists()    # and nothing of a recording that is not whole


SWALLOWED = """
import signal, sys
from imu_fusion import nodes
from imu_fusion.signals import came
came.append(signal.SIGTERM)    # raised where an exception is not heard of, such as in a destructor
sys.exit(nodes.main(["--ros-args", "-p", f"bag:={sys.argv[1]}"], "replayer"))
"""


def test_a_signal_on_the_way_to_the_node_is_not_forgotten(tmp_path):
    faults.write_bag(tmp_path / "bag", 20)
    done = subprocess.run([sys.executable, "-c", SWALLOWED, tmp_path / "bag"], timeout=120,
                          capture_output=True, text=True, check=False)
    assert done.returncode == 128 + signal.SIGTERM, done
