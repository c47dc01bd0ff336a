"""Noise of the Imu and of the receiver, fitted to a recording by maximum likelihood.

The readings are those of a solved problem, linear about its trajectory, so that a value of the
likelihood is one pass of the filter forward.
"""

from collections.abc import Callable, Collection
from typing import Any

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.estimation.smoother.attempt import Model
from imu_fusion.estimation.smoother.measurements.registry import MEASUREMENTS
from imu_fusion.estimation.smoother.problem import NoiseFactors, Problem
from imu_fusion.estimation.smoother.state import BLOCKS
from imu_fusion.sensors.params import SENSOR

_SENSOR = ("sensor.gyro_noise_density", "sensor.acc_noise_density", "sensor.gyro_bias_walk",
           "sensor.acc_bias_walk")
# Iron is no noise; a velocity of zero is no reading, and likelier the surer it is said to be.
_NOT_FITTED = ("mag", "rest")
_MOST = np.log(20.0)   # of a factor, either way
_SPREAD = 1.0          # of the logarithm of a factor, before any reading: e or 1/e
_STEP = 0.1            # of it, between two values whose difference tells the slope
_ENOUGH = 0.5          # of the log-likelihood: less changes no estimate
_TIMES = 0.5 * np.log(2.0) * np.arange(-3, 9)   # logarithms of factors of a correlation time
_SLOWEST = 0.25        # of a recording: errors that are slower are an offset that none tells
_SAMPLES = 60_000      # of the Imu, from the beginning on: ten minutes tell the noise


def fit_noise(problem: Problem, model: Model, held: Collection[str] = ()) -> Model:
    """The model with the noise under which the readings are likeliest.

    Args:
        problem: solved under ``model``. held: names of states that wander as they are given to.
    """
    present = np.unique(problem.readings["kind"])
    names = [MEASUREMENTS[kind].name for kind in present
             if MEASUREMENTS[kind].name not in _NOT_FITTED]
    wandering = [block.name for block in BLOCKS
                 if block.tau is not None and getattr(problem.blocks, block.name) >= 0
                 and block.name not in held]
    first = len(_SENSOR) + len(names)

    def factors_of(logs: np.ndarray) -> NoiseFactors:
        every = np.exp(logs)
        return NoiseFactors(every[:2], every[2:4], dict(zip(names, every[4:first])),
                            dict(zip(wandering, every[first:].reshape(-1, 2))))

    def cost(logs: np.ndarray) -> float:
        return (0.5 * float(np.sum(np.square(logs / _SPREAD)))
                - problem.log_likelihood(factors_of(logs), _SAMPLES))

    most = np.full(first + 2 * len(wandering), _MOST)
    longest = _SLOWEST * float(np.sum(problem.imu.steps))
    for i, name in enumerate(wandering):
        tau = model.params.get(f"{_parameter(name)}_tau")
        most[first + 2 * i + 1] = np.clip(np.log(longest / tau), -_MOST, _MOST)
    start = np.minimum(0.0, most)
    found = scipy.optimize.minimize(
        cost, start, method="L-BFGS-B", bounds=[(-_MOST, bound) for bound in most],
        options={"eps": _STEP, "ftol": _ENOUGH / max(1.0, abs(cost(start))), "maxiter": 12}).x
    for i in range(first + 1, len(start), 2):
        found[i] = _likely_time(cost, found, i, most[i])
    return _with(model, factors_of(found))


def _likely_time(cost: Callable[[np.ndarray], float], logs: np.ndarray, i: int, most: float
                 ) -> float:
    """Logarithm of a correlation time: of its root mean square over all that are likely.

    A recording of a few correlation times hardly tells it, once the variance density is known; the
    variance of a mean over the recording grows with its square.
    """
    tried = np.unique(np.minimum(logs[i] + _TIMES, most))
    values = np.array([cost(np.where(np.arange(len(logs)) == i, log, logs)) for log in tried])
    weights = np.exp(values.min() - values)
    return float(0.5 * np.log(weights @ np.exp(2.0 * tried) / weights.sum()))


def _parameter(block: str) -> str:
    """What its parameters begin with."""
    return block.replace("gnss_", "gnss.")


def within_bounds(name: str, value: float) -> float:
    """A value of a parameter ``sensor.*``, or the nearest that it can have."""
    allowed = SENSOR[name.removeprefix("sensor.")]
    return min(max(value, allowed["low"]), allowed["high"])


def _with(model: Model, factors: NoiseFactors) -> Model:
    """The model with its noise multiplied by the factors."""
    changes: dict[str, Any] = {name: within_bounds(name, float(factor) * model.params.get(name))
               for name, factor in zip(_SENSOR, (*factors.noise, *factors.walk))}
    for name, (walk, tau) in factors.wander.items():
        parameter = _parameter(name)
        sd = np.broadcast_to(model.params.get(f"{parameter}_sd"), 3)
        changes[f"{parameter}_sd"] = tuple((np.sqrt(walk * tau) * sd).tolist())
        changes[f"{parameter}_tau"] = float(tau) * model.params.get(f"{parameter}_tau")
    return model.changed(changes)._replace(noise={**model.noise, **{
        name: float(factor) * model.noise.get(name, 1.0)
        for name, factor in factors.receiver.items()}})
