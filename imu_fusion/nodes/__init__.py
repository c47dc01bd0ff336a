"""ROS 2 nodes: thin adapters that decode, call an estimator and encode.

The list of executables below is the only one: setup.py, ``imu_fusion run --help``, the tables of
the documentation and the tests read it. Nothing is imported here that is not there before the
package is installed.
"""

from typing import NamedTuple


class Executable(NamedTuple):
    """A module of this package with ``main(args)``: a node that can be started.

    ``summary``: the first line of the node's docstring; ``services``: names of its own
    (std_srvs/Trigger), below the name of the node.
    """

    summary: str
    services: tuple[str, ...] = ()


NODES = {
    "replayer": Executable("Play a recording on its topics.", ("pause", "resume", "step")),
    "driver": Executable("Samples of a device, live or from its file, on the standard topics."),
    "recorder": Executable("Record topics into a rosbag2 MCAP directory."),
    "orientation_estimator": Executable(
        "Orientation from imu/data_raw and imu/mag, published on imu/data.",
        ("reset", "set_heading", "calibrate_magnetometer")),
    "smoother": Executable(
        "Trajectory from imu/data_raw, imu/mag, fix and fix_velocity, when smoother/smooth is "
        "called.", ("smooth", "clear")),
    "acceleration_field_estimator": Executable(
        "Acceleration field of a rigid body from accelerometers/<name> (and imu/data_raw).",
        ("reset", "smooth"))}
