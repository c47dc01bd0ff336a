"""Errors of a GNSS receiver: white noise, a wandering position, outliers."""

from dataclasses import dataclass

import numpy as np

from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.simulation.noise import gauss_markov


@dataclass(frozen=True)
class GnssErrors(Parameters):
    """Errors of positions and velocities, east, north, up. Defaults: Fang 2020, table 5."""

    position_sd: tuple[float, ...] = param((3.0, 3.0, 5.0), doc="Position error, east, north, up",
                                           unit="m", low=0, length=3)
    position_tau: float = param(0.0, doc="Correlation time of the position error (first-order "
                                "Gauss-Markov); 0: white", unit="s", low=0)
    correlated_share: float = param(0.95, doc="Share of the variance that is correlated when "
                                    "position_tau or velocity_tau is set", low=0, high=1)
    velocity_sd: tuple[float, ...] = param((0.1, 0.1, 0.3), doc="Velocity error", unit="m/s",
                                           low=0, length=3)
    velocity_tau: float = param(0.0, doc="Correlation time of the velocity error; 0: white",
                                unit="s", low=0)
    outlier_share: float = param(0.0, doc="Share of fixes and velocities that are outliers",
                                 low=0, high=1)
    outlier_factor: float = param(10.0, doc="Standard deviations of an outlier, in units of "
                                  "the nominal ones", low=1)
    time_offset: float = param(0.0, doc="The receiver's stamps are late by this", unit="s")


def _errors(times, sd, tau, share, rng):
    """White errors (n, 3), or with a correlation time ``share`` of their variance wandering."""
    white = len(times), 3
    if tau <= 0.0:
        return sd * rng.standard_normal(white)
    return (gauss_markov(times, sd * np.sqrt(share), tau, rng)
            + np.sqrt(1.0 - share) * sd * rng.standard_normal(white))


def gnss_errors(times: np.ndarray, errors: GnssErrors,
                rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Position (n, 3) and velocity (n, 3) errors at times (n,) s."""
    n = len(times)
    sd = np.array(errors.position_sd)
    position = _errors(times, sd, errors.position_tau, errors.correlated_share, rng)
    velocity = _errors(times, np.array(errors.velocity_sd), errors.velocity_tau,
                       errors.correlated_share, rng)
    for error, nominal in ((position, sd), (velocity, np.array(errors.velocity_sd))):
        bad = rng.random(n) < errors.outlier_share
        error[bad] = (errors.outlier_factor * nominal
                      * rng.standard_normal((int(bad.sum()), 3)))
    return position, velocity
