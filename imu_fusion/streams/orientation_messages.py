"""What the orientation estimator publishes: its rows as messages."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.estimation.orientation.rows import FLAG_STILL
from imu_fusion.geometry.rotation import quat_exp, quat_rotate
from imu_fusion.geometry.rotation_arrays import in_sensor_axes, turned_by
from imu_fusion.messages.convert import bool_message, orientation_messages, rpy_messages
from imu_fusion.messages.layouts import BOOL_TYPE, IMU, TWIST, VECTOR3
from imu_fusion.messages.orientation_status import (
    FLAGS_TYPE,
    bias_message,
    flags_message,
    lasting_flags,
)
from imu_fusion.messages.transforms import TF_TOPIC, TF_TYPE, transform_messages
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.sensors.linear_calibration import SensorCalibration
from imu_fusion.streams.stream import Messages

ORIENTATION_TOPIC = "imu/data"
RPY_TOPIC = "imu/rpy/filtered"
STEADY_TOPIC = "imu/steady_state"
FLAGS_TOPIC = "imu/flags"
BIAS_TOPIC = "imu/gyro_bias"
SMOOTHED_TOPIC = "imu/data_smoothed"

OUTPUTS = {ORIENTATION_TOPIC: IMU.msgtype, RPY_TOPIC: VECTOR3.msgtype, STEADY_TOPIC: BOOL_TYPE,
           FLAGS_TOPIC: FLAGS_TYPE, BIAS_TOPIC: TWIST.msgtype, SMOOTHED_TOPIC: IMU.msgtype}

_UP = {"enu": 1.0, "nwu": 1.0, "ned": -1.0}  # z of the world frame's up
_BIAS_INTERVAL = 100_000_000  # ns; a bias does not change faster


@dataclass(frozen=True)
class OrientationOutputParams(Parameters):
    """What surrounds the estimator: samples before it, its orientation before it is published."""

    remove_gravity_vector: bool = param(
        False, doc="Publish imu/data with gravity taken out of the linear acceleration.")
    gravity: float = param(9.80665, unit="m/s^2", low=9.7, high=9.9,
                           doc="Gravity that remove_gravity_vector takes out.")
    heading_deg: float = param(0.0, unit="deg", low=-360.0, high=360.0, read_only=False,
                               doc="Yaw that the service set_heading makes the present one.")
    publish_tf: bool = param(False, doc="Also write the orientation to /tf, from fixed_frame to "
                             "the frame of the Imu. The node needs tf2_msgs.")
    fixed_frame: str = param("odom", doc="Parent frame of that transform.")
    calibration: SensorCalibration = SensorCalibration()


def outputs_of(output: OrientationOutputParams) -> dict[str, str]:
    """Topics and types of what is published under these parameters."""
    return OUTPUTS | ({TF_TOPIC: TF_TYPE} if output.publish_tf else {})


class Pace:
    """Chooses samples at least an ``interval`` (ns) apart, however they come in blocks."""

    def __init__(self, interval: int) -> None:
        self._interval = interval
        self.next = -1 << 63

    def chosen(self, stamp: np.ndarray) -> list[int]:
        """Indices of stamps (n,), ascending."""
        found: list[int] = []
        k = int(stamp.searchsorted(self.next))
        while k < len(stamp):
            found.append(k)
            self.next = int(stamp[k]) + self._interval
            k = int(stamp.searchsorted(self.next))
        return found


class OrientationWriter:
    """Messages of the estimator's rows; turns them about the vertical by ``turn`` (rad).

    ``turn`` is positive counter-clockwise seen from above, whatever the world frame.
    """

    def __init__(self, params: OrientationParams, output: OrientationOutputParams) -> None:
        self._up = _UP[params.world_frame]
        self._output = output
        self._flags: int | None = None
        self._bias_pace = Pace(_BIAS_INTERVAL)
        self.turn = 0.0
        self.yaw: float | None = None

    def messages(self, rows: np.ndarray, frame_id: str) -> Iterator[Messages]:
        """Messages of rows, in order; the orientations first, as they are waited for."""
        if not len(rows):
            return
        stamp = rows["stamp"]
        rows, cdrs = self._orientations(rows, frame_id)
        yield Messages(ORIENTATION_TOPIC, stamp, cdrs)
        east = quat_rotate(rows["quat_world_imu"][-1], (1.0, 0.0, 0.0))
        self.yaw = math.atan2(self._up * east[1], east[0])
        if self._output.publish_tf:
            yield Messages(TF_TOPIC, stamp, transform_messages(
                stamp, self._output.fixed_frame, frame_id, np.zeros((len(rows), 3)),
                rows["quat_world_imu"]))
        yield Messages(RPY_TOPIC, stamp, rpy_messages(rows, frame_id))
        yield from self._status(rows, frame_id)
        yield from self._biases(rows, frame_id)

    def corrected(self, rows: np.ndarray, frame_id: str) -> list[Messages]:
        """Messages of rows that looking ahead has corrected."""
        if not len(rows):
            return []
        return [Messages(SMOOTHED_TOPIC, rows["stamp"], self._orientations(rows, frame_id)[1])]

    def restart(self) -> None:
        """What comes next is another stretch, perhaps at earlier stamps."""
        self.turn = 0.0
        self._bias_pace = Pace(_BIAS_INTERVAL)

    def set_yaw(self, yaw: float) -> None:
        """Turn so that the last row's yaw (rad, counter-clockwise from above) is ``yaw``.

        Raises:
            EstimationError: there is no orientation yet.
        """
        if self.yaw is None:
            raise EstimationError("no orientation yet: nothing to set the heading of")
        self.turn += yaw - self.yaw

    def _status(self, rows, frame_id):
        """Messages of flags where they change."""
        flags = lasting_flags(rows["flags"], self._flags or 0)
        if (flags == self._flags).all():
            return []
        stamp = rows["stamp"]
        before = np.append(~flags[0] if self._flags is None else self._flags, flags[:-1])
        changed, turned = flags != before, (flags ^ before) & FLAG_STILL != 0
        self._flags = int(flags[-1])
        return [
            Messages(STEADY_TOPIC, stamp[turned],
                     [bool_message(bool(f & FLAG_STILL)) for f in flags[turned].tolist()]),
            Messages(FLAGS_TOPIC, stamp[changed], [
                flags_message(s, frame_id, f)
                for s, f in zip(stamp[changed].tolist(), flags[changed].tolist())])]

    def _biases(self, rows, frame_id):
        """Messages of the bias, at most one per _BIAS_INTERVAL."""
        chosen = self._bias_pace.chosen(rows["stamp"])
        return [Messages(BIAS_TOPIC, rows["stamp"][chosen],
                         [bias_message(rows[k], frame_id) for k in chosen])] if chosen else []

    def _orientations(self, rows, frame_id):
        """Rows as they are published, and their messages."""
        has_force = rows["acc"].any(axis=1)   # zero: a gyroscope without an accelerometer
        if self.turn or self._output.remove_gravity_vector:
            rows = self._changed(rows, has_force)
        return rows, orientation_messages(rows, frame_id, has_force)

    def _changed(self, rows, has_force):
        rows = rows.copy()
        turn = quat_exp((0.0, 0.0, self._up * self.turn))
        rows["quat_world_imu"] = turned_by(turn, rows["quat_world_imu"])
        if self._output.remove_gravity_vector:
            up = (0.0, 0.0, self._up * self._output.gravity)
            rows["acc"][has_force] -= in_sensor_axes(rows["quat_world_imu"][has_force], up)
        return rows
