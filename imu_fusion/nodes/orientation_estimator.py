"""The orientation estimator as a node: decode, one call, encode."""

import math
from collections.abc import Mapping
from typing import Any

import yaml

from imu_fusion.estimation.orientation.estimator import OrientationParams
from imu_fusion.nodes.estimator import EstimatorNode
from imu_fusion.streams.orientation import OrientationStream, warm_up
from imu_fusion.streams.orientation_messages import OrientationOutputParams, outputs_of
from imu_fusion.streams.stream import EstimatorNodeParams


class OrientationEstimatorNode(EstimatorNode):
    """Orientation from imu/data_raw and imu/mag, published on imu/data.

    Services (std_srvs/Trigger): ~/reset, ~/set_heading (to heading_deg),
    ~/calibrate_magnetometer (from the samples since the start; answers as YAML).
    """

    NAME = "orientation_estimator"
    PARAMETERS = (EstimatorNodeParams, OrientationParams, OrientationOutputParams)

    def _set_up(self):
        super()._set_up()
        output = self.params(OrientationOutputParams)
        warm_up(self.params(OrientationParams))
        self.attach(OrientationStream(self.params(OrientationParams), output,
                                      self.get_logger().warning), outputs_of(output))
        self.offer("reset", self.restart)
        self.offer("set_heading", self._set_heading)
        self.offer("calibrate_magnetometer", self._calibrate)

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
