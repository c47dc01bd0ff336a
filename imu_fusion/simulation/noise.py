"""Noise processes with exact discrete statistics, for simulated sensors."""

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import lfilter

from imu_fusion.errors import SampleError


def ornstein_uhlenbeck(size: int, dt: float, beta: float, sigma: float,
                       rng: np.random.Generator) -> np.ndarray:
    """Stationary Ornstein-Uhlenbeck processes, sampled without discretisation error.

    The process of Rahaman 2019, eq. (4.1), ``d eta = -beta eta dt + sigma dW``, started from
    its stationary law (variance ``sigma^2 / (2 beta)``). Between samples it is an exact first
    order recursion, so the statistics do not depend on ``dt``.

    Args:
        size: (n, ...) shape; the first axis is time, the others are independent processes.
        dt: sample interval, s.
        beta: drift coefficient, 1/s, positive.
        sigma: diffusion coefficient, unit of the process per sqrt(s), not negative.
        rng: numpy Generator.

    Returns:
        Array of shape ``size``.

    Raises:
        SampleError: ``beta`` or ``dt`` not positive, ``sigma`` negative.
    """
    if not (beta > 0 and dt > 0 and sigma >= 0):
        raise SampleError(f"Ornstein-Uhlenbeck process: beta {beta}, dt {dt} must be positive and "
                          f"sigma {sigma} not negative")
    decay = math.exp(-beta * dt)
    stationary = sigma / math.sqrt(2 * beta)
    drive = rng.standard_normal(size) * stationary
    # sqrt(1 - decay^2) keeps the variance; expm1 keeps its digits for small beta dt.
    drive[1:] *= math.sqrt(-math.expm1(-2 * beta * dt))
    return lfilter([1.0], [1.0, -decay], drive, axis=0)


def gauss_markov(times: np.ndarray, sd: ArrayLike, tau: float,
                 rng: np.random.Generator) -> np.ndarray:
    """Samples (n, k) of first-order Gauss-Markov errors at times (n,) s: stationary standard
    deviation sd (k,), correlation exp(-dt/tau); the process above in the terms of navigation, at
    any times."""
    each = np.asarray(sd, dtype=float)
    error = np.empty((len(times), len(each)))
    error[0] = each * rng.standard_normal(len(each))
    for i, dt in enumerate(np.diff(times)):
        keep = np.exp(-dt / tau)
        error[i + 1] = (keep * error[i]
                        + each * np.sqrt(1.0 - keep * keep) * rng.standard_normal(len(each)))
    return error
