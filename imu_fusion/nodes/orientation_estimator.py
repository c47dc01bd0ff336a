"""The orientation estimator as a node: decode, one call, encode."""

from std_srvs.srv import Trigger

from imu_fusion.estimation.orientation import OrientationParams
from imu_fusion.messages.orientation_stream import OUTPUTS, OrientationStream
from imu_fusion.messages.streams import EstimatorNodeParams
from imu_fusion.nodes.base import run_node
from imu_fusion.nodes.estimator import EstimatorNode


class OrientationEstimatorNode(EstimatorNode):
    """Orientation from imu/data_raw and imu/mag, published on imu/data."""

    NAME = "orientation_estimator"
    PARAMETERS = (EstimatorNodeParams, OrientationParams)

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.attach(OrientationStream(self.params(OrientationParams), emit=self.emit,
                                      warn=self.get_logger().warning), OUTPUTS)
        self.create_service(Trigger, "~/reset", self._on_reset)

    def summary(self):
        return self._stream.estimator.summary()

    def _on_reset(self, request, response):
        self._stream.restart()
        response.success = True
        response.message = "the estimator starts anew with the next sample"
        return response


def main(args=None):
    """Entry point of the executable."""
    return run_node(OrientationEstimatorNode, args)
