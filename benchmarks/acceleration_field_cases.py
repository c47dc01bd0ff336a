"""What the benchmarks of the acceleration field share: the paper's scene, sensors and errors."""

import numpy as np

from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
    Initial,
    Sensor,
)
from imu_fusion.estimation.acceleration_field.rows import field_at
from imu_fusion.simulation.noise import ornstein_uhlenbeck
from imu_fusion.simulation.rigid_body_impact import PAPER_AXES, PAPER_PARTICLE, PAPER_POSITIONS

BETA = 1e3  # 1/s, Rahaman 2019, section 4.1.2
EXACT = Sensor(acc_position_sd=0.0, acc_axes_sd=0.0, acc_scale_sd=0.0)   # as simulated
PARAMS = AccelerationFieldParams(
    sensor=EXACT, initial=Initial(mode="given", angular_velocity=(5.0, 5.0, 5.0), angular_velocity_sd=1e-6),
    gravity=9.8)
METHODS = {
    "AO (paper)": {"method": "ao"},
    "sqrt-AO": {"method": "sqrt_ao"},
    "causal filter": {"method": "rigid_body"},
    "smoother": {"method": "rigid_body", "mode": "smoothed"},
}


def paper_sensors(sigma, bias_sd=0.0):
    """The four accelerometers of fig. 4; the noise density of an OU process is sigma / beta at
    low frequencies, where the motion is."""
    return [AccelerometerParams(position=tuple(p), axes=tuple(a.ravel()), reports="acceleration",
                                noise_density=max(sigma, 1e-3) / BETA, bias_sd=bias_sd)
            for p, a in zip(PAPER_POSITIONS, PAPER_AXES)]


def noisy(clean, sigma, rng, one_process=False):
    """Readings (n, 4, 3) with OU noise at 1 kHz: a process per channel, or one for all as
    section 4.1.2 writes."""
    size = (len(clean), 1, 1) if one_process else clean.shape
    return clean + ornstein_uhlenbeck(size, 1e-3, BETA, sigma, rng)


def errors(rows, truth, gravity=9.8):
    """(eps_2, eps_inf) x1e-3 of eq. (4.2) for particle 5; truth (n, 3) in the world."""
    error = field_at(rows, PAPER_PARTICLE, gravity)[2][:, 0] - truth
    return (1e3 * np.linalg.norm(error) / np.linalg.norm(truth),
            1e3 * np.linalg.norm(error, axis=1).max() / np.linalg.norm(truth, axis=1).max())


def fitted_densities(params, sensors, stamp, readings):
    """``params`` with the motion densities of maximum likelihood from one recording."""
    estimator = AccelerationFieldEstimator(
        params.replace(**{"mode": "smoothed", "maximum_likelihood": "motion",
                          "iteration.max": 1}), sensors)
    estimator.run(stamp, readings)
    return params.replace(motion=estimator.fitted.motion)


def plus_minus(values):
    """Mean and standard deviation in three digits."""
    return f"{np.mean(values):.3g} ± {np.std(values):.2g}"
