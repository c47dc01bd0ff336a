"""The nodes as processes: signals, kill -9, exit codes, messages of user errors."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from sensor_msgs.msg import Imu

from imu_fusion.kernels import NOTICE
from imu_fusion.messages.convert import imu_message
from imu_fusion.nodes import processes
from imu_fusion.nodes.flow import END, Flow
from imu_fusion.nodes.pipeline import run_pipeline
from imu_fusion.nodes.processes import NodeProcesses
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.losses import read_losses
from test.nodes.conftest import START, STEP, collector, write_bag
from test.nodes.test_smoother import write

SCRIPTS = Path(sys.executable).parent
# Killed processes leave shared memory behind; over UDP there is nothing to leave.
ENVIRONMENT = {**os.environ, "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}


def start(node, **parameters):
    command = [SCRIPTS / node, "--ros-args"]
    for name, value in parameters.items():
        command += ["-p", f"{name}:={value}"]
    return subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE,
                            stderr=subprocess.STDOUT, text=True)


def end(process):
    said, _ = process.communicate(timeout=60)
    assert "XMLPARSER" not in said, said  # Fast DDS does not understand nodes/flow/fastdds.xml
    return process.returncode, said


def test_replay_through_processes_ends_by_itself_and_says_what_it_sent(bag, tmp_path):
    recorder = start("recorder", out=tmp_path / "out")
    replayer = start("replayer", bag=bag, rate="0.0", wait_for_nodes="[recorder]",
                     wait_for_subscribers=0)
    code, said = end(replayer)
    assert code == 0 and "/imu/data_raw: 200 messages to /recorder" in said, said
    code, said = end(recorder)
    assert code == 0 and "/imu/mag: 50 messages\n" in said, said
    with open_bag(tmp_path / "out") as reader:
        assert reader.topics["/imu/data_raw"].count == 200 and not reader.warnings


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_closes_the_recording_with_all_that_was_taken(graph, tmp_path, number):
    out = tmp_path / "out"
    recorder = start("recorder", out=out, topics="[/imu/data_raw]")
    flow = Flow(graph.node("talker"), listens=False, wait_for=["recorder"])
    output = flow.output(Imu, "/imu/data_raw")
    flow.source.begin()
    graph.until(flow.source.is_settled)
    for i in range(250):
        output.publish(imu_message(START + i * STEP, "imu_link", (0, 0, 0), (i, 0, 0)))
    graph.until(lambda: flow.source.taken("/imu/data_raw") == 250)
    recorder.send_signal(number)
    code, said = end(recorder)
    assert code == 128 + number and "Traceback" not in said, said
    with open_bag(out) as reader:
        assert not reader.warnings and reader.topics["/imu/data_raw"].count == 250
    graph.until(lambda: not flow.peers)  # it has said good-bye
    assert flow.problems == ["/recorder has left in mid-session"]


def test_signal_to_the_replayer_ends_its_session(graph, bag):
    sink = collector(graph)
    # Named, so that it is waited for: else a signal may come before the replayer has seen it.
    replayer = start("replayer", bag=bag, rate="0.01", wait_for_nodes="[collector]")
    graph.until(lambda: sink.messages["/imu/data_raw"])
    replayer.send_signal(signal.SIGINT)
    graph.until(lambda: sink.ended == [END])
    assert end(replayer)[0] == 130


def test_kill_9_of_the_recorder_leaves_all_closed_chunks(graph, tmp_path):
    """Incompressible chunks of 16 KiB: about 45 messages each; at most one is lost."""
    out = tmp_path / "out"
    recorder = start("recorder", out=out, topics="[/imu/data_raw]", chunk_size=16384,
                     compression="none")
    publisher = graph.node("talker").create_publisher(Imu, "/imu/data_raw", 1000)
    graph.until(lambda: publisher.get_subscription_count() == 1)
    sent = 0
    file = out / "out_0.mcap"
    while file.stat().st_size < 200_000:  # a dozen closed chunks
        publisher.publish(imu_message(START + sent * STEP, "imu_link", (0, 0, 0), (sent, 0, 0)))
        sent += 1
        graph.executor.spin_once(timeout_sec=0.001)
    recorder.kill()
    recorder.wait(timeout=30)
    recorder.stdout.close()
    assert not (out / "metadata.yaml").exists()
    with open_bag(out) as reader:
        assert "not closed properly" in reader.warnings[0]
        found = [m[3] for m in reader.messages()]
    assert len(found) >= 200_000 // 400
    assert len({len(m) for m in found}) == 1


@pytest.mark.parametrize("node, parameters, text", [
    ("replayer", {"bag": "/nowhere/bag"}, "replayer: /nowhere/bag: no such file"),
    ("replayer", {"bag": "/nowhere", "rte": "2.0"}, "unknown parameter 'rte'"),
    ("recorder", {"out": "/proc/x/y"}, "recorder: /proc/x/y: cannot be written"),
])
def test_user_errors_are_one_line_and_exit_code_1(node, parameters, text):
    code, said = end(start(node, **parameters))
    assert code == 1 and text in said and len(said.strip().splitlines()) == 1, said


def test_help_lists_the_parameters_and_wrong_arguments_are_refused():
    done = subprocess.run([SCRIPTS / "replayer", "--help"], env=ENVIRONMENT,
                          capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0 and "rate = 1.0 [at least 0]" in done.stdout
    assert "~/pause, ~/resume, ~/step" in done.stdout
    done = subprocess.run([SCRIPTS / "replayer", "my.bag"], env=ENVIRONMENT,
                          capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1 and "unexpected argument 'my.bag'" in done.stderr


def test_kernels_are_compiled_before_any_node_starts(tmp_path, monkeypatch, capsys):
    """Visibly, and Ctrl-C ends it."""
    def interrupted(say):
        say("compiling for this machine")
        raise KeyboardInterrupt

    monkeypatch.setattr(processes, "compile_ahead", interrupted)
    started = []
    monkeypatch.setattr(NodeProcesses, "start", lambda self, node, **_: started.append(node))
    with pytest.raises(KeyboardInterrupt):
        run_pipeline(write(tmp_path / "bag", 20), tmp_path / "out")
    assert not started and capsys.readouterr().err == "compiling for this machine\n"


def test_a_node_closes_its_files_when_asked_to_end(tmp_path, monkeypatch, capsys):
    """A recorder without a session never ends by itself. What nodes say into their logs while
    they compile is passed on."""
    monkeypatch.setattr(processes, "compile_ahead", lambda say: None)
    with NodeProcesses(tmp_path / "logs") as nodes:
        nodes.start("recorder", out=str(tmp_path / "bag"))
        deadline = time.monotonic() + 30.0
        while not (tmp_path / "bag" / "bag_0.mcap").exists():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        with open(tmp_path / "logs" / "recorder.log", "a") as log:
            log.write(f"[INFO] [recorder]: {NOTICE}\n")
        nodes.process("recorder").send_signal(signal.SIGINT)
        with pytest.raises(processes.NodeError, match="recorder ended with code 130"):
            nodes.wait("recorder", 15.0)
    assert capsys.readouterr().err == NOTICE + "\n"
    assert (tmp_path / "bag" / "metadata.yaml").exists()


def test_each_group_of_nodes_has_a_domain_of_its_own(tmp_path):
    """Also before any of their nodes is seen."""
    groups = [NodeProcesses(tmp_path) for _ in range(3)]
    assert len({group.domain for group in groups}) == 3


def recorded(path):
    """{topic: number of messages}."""
    with open_bag(path) as reader:
        return {topic: info.count for topic, info in reader.topics.items()}


@pytest.mark.slow
def test_a_long_lived_estimator_loses_nothing_of_short_recordings(bag, tmp_path):
    """One after the other, with a new replayer and a new recorder under the names of the last."""
    estimator = start("orientation_estimator")
    found = []
    for i in range(6):
        recorder = start("recorder", out=tmp_path / f"out{i}")
        replayer = start("replayer", bag=bag, rate="0.0",
                         wait_for_nodes="[recorder, orientation_estimator]")
        for process in (replayer, recorder):
            code, said = end(process)
            assert code == 0, said
        found.append(recorded(tmp_path / f"out{i}"))
    estimator.send_signal(signal.SIGINT)
    code, said = end(estimator)
    assert code == 130, said
    assert found[0]["/imu/data_raw"] == 200 and found[0]["/imu/mag"] == 50
    assert found[0]["/imu/data"] > 100 and found[0]["/imu/flags"] > 0
    for other in found[1:]:
        assert {t: n for t, n in other.items() if t != "/diagnostics"} == {
            t: n for t, n in found[0].items() if t != "/diagnostics"}


def runs(process):
    """Whether a process still runs; it must."""
    assert process.poll() is None, end(process)
    return True


@pytest.mark.slow
def test_a_killed_estimator_that_is_started_again_stalls_nothing(graph, tmp_path):
    """What is missing is said by all that know of it, and stands in the recording."""
    bag, out = write_bag(tmp_path / "bag", 1500), tmp_path / "out"
    recorder = start("recorder", out=out)
    first = start("orientation_estimator")
    sink = collector(graph, topics={"/imu/data": Imu})
    replayer = start("replayer", bag=bag, rate="1.0",
                     wait_for_nodes="[recorder, orientation_estimator]")
    graph.until(lambda: runs(first) and len(sink.messages["/imu/data"]) > 50)
    sink.flow.close()
    graph.remove(graph.nodes[-1])
    first.kill()
    first.communicate()
    again = start("orientation_estimator")
    code, said = end(replayer)
    assert code == 3 and "/orientation_estimator has vanished in mid-session" in said, said
    code, said = end(recorder)
    assert code == 3 and "the session of /orientation_estimator broke off" in said, said
    again.send_signal(signal.SIGINT)
    code, said = end(again)
    assert code == 130 and "joined /replayer late" in said, said
    counts = recorded(out)
    assert counts["/imu/data_raw"] == 1500 and counts["/imu/mag"] == 375
    with open_bag(out) as reader:
        lines = read_losses(reader)
    assert any("broke off" in line for line in lines)
    assert any("incomplete data: it lacks at least" in line for line in lines)
    assert "/imu/data_raw: 1500 messages" in lines


@pytest.mark.slow
def test_the_recorder_ends_when_its_source_was_killed_and_says_so(graph, bag, tmp_path):
    out = tmp_path / "out"
    recorder = start("recorder", out=out)
    sink = collector(graph)
    replayer = start("replayer", bag=bag, rate="0.1", wait_for_nodes="[recorder]")
    graph.until(lambda: len(sink.messages["/imu/data_raw"]) > 20)
    replayer.kill()
    replayer.communicate()
    code, said = end(recorder)
    assert code == 3 and "the session of /replayer broke off: it has vanished" in said, said
    graph.until(lambda: sink.ended)
    done = subprocess.run([SCRIPTS / "imu_fusion", "info", out], env=ENVIRONMENT,
                          capture_output=True, text=True, timeout=60, check=False)
    assert "warning: the session of /replayer broke off" in done.stdout, done
    assert recorded(out)["/imu/data_raw"] > 20


def test_logs_of_a_failure_stay_and_those_of_a_success_do_not(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(processes, "compile_ahead", lambda say: None)
    with NodeProcesses():
        assert len(list(tmp_path.iterdir())) == 1
    assert not list(tmp_path.iterdir())
    with pytest.raises(processes.NodeError, match="logs: ") as failure, NodeProcesses() as nodes:
        nodes.start("replayer", bag=str(tmp_path / "none"))
        nodes.wait("replayer", 120)
    (folder,) = tmp_path.iterdir()
    assert str(folder) in str(failure.value) and "no such file" in str(failure.value)
    assert "no such file" in (folder / "replayer.log").read_text()
