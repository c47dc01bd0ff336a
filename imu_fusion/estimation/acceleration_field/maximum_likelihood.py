"""Densities of the rigid-body model, fitted to a recording without any truth."""

from collections.abc import Callable

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.acceleration_field.measurement import make_trace
from imu_fusion.estimation.acceleration_field.params import AccelerationFieldParams
from imu_fusion.estimation.acceleration_field.rigid_body_filter import RigidBodyFilter
from imu_fusion.estimation.acceleration_field.rigid_body_smoother import CHUNK
from imu_fusion.estimation.acceleration_field.sensor_array import SensorArray
from imu_fusion.estimation.acceleration_field.start import Start


def log_likelihood(params: AccelerationFieldParams, array: SensorArray, start: Start,
                   stamp: np.ndarray, readings: np.ndarray) -> float:
    """Log likelihood of the readings (n, m) at stamps (n,) under the causal filter."""
    keeper = RigidBodyFilter(params, array, start, is_adaptive=False)
    trace = make_trace(min(CHUNK, len(stamp)), len(array.channels), len(start.x))
    return sum(keeper.trace(stamp[i:i + CHUNK], readings[i:i + CHUNK],
                            np.empty((0, len(start.x))), trace)
               for i in range(0, len(stamp), CHUNK))


def fit_densities(params: AccelerationFieldParams, array: SensorArray,
                  make_start: Callable[[AccelerationFieldParams], Start], stamp: np.ndarray,
                  readings: np.ndarray) -> AccelerationFieldParams:
    """Maximum likelihood of the motion model and, if asked, of a common scale of the noise.

    Args:
        params: ``maximum_likelihood`` names what is fitted: ``motion`` (jerk_density,
            acceleration_rate_density and, unless it is zero, rate) or ``motion_and_noise``
            (noise_scale as well). Its values are where the search begins.
        make_start: function of the parameters that returns the start (its spread depends on
            the densities).
        stamp: (n,) int64 ns.
        readings: (n, m), NaN for missing channels.

    Returns:
        The parameters with the fitted values.

    Raises:
        EstimationError: fewer than ten samples, or no maximum.
    """
    if len(stamp) < 10:
        raise EstimationError(f"maximum likelihood: {len(stamp)} samples are too few, give ten or "
                              "more, or set the motion densities")
    names = ["motion.jerk_density", "motion.acceleration_rate_density"]
    if params.motion.rate > 0:
        names.append("motion.rate")
    if params.maximum_likelihood == "motion_and_noise":
        names.append("noise_scale")
    first = np.log([params.get(name) for name in names])

    def candidate(logs):
        return params.replace(**dict(zip(names, np.exp(logs).tolist())))

    def cost(logs):
        if np.any(np.abs(logs - first) > 20):
            return np.inf
        chosen = candidate(logs)
        return -log_likelihood(chosen, array, make_start(chosen), stamp, readings)

    # Five per cent in the densities changes no estimate noticeably; half a unit of log
    # likelihood is half a standard deviation of a parameter.
    found = scipy.optimize.minimize(cost, first, method="Nelder-Mead", options={
        "xatol": 0.05, "fatol": 0.5,
        "initial_simplex": np.vstack([first, first + np.eye(len(first))])})
    if not np.isfinite(found.fun):
        raise EstimationError("maximum likelihood: no finite likelihood; check the units of the "
                              "readings and of the noise densities")
    return candidate(found.x)
