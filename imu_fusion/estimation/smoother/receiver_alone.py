"""A recording of a GNSS receiver alone: what an Imu would say is replaced by what is true of any body.

In the mean its velocity does not change; how it does change is white acceleration (the continuous
white noise acceleration model, Bar-Shalom et al. 2001, section 6.2.2), as the noise of an Imu with
the axes of the world that feels its weight and nothing else. The density is the one under which the
readings are likeliest. All else is the smoother's: errors of the receiver, steps, outliers,
surfaces. Attitudes stay unknown, and say so.
"""

from dataclasses import replace

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.smoother.attempt import Given, Model, attempt
from imu_fusion.estimation.smoother.hypotheses import likelier
from imu_fusion.estimation.smoother.imu_input import first_place, reference_frame
from imu_fusion.estimation.smoother.noise_fit import within_bounds
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.problem import NoiseFactors, Problem
from imu_fusion.estimation.smoother.result import SmootherResult
from imu_fusion.estimation.smoother.surroundings import surroundings_of
from imu_fusion.samples.logs import FixLog, ImuLog, VelocityLog
from imu_fusion.surfaces.constraint import Surface

_STEP = 100_000_000   # ns: the longest between two samples of the trajectory
_FEWEST = 3           # fixes, of which a velocity and its change can be told
_UNKNOWN_SD = 10.0    # rad, rad/s: no attitude can err by as much, so that none is claimed
_ACC_DENSITY = "sensor.acc_noise_density"
_MOST = np.log(1e4)   # of the density by the one given, either way
_UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])

# An Imu without errors, whose axes are those of the world; nothing on the body is elsewhere. Walks
# that are given, and as good as zero, are not tried.
_IMU = {"sensor.gyro_noise_density": 1e-6, "sensor.gyro_bias_sd": 1e-6,
        "sensor.gyro_bias_walk": 1e-12, "sensor.gyro_scale_sd": 0.0, "sensor.gyro_range": None,
        "sensor.acc_bias_sd": 1e-6, "sensor.acc_bias_walk": 1e-12, "sensor.acc_matrix_sd": 0.0,
        "sensor.acc_range": None, "gnss.lever_arm": (0.0, 0.0, 0.0), "gnss.lever_arm_sd": 0.0,
        "surface.lever_arm": (0.0, 0.0, 0.0), "surface.lever_arm_sd": 0.0,
        "initial.attitude_sd": 1e-3}


def smooth_receiver(fix: FixLog | None, velocity: VelocityLog | None, params: SmootherParams,
                    surface: Surface | None) -> SmootherResult:
    """Smooth fixes and velocities without an Imu.

    Args:
        fix: FixLog. velocity: VelocityLog or None. surface: Surface or None.
        params: SmootherParams, of which those of the sensor are not used. Accelerations begin with
            ``gap.acc_noise_density``, and keep it with ``maximum_likelihood`` 'off'.

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
    stamp = _stamps(fix.stamp[fix.usable])
    around = surroundings_of(params, frame, int(stamp[0]), False)
    still = ImuLog(stamp, np.tile(around.earth_rate, (len(stamp), 1)),
                   np.tile([0.0, 0.0, around.gravity], (len(stamp), 1)))
    given = Given(still, None, fix, velocity, None, _UPRIGHT)
    model = Model(params.replace(**{**_IMU, _ACC_DENSITY: params.gap.acc_noise_density}))
    found = attempt(given, model, surface)
    if params.maximum_likelihood != "off":
        model = model.changed({_ACC_DENSITY: _likeliest_density(found.problem, model.params)})
        found = attempt(given, model, surface)
    result = likelier(found, model, lambda other: attempt(given, other, surface))
    adapted = {name: value for name, value in result.adapted.items()
               if not name.startswith("sensor.")}
    return replace(result, adapted=adapted, samples=_unknown_attitude(result.samples),
                   acc_density=float(result.adapted.get(_ACC_DENSITY,
                                                        model.params.get(_ACC_DENSITY))))


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


def _likeliest_density(problem: Problem, params: SmootherParams) -> float:
    """Density (m/s^2/sqrt(Hz)) of the acceleration under which the readings are likeliest."""
    def surprise(log: float) -> float:
        factors = NoiseFactors((1.0, np.exp(log)), (1.0, 1.0), {}, {})
        return -problem.log_likelihood(factors, len(problem.x))

    # The problem is linear: wherever it was solved, this is the likelihood.
    tried = np.linspace(-_MOST, _MOST, 13)
    best = tried[int(np.argmin([surprise(log) for log in tried]))]
    width = tried[1] - tried[0]
    found = scipy.optimize.minimize_scalar(surprise, bounds=(best - width, best + width),
                                           method="bounded", options={"xatol": 0.02}).x
    return within_bounds(_ACC_DENSITY, float(np.exp(found)) * params.sensor.acc_noise_density)


def _unknown_attitude(samples: np.ndarray) -> np.ndarray:
    """Samples without what no receiver tells."""
    samples = samples.copy()
    for name in ("acc", "acc_sd", "gyr_bias", "gyr_bias_sd", "acc_bias", "acc_bias_sd"):
        samples[name] = np.nan
    samples["quat_world_imu"], samples["gyr"] = _UPRIGHT, 0.0
    samples["gyr_sd"], samples["cov_attitude"] = _UNKNOWN_SD, _UNKNOWN_SD ** 2 * np.eye(3)
    return samples
