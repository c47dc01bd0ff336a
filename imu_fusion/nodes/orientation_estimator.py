"""The orientation estimator as a node: decode, one call, encode."""

import math

import yaml
from std_srvs.srv import Trigger

from imu_fusion.errors import ImuFusionError
from imu_fusion.estimation.orientation import OrientationParams
from imu_fusion.messages.orientation_stream import (OUTPUTS, OrientationOutputParams,
                                                    OrientationStream, warm_up)
from imu_fusion.messages.streams import EstimatorNodeParams
from imu_fusion.nodes.base import run_node
from imu_fusion.nodes.estimator import EstimatorNode


class OrientationEstimatorNode(EstimatorNode):
    """Orientation from imu/data_raw and imu/mag, published on imu/data.

    Services (std_srvs/Trigger): ~/reset, ~/set_heading (to heading_deg),
    ~/calibrate_magnetometer (from the samples since the start; answers as YAML).
    """

    NAME = "orientation_estimator"
    PARAMETERS = (EstimatorNodeParams, OrientationParams, OrientationOutputParams)

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        warm_up(self.params(OrientationParams))
        self.attach(OrientationStream(
            self.params(OrientationParams), self.params(OrientationOutputParams), self.emit,
            self.get_logger().warning), OUTPUTS)
        for name, action in (("reset", self._restart), ("set_heading", self._set_heading),
                             ("calibrate_magnetometer", self._calibrate)):
            self.create_service(Trigger, f"~/{name}",
                                lambda _, response, action=action: self._answer(response, action))

    def summary(self):
        return self._stream.estimator.summary()

    def apply(self, params):
        self._stream.change(params[OrientationParams])

    def _restart(self):
        self._stream.restart()
        return "the estimator starts anew with the next sample"

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

    @staticmethod
    def _answer(response, action):
        try:
            response.message, response.success = action(), True
        except ImuFusionError as error:
            response.message, response.success = str(error), False
        return response


def main(args=None):
    """Entry point of the executable."""
    return run_node(OrientationEstimatorNode, args)
