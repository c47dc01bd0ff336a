"""What all nodes share: parameters from dataclasses, diagnostics, start and orderly end."""

import gc
import importlib
import math
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

import rclpy
import rclpy.node
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from imu_fusion.errors import INCOMPLETE, ImuFusionError, ParameterError, TopicError
from imu_fusion.kernels import is_compiling
from imu_fusion.messages.transforms import TF_TYPE
from imu_fusion.nodes import NODES
from imu_fusion.nodes.ending import ends_within
from imu_fusion.nodes.flow import steady_timer
from imu_fusion.parameters import file as parameter_file
from imu_fusion.parameters.declare import ParameterInfo, Parameters, unknown_parameter
from imu_fusion.signals import Interrupted, came, exit_code, handled, interrupt

P = TypeVar("P", bound=Parameters)

_WIDE = 2**31 - 1  # of a side without a bound: editors of parameters take no more
FAREWELL = 2.0  # s, in which a node that was asked to stop ends its session
LEAVING = 5  # s, in which it leaves the middleware
IDLE = 0.2  # s, the longest wait of the executor: how late a signal is noticed

# Parameters that belong to rclpy, not to us.
_FOREIGN = ("use_sim_time", "start_type_description_service", "qos_overrides.")
# Groups that a calibration gives to every node (/**): one without that sensor passes by.
_OF_SENSORS = ("sensor.", "calibration.")


def message_class(msgtype: str) -> type:
    """The Python class of 'package/msg/Name'.

    Raises:
        TopicError: no such type is installed.
    """
    try:
        package, kind, name = msgtype.split("/")
        return getattr(importlib.import_module(f"{package}.{kind}"), name)
    except (ImportError, AttributeError, ValueError):
        raise TopicError(f"message type {msgtype} is not installed here; install the ROS package "
                         f"'{msgtype.split('/')[0]}' or leave its topics out") from None


def output_class(msgtype: str) -> type:
    """As :func:`message_class`, of an output.

    Raises:
        ParameterError: that of /tf is not installed; names the parameter that asks for it.
    """
    try:
        return message_class(msgtype)
    except TopicError:
        if msgtype != TF_TYPE:
            raise
        raise ParameterError("parameter 'publish_tf': true needs tf2_msgs, which is not here; with "
                             "an apt ROS: apt install ros-jazzy-tf2-msgs, else set publish_tf "
                             "false (imu_fusion process writes /tf without it)") from None


def descriptor(info: ParameterInfo) -> ParameterDescriptor:
    """The rcl_interfaces ParameterDescriptor of a ParameterInfo."""
    text = f"{info.doc} [{info.unit}]" if info.unit else info.doc
    result = ParameterDescriptor(name=info.name, description=text, read_only=info.read_only,
                                 additional_constraints=info.describe_bounds())
    # No range where a value outside of it says "unset".
    bounded = (info.low is not None or info.high is not None) and info.unset is None
    if bounded and not info.is_tuple and info.element is float:
        result.floating_point_range = [FloatingPointRange(
            from_value=float("-inf") if info.low is None else float(info.low),
            to_value=float("inf") if info.high is None else float(info.high))]
    elif bounded and not info.is_tuple and info.element is int:
        result.integer_range = [IntegerRange(
            from_value=-_WIDE if info.low is None else int(info.low),
            to_value=_WIDE if info.high is None else int(info.high), step=1)]
    return result


class Node(rclpy.node.Node):
    """Base of our nodes.

    Class attributes: ``NAME`` and ``PARAMETERS``, a tuple of Parameters dataclasses, and
    ``OPEN_PREFIXES``: parameters below these need not be known, ``open_parameters`` holds them.
    Other unknown parameters, wrong types and values out of bounds raise ParameterError.

    Args:
        params_files: the parameter files that rclpy was given: relative file names in them
            are relative to them.
    """

    NAME: str = ""
    PARAMETERS: tuple[type[Parameters], ...] = ()
    OPEN_PREFIXES: tuple[str, ...] = ()
    _flow: Any = None  # a Flow, if the node takes part in sessions

    def __init__(self, params_files: Sequence[str] = (), **kwargs):
        super().__init__(self.NAME, automatically_declare_parameters_from_overrides=True,
                         **kwargs)
        self.finished = False
        self.problems: list[str] = []  # texts: why the exit code is INCOMPLETE
        try:
            self._params = self._declare(params_files)
            self.add_on_set_parameters_callback(self._on_set_parameters)
            self._set_up()
        except BaseException:
            self.destroy_node()  # else others see it until its memory is freed
            raise

    def _set_up(self) -> None:
        """What the node does before it runs; if it raises, nothing of it stays in the graph."""

    def params(self, cls: type[P]) -> P:
        """The present values of one of the node's PARAMETERS dataclasses."""
        return cast(P, self._params[cls])

    def work(self) -> float:
        """Called between callbacks; returns the seconds that the executor may wait."""
        return IDLE

    def wait(self, executor: Executor, seconds: float) -> None:
        """Let callbacks run, or wait for one, at most so long."""
        if self._flow is None:
            executor.spin_once(timeout_sec=seconds)
        else:
            self._flow.wait(executor, seconds)

    def stop(self) -> None:
        """Asked to end (signal): do what is needed until ``finished`` is true; not for long."""
        self.finished = True

    def close(self) -> None:
        """Release files; called once, whatever happened."""

    def start_diagnostics(self, task: str, status: Callable[
            [], tuple[bytes, str, Mapping[str, object]]],
            hardware: Callable[[], str] = lambda: "imu_fusion") -> None:
        """Publish ``status() -> (level, message, {key: value})`` on `/diagnostics` at 1 Hz, as
        diagnostic_updater would: named ``node: task``, for what ``hardware()`` names."""
        publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)

        def publish():
            level, message, values = status()
            array = DiagnosticArray(status=[DiagnosticStatus(
                level=level, name=f"{self.get_fully_qualified_name().lstrip('/')}: {task}",
                message=message, hardware_id=hardware(),
                values=[KeyValue(key=k, value=str(v)) for k, v in values.items()])])
            array.header.stamp = self.get_clock().now().to_msg()
            publisher.publish(array)

        steady_timer(self, 1.0, publish)

    def offer(self, name: str, action: Callable[[], str]) -> None:
        """Offer the service ``~/name`` (std_srvs/Trigger): it answers what ``action()`` returns, or
        the reason why it raised an ImuFusionError."""
        def answer(_, response):
            try:
                response.message, response.success = action(), True
            except ImuFusionError as error:
                response.message = str(error)
            return response

        self.create_service(Trigger, f"~/{name}", answer)

    def _declare(self, params_files):
        # rclpy has declared what was given, with the type that it was given in. Take it
        # back, and declare everything in the type of the dataclass.
        given = {}
        for name, parameter in self.get_parameters_by_prefix("").items():
            if not name.startswith(_FOREIGN):
                value = cast(Parameter, parameter).value
                given[name] = value.tolist() if hasattr(value, "tolist") else value
                self.undeclare_parameter(name)
        known = {info.name: info for cls in self.PARAMETERS for info in cls.infos()}
        self.open_parameters = {name: given.pop(name) for name in list(given)
                                if name not in known and name.startswith(self.OPEN_PREFIXES)}
        for name, value in self.open_parameters.items():
            self.declare_parameter(name, value, ParameterDescriptor(read_only=True))
        for_all = parameter_file.names_for_all(params_files)
        given = {name: value for name, value in given.items() if name in known
                 or not (name.startswith(_OF_SENSORS) and name in for_all)}
        unknown = sorted(given.keys() - known.keys())
        if unknown:
            raise ParameterError(f"{unknown_parameter(unknown[0], self.PARAMETERS)} "
                                 f"(from node {self.get_name()})")
        parameter_file.resolve_paths(given, self.PARAMETERS, self.get_name(), params_files)
        values: dict[type[Parameters], Parameters] = {}
        for cls in self.PARAMETERS:
            own: dict[str, object] = {}
            for info in cls.infos():
                if given.get(info.name) is not None:
                    own[info.name] = given[info.name]
            values[cls] = cls.from_mapping(own, source=f"node {self.get_name()}")
            for info in cls.infos():
                value = values[cls].get(info.name)
                # A parameter without a value would make a request for all of them fail.
                value = info.unset if value is None or value == () else value
                self.declare_parameter(info.name, list(value) if info.is_tuple else value,
                                       descriptor(info), ignore_override=True)
        return values

    def _on_set_parameters(self, parameters):
        changed = dict(self._params)
        for parameter in parameters:
            for cls in self.PARAMETERS:
                if any(info.name == parameter.name for info in cls.infos()):
                    try:
                        changed[cls] = changed[cls].replace(
                            **{parameter.name: parameter.value})
                    except ParameterError as error:
                        return SetParametersResult(successful=False, reason=str(error))
        try:
            self.apply(changed)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self._params = changed
        return SetParametersResult(successful=True)

    def apply(self, params: Mapping[type[Parameters], Parameters]) -> None:
        """Parameters are about to change to ``params`` (class to object); may refuse."""


def run_node(node_class: type[Node], args: Sequence[str] | None = None) -> int:
    """The main() of a node.

    Runs until the node is finished or SIGINT, SIGTERM, SIGHUP or a shutdown of the context
    arrives; a second signal ends it at once.

    Returns:
        Exit code: 0 after an orderly end, INCOMPLETE if something was lost, 130, 143 or 129 after a
        signal, 1 after an error, which is printed in one line.
    """
    arguments = sys.argv if args is None else ["", *args]
    try:
        own = rclpy.utilities.remove_ros_args(arguments)[1:]
    except Exception as error:
        if type(error).__module__.startswith("rclpy"):  # e.g. a malformed --params-file
            return _complain(node_class, " ".join(str(error).split()))
        raise
    if own in (["--help"], ["-h"]):
        print(usage(node_class))
        return 0
    if own:
        return _complain(node_class, f"unexpected argument '{own[0]}'; parameters are given as "
                         "--ros-args -p name:=value (see --help)")

    def take(number, frame):
        if is_compiling():
            interrupt(number)    # numba would go on for a minute
        came.append(number)

    try:
        with handled(take):
            code = _start(node_class, arguments)
    except Interrupted as error:
        return error.code
    return exit_code(came[0]) if came else code


def _start(node_class, arguments):
    try:
        # Our own handlers: rclpy's would close the context before the node can end its
        # session and its files.
        use_fast_heartbeats()
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        files = [file for flag, file in zip(arguments, arguments[1:]) if flag == "--params-file"]
        return _run(node_class, files)
    except ImuFusionError as error:
        return _complain(node_class, error)
    except Exception as error:
        if type(error).__module__.startswith("rclpy"):  # e.g. malformed --ros-args
            return _complain(node_class, " ".join(str(error).split()))
        raise
    finally:
        rclpy.try_shutdown()


def use_fast_heartbeats() -> None:
    """Let Fast DDS notice lost messages soon, unless the user has profiles of their own."""
    if not {"FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"} & os.environ.keys():
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(
            Path(__file__).parent / "flow" / "fastdds.xml")


def _run(node_class, params_files):
    node = node_class(params_files=params_files)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    gc.freeze()  # to look through all that was imported would stop a live node for 80 ms
    deadline = math.inf
    try:
        while (rclpy.ok() and not node.finished and len(came) < 2
               and time.monotonic() < deadline):
            if came and deadline == math.inf:
                deadline = time.monotonic() + FAREWELL
                node.stop()
            else:
                node.wait(executor, node.work())
    except ExternalShutdownException:
        pass
    finally:
        try:
            node.close()
        finally:
            executor.shutdown()
            code = INCOMPLETE if node.problems else 0
            with ends_within(LEAVING, exit_code(came[0]) if came
                             else 1 if sys.exc_info()[0] else code):
                node.destroy_node()
    return code


def usage(node_class: type[Node]) -> str:
    """The text of --help: what the node does, its services and its parameters."""
    lines = [(node_class.__doc__ or "").strip().partition("\n")[0], "",
             f"usage: {node_class.NAME} [--ros-args -p NAME:=VALUE ... -r FROM:=TO ...]", ""]
    if node_class.NAME in NODES and NODES[node_class.NAME].services:
        lines += ["services (std_srvs/Trigger): " + ", ".join(
            f"~/{service}" for service in NODES[node_class.NAME].services), ""]
    lines.append("parameters:")
    for cls in node_class.PARAMETERS:
        for info in cls.infos():
            default = "unset" if info.default is None else info.default
            notes = "; ".join(filter(None, [info.unit, info.describe_bounds()]))
            lines.append(f"  {info.name} = {default}" + (f" [{notes}]" if notes else ""))
            lines.append(f"      {info.doc}")
    return "\n".join(lines)


def _complain(node_class, error):
    print(f"{node_class.NAME}: {error}", file=sys.stderr)
    return 1
