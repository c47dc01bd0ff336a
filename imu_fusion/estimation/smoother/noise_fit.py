"""Noise of the Imu and of the receiver, fitted to a recording by maximum likelihood.

The readings are those of a solved problem, linear about its trajectory, so that a value of the
likelihood is one pass of the filter forward.
"""

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.estimation.smoother.attempt import Model
from imu_fusion.estimation.smoother.measurements.registry import MEASUREMENTS
from imu_fusion.estimation.smoother.problem import Problem
from imu_fusion.estimation.smoother.state import BLOCKS

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
    wandering = [b.name for b in BLOCKS if b.tau is not None and getattr(problem.blocks, b.name) >= 0]
    size = len(_SENSOR) + len(names)

    def receiver(factors: np.ndarray) -> tuple[dict, dict]:
        return (dict(zip(names, factors[len(_SENSOR):size])),
                dict(zip(wandering, factors[size:].reshape(-1, 2))))

    def cost(logs: np.ndarray) -> float:
        factors = np.exp(logs)
        return (0.5 * float(np.sum(np.square(logs / _SPREAD)))
                - problem.log_likelihood(factors[:2], factors[2:4], *receiver(factors), _SAMPLES))

    start = np.zeros(size + 2 * len(wandering))
    found = scipy.optimize.minimize(
        cost, start, method="L-BFGS-B", bounds=[(-_MOST, _MOST)] * len(start),
        options={"eps": _STEP, "ftol": _ENOUGH / max(1.0, abs(cost(start))), "maxiter": 12})
    factors = np.exp(found.x)
    noise, wander = receiver(factors)
    changes = {name: float(factor) * model.params.get(name)
               for name, factor in zip(_SENSOR, factors)}
    for name, (sd, tau) in wander.items():
        parameter = name.replace("gnss_", "gnss.")
        changes[f"{parameter}_sd"] = tuple(
            (sd * np.broadcast_to(model.params.get(f"{parameter}_sd"), 3)).tolist())
        changes[f"{parameter}_tau"] = float(tau) * model.params.get(f"{parameter}_tau")
    return model.changed(changes)._replace(noise={
        name: float(factor) * model.noise.get(name, 1.0) for name, factor in noise.items()})
