"""The driver with the device's side played by processes: what comes is what the device has."""

import contextlib
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from imu_fusion.errors import INCOMPLETE, ParameterError
from imu_fusion.messages.convert import SAMPLE_TYPES
from imu_fusion.messages.layouts import FIX, IMU, MAG, TWIST
from imu_fusion.nodes.base import message_class
from imu_fusion.nodes.driver import Driver
from imu_fusion.nodes.processes import NodeProcesses
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.sources.source import EPOCH
from test.nodes.devices import TABLE, TEN_MINUTES, truth
from test.nodes.test_processes import ENVIRONMENT
from test.sources.exports import TIME, export
from test.sources.logs import same

ROOT = Path(__file__).resolve().parents[2]
ALL = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE,
                 durability=DurabilityPolicy.VOLATILE)
LAYOUTS = {"imu/data_raw": IMU, "imu/mag": MAG, "fix": FIX, "fix_velocity": TWIST}


class Device:
    """A process of test.nodes.devices; leaving the context ends it."""

    def __init__(self, *arguments):
        self._process = subprocess.Popen(
            [sys.executable, "-m", "test.nodes.devices", *map(str, arguments)], cwd=ROOT, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.address = self._process.stdout.readline().strip()

    def go(self):
        self._process.stdin.write("\n")
        self._process.stdin.flush()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.kill()
        self._process.communicate()


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Listener:
    """Takes all messages of topics."""

    def __init__(self, graph, topics):
        node = graph.node("listener")
        self.messages = {topic: [] for topic in topics}
        self._subscriptions = {topic: node.create_subscription(
            message_class(LAYOUTS[topic].msgtype), topic, self.messages[topic].append, ALL,
            raw=True) for topic in topics}

    def has(self, expected):
        for topic, subscription in self._subscriptions.items():    # an executor takes one a turn
            handle = subscription.handle
            with handle:
                while (taken := handle.take_message(subscription.msg_type, True)) is not None:
                    self.messages[topic].append(taken[0])
        return all(len(self.messages[topic]) >= len(log) for topic, log in expected.items())

    def logs(self):
        return {topic: SAMPLE_TYPES[LAYOUTS[topic].msgtype].read(messages)
                for topic, messages in self.messages.items() if messages}


def start(graph, source, transport, topics, **parameters):
    return graph.start(Driver, source=source, transport=transport, **{
        "qos": "reliable", "wait_for_subscribers": len(topics), "longest_pause": 0.2,
        **parameters})


@pytest.fixture
def description(tmp_path):
    (tmp_path / "table.yaml").write_text(yaml.safe_dump(TABLE))
    return str(tmp_path / "table.yaml")


@pytest.mark.parametrize("kind, arguments, parameters", [
    ("phyphox", [], {}), ("sensor_logger", [free_port], {}), ("ubx", [], {}), ("ximu3", [], {}),
    ("vanishing", [], {}), ("table", [free_port], {"description": True})])
def test_live_is_what_the_export_of_the_device_holds(graph, description, kind, arguments,
                                                     parameters):
    source = "ximu3" if kind == "vanishing" else kind
    expected = truth(kind)
    if parameters:
        parameters = {"description": description}
    listener = Listener(graph, expected)
    with Device(kind, *(make() for make in arguments)) as device:
        driver = start(graph, source, device.address, expected, stamp_source="device_raw",
                       **parameters)
        graph.until(lambda: driver._connections > 0)
        device_asks = kind in ("ubx", "table")
        if device_asks:
            device.go()
        # The last ones of a phone wait for a force, or for a batch that may be missing.
        count = {topic: log[:max(len(log) - 2, 1)] if kind in ("phyphox", "sensor_logger")
                 and topic == "imu/data_raw" else log for topic, log in expected.items()}
        graph.until(lambda: listener.has(count), 60.0)
        found = listener.logs()
    expected = {topic: log[:len(found[topic])] for topic, log in expected.items()}
    if kind == "vanishing":
        assert driver._connections == 2
    assert same(found, expected)
    lost = driver._source.lost
    if kind == "table":    # an open port takes what others send there, DDS of tests beside too
        assert set(lost) <= {"lines that are no text, or ahead of the column names"}, lost
    else:
        assert bool(lost) == (kind in ("ubx", "vanishing")), lost


@pytest.mark.slow
def test_ten_minutes_at_400_hz_lose_nothing_and_give_nothing_twice(graph):
    listener = Listener(graph, ["imu/data_raw"])
    with Device("long") as device:
        driver = start(graph, "ximu3", device.address, ["imu/data_raw"], stamp_source="device_raw")
        for second in range(1, 601):
            graph.until(lambda n=second: listener.has({"imu/data_raw": range(400 * n - 1)}), 30.0)
            device.go()
        graph.until(lambda: listener.has({"imu/data_raw": range(TEN_MINUTES)}), 30.0)
        for _ in range(100):    # nothing follows
            driver.work()
            graph.executor.spin_once(timeout_sec=0.0)
    (log,) = listener.logs().values()
    assert np.array_equal(log.stamp, EPOCH + 2_500_000 * np.arange(TEN_MINUTES))
    assert not driver._source.lost


def test_a_device_that_is_absent_is_waited_for_and_said_once(graph):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    said = []
    watcher = graph.node("watcher")
    watcher.create_subscription(DiagnosticArray, "/diagnostics", said.append, 10)
    driver = graph.start(Driver, source="ximu3", transport=f"tcp://127.0.0.1:{port}",
                         longest_pause=0.2)
    graph.until(lambda: any("refused" in s.message for m in said for s in m.status))
    listener = socket.create_server(("127.0.0.1", port))
    graph.until(lambda: driver._connections > 0)
    connection, _ = listener.accept()
    connection.sendall(b"I,1000,0,0,0,0,0,1\r\n" * 3)
    # The others' watchdog: a TCP connection on which nothing comes, though it stands.
    assert not driver._problem
    connection.close()
    listener.close()


@pytest.mark.parametrize("jump", [0.0, 50.0])
def test_stamps_are_those_of_this_computer_though_the_device_s_clock_is_off(graph, jump):
    listener = Listener(graph, ["imu/data_raw"])
    with Device("clock", 100, 50, jump) as device:
        driver = start(graph, "ximu3", device.address, ["imu/data_raw"])
        graph.until(lambda: len(listener.messages["imu/data_raw"]) >= 250, 60.0)
        log = listener.logs()["imu/data_raw"]
    assert (np.diff(log.stamp) > 0).all()
    assert driver._clocks[""].steps == (1 if jump else 0)
    # The sensor's own account of the time since it began.
    measured = np.degrees(log.gyr[:, 0]) * 1e9
    late = log.stamp - log.stamp[0] - (measured - measured[0])
    assert np.ptp(late) < 0.25e9    # a busy machine is late; an hour or 50 s would be an error


def test_covariances_mean_something_and_diagnostics_name_the_device(graph):
    said = []
    watcher = graph.node("watcher")
    watcher.create_subscription(DiagnosticArray, "/diagnostics", said.append, 10)
    listener = Listener(graph, ["imu/data_raw"])
    with Device("ximu3") as device:
        start(graph, "ximu3", device.address, ["imu/data_raw"], stamp_source="device_raw",
              **{"sensor.gyro_noise_density": 1e-3})
        graph.until(lambda: len(listener.messages["imu/data_raw"]) >= 400 and any(
            s.hardware_id == "x-IMU3" for m in said for s in m.status), 60.0)
    _, _, values = IMU.decode_many(listener.messages["imu/data_raw"])
    cov = values[-1, IMU["angular_velocity_covariance"]]
    assert cov[0] == pytest.approx(1e-6 * 400.0)    # 400 Hz


@pytest.mark.parametrize("answer, words", [
    (b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n", "answers 404 Not Found"),
    (b"HTTP/1.1 200 OK\r\nContent-Length: 4\r\n\r\nhome", "not phyphox's")])
def test_what_is_no_phone_is_one_line_however_often_it_is_asked(graph, capfd, answer, words):
    times = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        def serve():
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = server.accept()
                    times.append(connection)
                    with contextlib.suppress(OSError):
                        while connection.recv(4096):
                            times.append(connection.sendall(answer))

        threading.Thread(target=serve, daemon=True).start()
        driver = start(graph, "phyphox", f"http://127.0.0.1:{server.getsockname()[1]}", [])
        graph.until(lambda: len(times) >= 6 and (driver._problem or driver._said), 60.0)
    said = capfd.readouterr()
    lines = [line for line in (said.out + said.err).splitlines() if "[WARN]" in line]
    assert len(lines) == 1 and words in lines[0], lines
    assert (said.out + said.err).count(": connected") == 1


def test_another_format_is_named(graph, capfd):
    with Device("ubx") as device:
        driver = start(graph, "ximu3", device.address, [])
        graph.until(lambda: driver._connections > 0)
        for _ in range(3):
            device.go()
        graph.until(lambda: driver._said, 60.0)
    assert "u-blox" in driver._said and "ubx" in driver._said and "'ximu3'" in driver._said


@pytest.mark.parametrize("parameters, words", [
    ({}, "transport"), ({"transport": "tcp://x:1", "source": "foo"}, "'foo' cannot be read live"),
    ({"transport": "tcp://x:1"}, "no source is given; there are: phyphox, "),
    ({"transport": "http://x:1", "source": "sensor_logger"}, "comes through http-push://"),
    ({"transport": "http://x:1", "source": "ximu3"}, "comes through serial:// or tcp:// or udp"),
    ({"transport": "gopher://x:1", "source": "ubx"}, "expected serial://"),
    ({"transport": "tcp://x", "source": "ubx"}, "expected tcp://HOST:PORT"),
    ({"transport": "serial:///dev/null?baud=12", "source": "ubx"}, "12 baud"),
    ({"transport": "serial:///dev/null?bad=12", "source": "ubx"}, "'bad' is unknown"),
    ({"transport": "tcp://x:1", "source": "table"}, "needs a description")])
def test_wrong_parameters_are_named(graph, parameters, words):
    with pytest.raises(ParameterError, match=words):
        graph.start(Driver, **parameters)


def test_a_file_is_played_at_its_pace_and_ends(graph, tmp_path):
    for part, data in export(clock="\n".join(TIME.splitlines()[:2])).items():
        (tmp_path / part).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / part).write_bytes(data)
    expected = truth("phyphox")
    listener = Listener(graph, expected)
    driver = start(graph, "", f"file://{tmp_path / 'walk'}", expected, stamp_source="device_raw")
    graph.until(lambda: driver.finished and listener.has(expected), 60.0)
    found = listener.logs()
    assert found["imu/mag"].mag.tobytes() == expected["imu/mag"].mag.tobytes()


def test_driver_estimator_and_recorder_as_processes(tmp_path, monkeypatch):
    """What is recorded is what the device has, and the estimator runs on it."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    expected = truth("ximu3")["imu/data_raw"]
    context, estimates, ready = rclpy.Context(), [], []
    with Device("ximu3") as device, NodeProcesses(tmp_path / "logs") as nodes:
        rclpy.init(context=context, domain_id=nodes.domain)
        watcher = rclpy.create_node("watcher", context=context)
        watcher.create_subscription(Imu, "imu/data", estimates.append, ALL)
        # Readers are announced in order: who answers on the second knows of the first.
        watcher.create_subscription(DiagnosticArray, "/diagnostics", ready.append, ALL)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(watcher)

        def until(condition):
            deadline = time.monotonic() + 300.0
            while not condition():
                assert time.monotonic() < deadline, nodes.log("driver")
                executor.spin_once(timeout_sec=0.1)

        nodes.start("orientation_estimator", qos="reliable")
        nodes.start("recorder", out=str(tmp_path / "out"), topics=["/imu/data_raw"])
        until(lambda: any(status.name.startswith("orientation_estimator")
                          for message in ready for status in message.status))
        nodes.start("driver", source="ximu3", transport=device.address, qos="reliable",
                    stamp_source="device_raw", wait_for_subscribers=3, reconnect=False)
        until(lambda: len(estimates) >= 0.5 * len(expected))
        device.go()
        assert nodes.process("driver").wait(60.0) == INCOMPLETE    # the device has gone
        assert "the device has closed the connection" in nodes.log("driver")
        executor.shutdown()
        watcher.destroy_node()
        rclpy.try_shutdown(context=context)
    with open_bag(tmp_path / "out") as reader:
        assert same({"": read_log(reader, "imu/data_raw")}, {"": expected})


@pytest.mark.parametrize("source, transport", [
    ("ubx", "tcp://127.0.0.1:9"), ("ubx", "udp://127.0.0.1:{port}"),
    ("ubx", "serial:///dev/nowhere"), ("phyphox", "http://127.0.0.1:9"),
    ("sensor_logger", "http-push://127.0.0.1:{port}")])
def test_sigint_ends_it_in_every_state(source, transport):
    command = [sys.executable, "-m", "imu_fusion.cli", "run", "driver", "--ros-args", "-p",
               f"source:={source}", "-p", f"transport:={transport.format(port=free_port())}"]
    process = subprocess.Popen(command, env=ENVIRONMENT | {"PYTHONUNBUFFERED": "1"}, cwd=ROOT,
                               stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    line = process.stdout.readline()
    assert "driver" in line, line
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate(timeout=30)
    assert process.returncode == 130 and "Traceback" not in said, said


def test_a_device_that_is_not_there_is_one_line_and_an_error():
    command = [sys.executable, "-m", "imu_fusion.cli", "run", "driver", "--ros-args", "-p",
               "source:=ubx", "-p", "transport:=tcp://127.0.0.1:9", "-p", "reconnect:=false"]
    done = subprocess.run(command, env=ENVIRONMENT, cwd=ROOT, capture_output=True, text=True,
                          timeout=60, check=False)
    assert done.returncode == 1, done.stderr
    assert done.stderr.splitlines() == ["driver: tcp://127.0.0.1:9: Connection refused"]
