"""ROS 2 nodes: thin adapters that decode, call an estimator and encode.

The list of executables below is the only one: setup.py, ``imu_fusion run --help``, the tables of
the documentation and the tests read it. Nothing is imported here that is not there before the
package is installed.
"""

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple


class Executable(NamedTuple):
    """A node that can be started: ``node`` is its class in the module of its name.

    ``summary``: the first line of the node's docstring; ``services``: names of its own
    (std_srvs/Trigger), below the name of the node.
    """

    node: str
    summary: str
    services: tuple[str, ...] = ()


NODES = {
    "replayer": Executable(
        "Replayer", "Play a recording on its topics.", ("pause", "resume", "step")),
    "driver": Executable(
        "Driver", "Samples of a device, live or from its file, on the standard topics."),
    "recorder": Executable("Recorder", "Record topics into a rosbag2 MCAP directory."),
    "orientation_estimator": Executable(
        "OrientationEstimatorNode",
        "Orientation from imu/data_raw and imu/mag, published on imu/data.",
        ("reset", "set_heading", "calibrate_magnetometer")),
    "smoother": Executable(
        "SmootherNode", "Trajectory from imu/data_raw, imu/mag, fix and fix_velocity, when "
        "smoother/smooth is called.", ("smooth", "clear")),
    "acceleration_field_estimator": Executable(
        "AccelerationFieldEstimatorNode",
        "Acceleration field of a rigid body from accelerometers/<name> (and imu/data_raw).",
        ("reset", "smooth"))}


def main(args: Sequence[str] | None = None, name: str = "") -> int:
    """Entry point of every executable: start the node that has its name; returns the exit code."""
    from imu_fusion.signals import Interrupted, came, end_with_parent, interruptible
    name = name or Path(sys.argv[0]).stem
    try:
        with interruptible():    # from here on: importing takes a second
            end_with_parent()
            module = importlib.import_module(f"imu_fusion.nodes.{name}")
            base = importlib.import_module("imu_fusion.nodes.base")
            return base.run_node(getattr(module, NODES[name].node), args)
    except Interrupted as signal:
        return signal.code
    finally:    # not before: what came while this was on its way here is seen by the node
        came.clear()
