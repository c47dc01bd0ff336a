"""Statistics of the simulated noise against the theory of the Ornstein-Uhlenbeck process."""

import numpy as np
import pytest

from imu_fusion.errors import SampleError
from imu_fusion.simulation.noise import gauss_markov, ornstein_uhlenbeck


@pytest.mark.parametrize("dt", [1e-4, 1e-3, 1e-2])
def test_variance_and_correlation_do_not_depend_on_the_step(dt):
    beta, sigma = 1e3, 100.0
    noise = ornstein_uhlenbeck((400, 2000), dt, beta, sigma, np.random.default_rng(1))
    # Uhlenbeck & Ornstein 1930: variance sigma^2 / (2 beta), correlation exp(-beta t). 800,000
    # numbers (fewer independent ones at small steps) give the variance to better than 2 %.
    variance = sigma ** 2 / (2 * beta)
    assert np.mean(noise ** 2) == pytest.approx(variance, rel=0.02)
    assert np.mean(noise[0] ** 2) == pytest.approx(variance, rel=0.12)
    assert np.mean(noise[1:] * noise[:-1]) / variance == pytest.approx(np.exp(-beta * dt), abs=0.02)


def test_processes_are_independent():
    noise = gauss_markov(0.1 * np.arange(5000), [3.0, 3.0], 0.2, np.random.default_rng(2))
    assert abs(np.corrcoef(noise.T)[0, 1]) < 0.06
    assert np.std(noise) == pytest.approx(3.0, rel=0.05)


def test_impossible_parameters_are_refused():
    with pytest.raises(SampleError, match="beta"):
        ornstein_uhlenbeck((10,), 1e-3, 0.0, 1.0, np.random.default_rng(0))
