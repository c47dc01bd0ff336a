"""The estimators that the doors know: one line each."""

from imu_fusion.streams import acceleration_field, orientation, smoother
from imu_fusion.streams.stage import Stage

STAGES: dict[str, Stage] = {stage.node: stage for stage in (
    orientation.STAGE,
    smoother.STAGE,
    acceleration_field.STAGE)}
"""By the name of the node, in the order in which ``process`` runs them."""
