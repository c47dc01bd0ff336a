"""The orientation estimator as a node: decode, one call, encode."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import yaml
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped

from imu_fusion.errors import ParameterError
from imu_fusion.estimation.orientation.estimator import OrientationParams
from imu_fusion.messages.layouts import IMU, NANOSECONDS
from imu_fusion.nodes.base import Node
from imu_fusion.nodes.estimator import EstimatorNode
from imu_fusion.streams.orientation import (
    ORIENTATION_TOPIC,
    OUTPUTS,
    OrientationOutputParams,
    OrientationStream,
    warm_up,
)
from imu_fusion.streams.stream import EstimatorNodeParams, Messages


def transform_broadcast(node: Node) -> Callable[[TransformStamped], None]:
    """The function that broadcasts a TransformStamped.

    Raises:
        ParameterError: tf2_ros is not installed.
    """
    try:
        from tf2_ros import TransformBroadcaster
    except ImportError as error:
        raise ParameterError("parameter 'publish_tf': true needs tf2_ros, which is not here "
                             f"({error}); with an apt ROS: apt install ros-jazzy-tf2-ros-py, "
                             "else set publish_tf false") from None
    return TransformBroadcaster(node).sendTransform


def transform(cdr: bytes, fixed_frame: str) -> TransformStamped:
    """The geometry_msgs/TransformStamped from ``fixed_frame`` to an Imu message's frame."""
    stamp, frame_id, values = IMU.decode(cdr)
    message = TransformStamped(child_frame_id=frame_id)
    message.header.frame_id = fixed_frame
    message.header.stamp = Time(sec=stamp // NANOSECONDS, nanosec=stamp % NANOSECONDS)
    r = message.transform.rotation
    r.x, r.y, r.z, r.w = values[IMU["orientation"]].tolist()
    return message


class OrientationEstimatorNode(EstimatorNode):
    """Orientation from imu/data_raw and imu/mag, published on imu/data.

    Services (std_srvs/Trigger): ~/reset, ~/set_heading (to heading_deg),
    ~/calibrate_magnetometer (from the samples since the start; answers as YAML).
    """

    NAME = "orientation_estimator"
    PARAMETERS = (EstimatorNodeParams, OrientationParams, OrientationOutputParams)

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        output = self.params(OrientationOutputParams)
        self._broadcast = transform_broadcast(self) if output.publish_tf else None
        warm_up(self.params(OrientationParams))
        self.attach(OrientationStream(self.params(OrientationParams), output,
                                      self.get_logger().warning), OUTPUTS)
        self.offer("reset", self.restart)
        self.offer("set_heading", self._set_heading)
        self.offer("calibrate_magnetometer", self._calibrate)

    def publish(self, made: Sequence[Messages]) -> None:
        super().publish(made)
        if self._broadcast is not None:
            frame = self.params(OrientationOutputParams).fixed_frame
            for part in made:
                if part.topic == ORIENTATION_TOPIC:
                    for cdr in part.cdrs:
                        self._broadcast(transform(cdr, frame))

    def summary(self) -> dict:
        return self._stream.estimator.summary()

    def apply(self, params: Mapping[type, Any]) -> None:
        self._stream.change(params[OrientationParams])

    def _set_heading(self):
        heading = self.params(OrientationOutputParams).heading_deg
        self._stream.set_heading(math.radians(heading))
        return f"the present yaw is now {heading:g} deg"

    def _calibrate(self):
        found = self._stream.calibrate_magnetometer()
        return (f"{yaml.safe_dump(found.to_parameters(), default_flow_style=None).strip()}\n"
                f"# coverage {100 * found.coverage:.0f} % of all directions, condition "
                f"{found.condition:.0f}, residual {found.residual_sd * 1e6:.2f} uT; in use from "
                "now on")
