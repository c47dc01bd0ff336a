"""Noise of the Imu and of the receiver, fitted to a recording by maximum likelihood.

The readings are those of a solved problem, linear about its trajectory, so that a value of the
likelihood is one pass of the filter forward.
"""

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.estimation.smoother.attempt import Model
from imu_fusion.estimation.smoother.measurements.registry import MEASUREMENTS
from imu_fusion.estimation.smoother.problem import Problem

_SENSOR = ("sensor.gyro_noise_density", "sensor.acc_noise_density", "sensor.gyro_bias_walk",
           "sensor.acc_bias_walk")
_MOST = np.log(20.0)   # of a factor, either way
_SPREAD = 1.0          # of the logarithm of a factor, before any reading: e or 1/e
_STEP = 0.1            # of it, between two values whose difference tells the slope
_ENOUGH = 5.0          # of the log-likelihood, of which fits to a drive differ by thousands
_SAMPLES = 60_000      # of the Imu, from the beginning on: ten minutes tell the noise


def fit_noise(problem: Problem, model: Model) -> Model:
    """The model with the noise under which the readings are likeliest.

    Args:
        problem: solved under ``model``.
    """
    present = np.unique(problem.readings["kind"])
    names = [MEASUREMENTS[kind].name for kind in present if MEASUREMENTS[kind].name != "mag"]

    def cost(logs: np.ndarray) -> float:
        factors = np.exp(logs)
        return (0.5 * float(np.sum(np.square(logs / _SPREAD)))
                - problem.log_likelihood(factors[:2], factors[2:4], dict(zip(names, factors[4:])),
                                         _SAMPLES))

    start = np.zeros(len(_SENSOR) + len(names))
    found = scipy.optimize.minimize(
        cost, start, method="L-BFGS-B", bounds=[(-_MOST, _MOST)] * len(start),
        options={"eps": _STEP, "ftol": _ENOUGH / max(1.0, abs(cost(start))), "maxiter": 12})
    factors = [float(f) for f in np.exp(found.x)]
    receiver = factors[len(_SENSOR):]
    changed = model.changed({name: factor * model.params.get(name)
                             for name, factor in zip(_SENSOR, factors)})
    return changed._replace(noise={name: factor * model.noise.get(name, 1.0)
                                   for name, factor in zip(names, receiver)})
