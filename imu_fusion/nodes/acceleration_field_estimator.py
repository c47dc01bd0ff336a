"""The acceleration field estimator as a node: decode, one call, encode."""

from collections.abc import Sequence

from std_srvs.srv import Trigger

from imu_fusion.nodes.base import run_node
from imu_fusion.nodes.estimator import EstimatorNode
from imu_fusion.streams.acceleration_field import (
    NODE,
    NODE_PARAMETERS,
    OUTPUTS,
    SENSOR_PREFIXES,
    AccelerationFieldStream,
    FieldConfiguration,
)


class AccelerationFieldEstimatorNode(EstimatorNode):
    """Acceleration field of a rigid body from accelerometers/<name> (and imu/data_raw)."""

    NAME = NODE
    PARAMETERS = NODE_PARAMETERS
    OPEN_PREFIXES = SENSOR_PREFIXES

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        values = dict(self.open_parameters)
        for cls in NODE_PARAMETERS[1:]:
            values.update(self.params(cls).to_mapping())
        config = FieldConfiguration.from_mapping(values, f"node {self.get_name()}")
        self.attach(AccelerationFieldStream(config, self.get_logger().warning), OUTPUTS)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/smooth", self._on_smooth)

    def summary(self) -> dict:
        return self._stream.summary()

    def _on_reset(self, request, response):
        self._stream.restart()
        response.success = True
        response.message = "the estimator starts anew with the next sample"
        return response

    def _on_smooth(self, request, response):
        if self._stream.config.field.mode != "smoothed":
            response.message = "mode is causal: nothing is held back; start with mode:=smoothed"
            return response
        made = self._stream.smooth()
        self.publish(made)
        count = len(made[0].stamp) if made else 0
        response.success = count > 0
        response.message = (f"{count} samples smoothed and published" if count
                            else "no samples since the last time")
        return response


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of the executable."""
    return run_node(AccelerationFieldEstimatorNode, args)
