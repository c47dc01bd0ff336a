"""The acceleration field estimator as a node: decode, one call, encode."""

from imu_fusion.errors import RefusedError
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

    def _set_up(self):
        super()._set_up()
        values = dict(self.open_parameters)
        for cls in NODE_PARAMETERS[1:]:
            values.update(self.params(cls).to_mapping())
        config = FieldConfiguration.from_mapping(values, f"node {self.get_name()}")
        self.attach(AccelerationFieldStream(config, self.get_logger().warning), OUTPUTS)
        self.offer("reset", self.restart)
        self.offer("smooth", self._smooth)

    def summary(self) -> dict:
        return self._stream.summary()

    def _smooth(self):
        if self._stream.config.field.mode != "smoothed":
            raise RefusedError("mode is causal: nothing is held back; start with mode:=smoothed")
        made = self._stream.smooth()
        self.publish(made)
        if not made:
            raise RefusedError("no samples since the last time")
        return f"{len(made[0].stamp)} samples smoothed and published"
