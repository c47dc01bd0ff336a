"""A recording of a GNSS receiver alone: an Imu is replaced by what is true of any body.

In the mean its velocity does not change; how it does change is white acceleration (the continuous
white noise acceleration model, Bar-Shalom et al. 2001, section 6.2.2), as the noise of an Imu with
the axes of the world that feels its weight and nothing else. Its density, the noise of the receiver
and how its velocities wander are those under which the readings are likeliest. What it states of
its places is an error that wanders: nothing here tells it from motion, so that none of it averages
out. Attitudes stay unknown, and say so.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.smoother.attempt import Given, Model, attempt
from imu_fusion.estimation.smoother.imu_input import first_place, reference_frame
from imu_fusion.estimation.smoother.noise_fit import fit_noise, within_bounds
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.problem import NoiseFactors, Problem
from imu_fusion.estimation.smoother.result import SmootherResult
from imu_fusion.estimation.smoother.surroundings import surroundings_of
from imu_fusion.samples.logs import FixLog, ImuLog, VelocityLog
from imu_fusion.surfaces.constraint import Surface

_STEP = 100_000_000     # ns: the longest between two samples of the trajectory
_BLOCK = 1_000_000_000  # ns, over which a change of velocity is compared with what is usual
_FEWEST = 3             # fixes, of which a velocity and its change can be told
_UNKNOWN_SD = 10.0      # rad, rad/s: no attitude can err by as much, so that none is claimed
_ACC_DENSITY = "sensor.acc_noise_density"
_PLACE = "gnss_position_error"
_FACTORS = 2.0 ** np.arange(-12, 6)    # of the density that is given
_UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])

# An Imu without errors, whose axes are those of the world; nothing on the body is elsewhere.
_IMU = {"sensor.gyro_noise_density": 1e-6, "sensor.gyro_bias_sd": 1e-6,
        "sensor.gyro_bias_walk": 0.0, "sensor.gyro_scale_sd": 0.0, "sensor.gyro_range": None,
        "sensor.acc_bias_sd": 1e-6, "sensor.acc_bias_walk": 0.0, "sensor.acc_matrix_sd": 0.0,
        "sensor.acc_range": None, "gnss.lever_arm": (0.0, 0.0, 0.0), "gnss.lever_arm_sd": 0.0,
        "surface.lever_arm": (0.0, 0.0, 0.0), "surface.lever_arm_sd": 0.0,
        "initial.attitude_sd": 1e-3}


def smooth_receiver(fix: FixLog | None, velocity: VelocityLog | None, params: SmootherParams,
                    surface: Surface | None) -> SmootherResult:
    """Smooth fixes and velocities without an Imu.

    Args:
        fix: FixLog. velocity: VelocityLog or None. surface: Surface or None.
        params: SmootherParams, of which those of the sensor are not used. Fixes wander by
            ``gnss.position_error_sd``, or else by what is stated of them. With
            ``maximum_likelihood`` 'off' accelerations have ``gap.acc_noise_density``, and
            velocities wander by what is stated.

    Returns:
        SmootherResult at the stamps of the fixes and at most 0.1 s apart. Its attitudes are those
        of the world, with standard deviations of 10 rad; forces and biases are NaN.

    Raises:
        SampleError: unusable samples. EstimationError: fewer than three fixes, or a jump to find,
            or no convergence to finite values.
    """
    if params.method == "extended_rts":
        raise EstimationError("method 'extended_rts' needs an Imu: 'iterated' smooths fixes and "
                              "velocities alone")
    frame = reference_frame(surface, first_place(fix, None))
    assert fix is not None
    fixes = fix[fix.usable]
    stamp = _stamps(fixes.stamp)
    around = surroundings_of(params, frame, int(stamp[0]), False)
    still = ImuLog(stamp, np.tile(around.earth_rate, (len(stamp), 1)),
                   np.tile([0.0, 0.0, around.gravity], (len(stamp), 1)))
    given = Given(still, None, fix, velocity, None, _UPRIGHT, felt=False)
    changes: dict[str, Any] = {**_IMU, _ACC_DENSITY: params.gap.acc_noise_density}
    gnss = params.gnss
    if not np.any(gnss.position_error_sd):
        changes["gnss.position_error_sd"] = _stated_sd(fixes.cov_enu, gnss.fix_sd, params)
    if velocity is not None and len(velocity) and not np.any(gnss.velocity_error_sd):
        changes["gnss.velocity_error_sd"] = _stated_sd(velocity.cov_world, gnss.velocity_sd, params)
    model = Model(params.replace(**changes))
    found = attempt(given, model, surface)
    if params.maximum_likelihood != "off":
        model = model.changed({_ACC_DENSITY: _likeliest_density(found.problem, model.params)})
        found = attempt(given, model, surface)
        model = fit_noise(found.problem, model, held=(_PLACE,))
        found = attempt(given, model, surface)
    density = model.params.sensor.acc_noise_density
    samples = _unknown_attitude(found.result.samples)
    _widen(samples, fixes.stamp, density)
    return replace(found.result, samples=samples, acc_density=density)


def _stamps(fixes: np.ndarray) -> np.ndarray:
    """Stamps of fixes (n,) ns in order, and even ones between those that are more than a step
    apart."""
    fixes = np.unique(fixes)
    if len(fixes) < _FEWEST:
        raise EstimationError(f"{len(fixes)} usable fixes and no Imu: at least {_FEWEST} are "
                              "needed for a trajectory")
    steps = np.diff(fixes)
    parts = -(-steps // _STEP)
    which = np.repeat(np.arange(len(steps)), parts)
    place = np.arange(len(which)) - np.repeat(np.cumsum(parts) - parts, parts)
    return np.append(fixes[which] + steps[which] * place // parts[which], fixes[-1])


def _stated_sd(cov: np.ndarray, given: tuple[float, ...], params: SmootherParams
               ) -> tuple[float, ...]:
    """Typical standard deviations (3,) east, north, up, of covariances (n, 3, 3), or those given
    where they are not stated."""
    variance = cov.diagonal(0, 1, 2)
    variance = variance[(variance > 0.0).all(axis=1)]
    if not params.gnss.covariances or not len(variance):
        return given
    return tuple(np.sqrt(np.median(variance, axis=0)).tolist())


def _likeliest_density(problem: Problem, params: SmootherParams) -> float:
    """Density (m/s^2/sqrt(Hz)) of the acceleration, to a factor of two, under which the readings
    are likeliest."""
    # The problem is linear: wherever it was solved, this is the likelihood.
    def likelihood(factor: float) -> float:
        return problem.log_likelihood(NoiseFactors((1.0, factor), (1.0, 1.0), {}, {}),
                                      len(problem.x))

    best = max(_FACTORS.tolist(), key=likelihood)
    return within_bounds(_ACC_DENSITY, best * params.sensor.acc_noise_density)


def _widen(samples: np.ndarray, fixes: np.ndarray, density: float) -> None:
    """Make covariances as much larger, in place, as the velocity changes more than it usually does:
    a body that is at rest for minutes and thrown in between. Blocks begin and end at fixes, so that
    an outage is one."""
    fixes = np.unique(fixes)
    edges = fixes[np.unique((fixes - fixes[0]) // _BLOCK, return_index=True)[1]]
    edges = np.append(edges[:-1], fixes[-1]) if len(edges) > 1 else fixes[[0, -1]]
    at = np.searchsorted(samples["stamp"], edges)
    change = np.sum(np.diff(samples["vel_world"][at], axis=0) ** 2, axis=1)
    more = np.maximum(change / (3.0 * density ** 2 * np.diff(edges) * 1e-9), 1.0)
    block = np.clip(np.searchsorted(edges, samples["stamp"], side="right") - 1, 0, len(more) - 1)
    for name in ("cov_position", "cov_velocity"):
        samples[name] *= more[block][:, None, None]


def _unknown_attitude(samples: np.ndarray) -> np.ndarray:
    """Samples without what no receiver tells."""
    samples = samples.copy()
    for name in ("acc", "acc_sd", "gyr_bias", "gyr_bias_sd", "acc_bias", "acc_bias_sd"):
        samples[name] = np.nan
    samples["quat_world_imu"], samples["gyr"] = _UPRIGHT, 0.0
    samples["gyr_sd"], samples["cov_attitude"] = _UNKNOWN_SD, _UNKNOWN_SD ** 2 * np.eye(3)
    return samples
