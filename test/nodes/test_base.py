"""Parameters of nodes from dataclasses, and diagnostics."""

import importlib
import math
import subprocess
import sys
from dataclasses import dataclass

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import Parameter, parameter_value_to_python

from imu_fusion.errors import ParameterError, TopicError
from imu_fusion.nodes import NODES
from imu_fusion.nodes.base import Node, message_class, run_node
from imu_fusion.parameters.declare import Parameters, param
from test.nodes.conftest import write_bag


@dataclass(frozen=True)
class Numbers(Parameters):
    gain: float = param(2.0, doc="a factor", unit="m", low=0, high=10, read_only=False)
    window: int = param(3, doc="samples", low=1)
    origin: float | None = param(None, doc="found by itself if unset")
    axis: tuple[float, ...] = param((0.0, 0.0, 1.0), doc="a direction", length=3)
    names: tuple[str, ...] = param((), doc="some names")
    fast: bool = param(False, doc="hurry")


@dataclass(frozen=True)
class Initial(Parameters):
    mode: str = param("still", doc="how to start", choices=("still", "given"))


@dataclass(frozen=True)
class More(Parameters):
    initial: Initial = Initial()


FOUR = {"accelerometers.names": ["a", "b", "c", "d"], "accelerometers.a.position": [0.1, 0.0, 0.0],
        "accelerometers.b.position": [0.0, 0.1, 0.0], "accelerometers.c.position": [0.0, 0.0, 0.1],
        "accelerometers.d.position": [-0.1, -0.1, 0.0]}


def node_class(name):
    module = importlib.import_module(f"imu_fusion.nodes.{name}")
    (found,) = [v for v in vars(module).values() if isinstance(v, type)
                and issubclass(v, Node) and v.__module__ == module.__name__]
    return found


class Example(Node):
    """An example."""

    NAME = "example"
    PARAMETERS = (Numbers, More)


def test_defaults_without_any_parameter(graph):
    node = graph.start(Example)
    assert node.params(Numbers) == Numbers() and node.params(More) == More()
    assert node.get_parameter("gain").value == 2.0
    assert list(node.get_parameter("axis").value) == [0.0, 0.0, 1.0]
    assert node.get_parameter("initial.mode").value == "still"


def test_given_values_of_both_dataclasses(graph):
    node = graph.start(Example, gain=4.5, window=7, axis=[1.0, 0.0, 0.0], names=["a", "b"],
                       fast=True, origin=1.5, **{"initial.mode": "given"})
    assert node.params(Numbers) == Numbers(gain=4.5, window=7, axis=(1.0, 0.0, 0.0),
                                           names=("a", "b"), fast=True, origin=1.5)
    assert node.params(More).initial.mode == "given"
    assert node.get_parameter("origin").value == 1.5


def test_an_integer_is_a_float_where_one_is_wanted(graph):
    """`-p gain:=4` is an integer to rcl."""
    node = graph.start(Example, gain=4, axis=[1, 0, 0])
    assert node.params(Numbers).gain == 4.0 and isinstance(node.params(Numbers).gain, float)
    assert node.get_parameter("gain").type_ == Parameter.Type.DOUBLE
    assert node.params(Numbers).axis == (1.0, 0.0, 0.0)


def test_unset_parameters_have_a_type_and_a_value_that_says_so(graph):
    node = graph.start(Example)
    assert math.isnan(node.get_parameter("origin").value)
    assert node.describe_parameter("origin").type == Parameter.Type.DOUBLE.value
    assert node.get_parameter("names").value == [""]
    assert node.params(Numbers).names == () and node.params(Numbers).origin is None
    again = graph.start(Example, origin=float("nan"), names=[""])
    assert again.params(Numbers) == Numbers()


@pytest.mark.parametrize("name", NODES)
def test_all_parameters_can_be_read_at_once_dumped_and_loaded_back(graph, tmp_path, name):
    """As `ros2 param dump` does it: a request for every name, a file of the answers."""
    cls = node_class(name)
    given = {"bag": str(write_bag(tmp_path / "bag", 3)), "out": str(tmp_path / "out")}
    given = {key: value for key, value in given.items()
             if any(key == info.name for c in cls.PARAMETERS for info in c.infos())}
    if name == "acceleration_field_estimator":
        given |= FOUR
    if name == "driver":
        given |= {"source": "nmea", "transport": "udp://127.0.0.1:0"}
    node = graph.start(cls, **given)
    client = graph.node("reader").create_client(GetParameters, f"/{name}/get_parameters")
    graph.until(client.service_is_ready)
    names = [n for n in node._parameters if not n.startswith(("use_sim", "start_type"))]
    future = client.call_async(GetParameters.Request(names=names))
    graph.until(future.done)
    assert len(future.result().values) == len(names) > 1
    dumped = {n: parameter_value_to_python(v) for n, v in zip(names, future.result().values)}
    dumped = {n: v.tolist() if hasattr(v, "tolist") else v for n, v in dumped.items()}
    file = tmp_path / "dump.yaml"
    file.write_text(yaml.safe_dump({f"/{name}": {"ros__parameters": dumped}}))
    params = {c: node.params(c) for c in cls.PARAMETERS}
    graph.close(node)
    if "out" in given:
        dumped["out"] = str(tmp_path / "other")
        file.write_text(yaml.safe_dump({f"/{name}": {"ros__parameters": dumped}}))
    again = graph.add(cls(params_files=[str(file)], cli_args=[
        "--ros-args", "--params-file", str(file)]))
    for c in cls.PARAMETERS:
        assert {k: v for k, v in again.params(c).to_mapping().items() if k != "out"} == {
            k: v for k, v in params[c].to_mapping().items() if k != "out"}


def test_a_node_takes_the_file_that_launch_ros_makes_of_a_list(graph, tmp_path):
    file = tmp_path / "launch_params_x"
    file.write_text(yaml.dump({"/**": {"ros__parameters": {"axis": (0.0, 1.0, 0.0)}}}))
    node = graph.add(Example(params_files=[str(file)],
                             cli_args=["--ros-args", "--params-file", str(file)]))
    assert node.params(Numbers).axis == (0.0, 1.0, 0.0)


def test_a_calibration_for_every_node_is_passed_by_and_a_slip_is_not(tmp_path):
    file = tmp_path / "magnetometer.yaml"
    arguments = ["--ros-args", "--params-file", str(file)]
    file.write_text("/**: {ros__parameters: {sensor.mag_offset: [0.0, 0.0, 1.0e-6]}}")
    assert run_node(Reader, arguments) == 0
    Reader.seen.pop()
    file.write_text("/**: {ros__parameters: {tehre: zakopane_hs140}}")
    assert run_node(Reader, arguments) == 1


def test_integer_ranges_fit_what_editors_take(graph):
    node = graph.start(Example)
    assert node.describe_parameter("window").integer_range[0].to_value == 2**31 - 1


def test_descriptors_carry_meaning_bounds_and_read_only(graph):
    node = graph.start(Example)
    gain = node.describe_parameter("gain")
    assert gain.description == "a factor [m]" and not gain.read_only
    assert gain.floating_point_range[0].to_value == 10.0
    assert node.describe_parameter("window").read_only
    assert node.describe_parameter("window").integer_range[0].from_value == 1


@pytest.mark.parametrize("given, text", [
    ({"gain": 11.0}, r"'gain' \(from node example\): 11.0 is out of bounds; allowed: 0 to 10 m"),
    ({"gain": "x"}, "'gain'.*'x' is not a number"),
    ({"window": 2.5}, "'window'.*2.5 is not an integer"),
    ({"axis": [1.0, 2.0]}, "'axis'.*has 2 elements"),
    ({"fast": 1}, "'fast'.*1 is not true or false"),
    ({"initial.mode": "x"}, "'initial.mode'.*one of still, given"),
    ({"gian": 1.0}, r"unknown parameter 'gian'; known: .*gain.*\(from node example\)"),
])
def test_bad_values_are_refused_with_name_value_and_bounds(graph, given, text):
    with pytest.raises(ParameterError, match=text):
        graph.start(Example, **given)


def test_changes_at_run_time(graph):
    node = graph.start(Example)
    assert node.set_parameters([Parameter("gain", value=3.0)])[0].successful
    assert node.params(Numbers).gain == 3.0
    refused, = node.set_parameters([Parameter("gain", value=12.0)])
    assert not refused.successful and node.params(Numbers).gain == 3.0
    refused, = node.set_parameters([Parameter("window", value=5)])
    assert not refused.successful and "read-only" in refused.reason
    assert node.params(Numbers).window == 3


def test_use_sim_time_is_left_to_rclpy(graph):
    node = graph.start(Example, use_sim_time=True)
    assert node.get_parameter("use_sim_time").value is True


def test_diagnostics_carry_the_node_and_its_values(graph):
    got = []
    graph.node("monitor").create_subscription(DiagnosticArray, "/diagnostics", got.append, 10)
    node = graph.start(Example)
    node.start_diagnostics("clock", lambda: (b"\1", "late", {"delay": 0.5}))
    graph.until(lambda: got)
    status, = got[0].status
    assert (status.name, status.level, status.message) == ("example: clock", b"\1", "late")
    assert status.hardware_id == "imu_fusion"
    assert [(v.key, v.value) for v in status.values] == [("delay", "0.5")]


def test_message_types_by_name():
    assert message_class("sensor_msgs/msg/Imu").__name__ == "Imu"
    for name in ("sensor_msgs/msg/Nothing", "nowhere_msgs/msg/Imu", "Imu"):
        with pytest.raises(TopicError, match=f"message type {name} is not installed"):
            message_class(name)


@dataclass(frozen=True)
class Places(Parameters):
    here: str = param("", doc="a file", path=True)
    there: str = param("", doc="another file", path=True)


class Reader(Node):
    """Reads files."""

    NAME = "reader"
    PARAMETERS = (Places,)
    seen = []

    def work(self):
        self.seen.append(self.params(Places))
        self.finished = True
        return 0.0


def test_files_named_in_a_parameter_file_are_relative_to_it(tmp_path):
    """Those named on the command line, or without a file of that name beside it, are not."""
    (tmp_path / "hill.yaml").write_text("type: plane")
    first, last = tmp_path / "first.yaml", tmp_path / "last.yaml"
    first.write_text("/ns/reader: {ros__parameters: {here: hill.yaml, there: hill.yaml}}")
    last.write_text("/**: {ros__parameters: {there: zakopane_hs140}}")
    arguments = ["--ros-args", "-r", "__ns:=/ns", "--params-file", str(first)]
    assert run_node(Reader, arguments) == 0
    assert Reader.seen.pop() == Places(str(tmp_path / "hill.yaml"), str(tmp_path / "hill.yaml"))
    assert run_node(Reader, [*arguments, "--params-file", str(last)]) == 0
    assert Reader.seen.pop() == Places(str(tmp_path / "hill.yaml"), "zakopane_hs140")
    assert run_node(Reader, [*arguments, "-p", "here:=elsewhere/hill.yaml"]) == 0
    assert Reader.seen.pop() == Places("elsewhere/hill.yaml", str(tmp_path / "hill.yaml"))


@pytest.mark.parametrize("held, code", [(0, 0), (60, 3)])
def test_a_process_ends_where_native_code_keeps_the_interpreter(held, code):
    """As Fast DDS does where participants leave together: no thread of Python runs any more."""
    found = subprocess.run([sys.executable, "-c", f"""if True:
        import ctypes
        from imu_fusion.nodes.ending import ends_within
        print("said before")
        with ends_within(1, 3):
            ctypes.PyDLL(None).sleep({held})
        """], check=False, capture_output=True, text=True, timeout=50)
    assert (found.returncode, found.stdout.strip(), found.stderr) == (code, "said before", "")
