"""The record of parameters that the kernels of acceleration fields read."""

import numpy as np

from imu_fusion.estimation.acceleration_field.motion_model import motion_spread
from imu_fusion.estimation.acceleration_field.params import AccelerationFieldParams
from imu_fusion.estimation.acceleration_field.sensor_array import SensorArray
from imu_fusion.parameters.record import record


def kernel_params(params: AccelerationFieldParams, array: SensorArray) -> np.ndarray:
    """A (1,) record: the parameters and what follows from them and the array.

    ``reference`` (3,), ``specific_force``, ``common_shift_variance`` and ``radius`` are those of
    the array; ``spread`` (4,) see :func:`motion_spread`; ``is_adaptive`` whether noise and motion
    may be taken to be larger; ``scale`` (12,) of the columns of the affine fit's design;
    ``square_root`` and ``high_order`` whether the method and the integration are these.
    """
    return record(
        params, reference=array.reference, specific_force=array.specific_force,
        common_shift_variance=array.common_shift_variance, spread=motion_spread(params),
        radius=max(array.radius, 1e-12), is_adaptive=True,
        scale=np.r_[np.ones(3), np.full(9, 1.0 / array.radius)],
        square_root=params.method == "sqrt_ao", high_order=params.integration == "high_order")
