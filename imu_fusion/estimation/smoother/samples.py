"""From a solved problem to what is published of each sample: corrected readings among it."""

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.estimation.smoother.problem import Change, Problem
from imu_fusion.estimation.smoother.result import SAMPLE, reading_variances
from imu_fusion.estimation.smoother.state import (
    ACC_BIAS,
    ATT,
    BLOCKS,
    GYR_BIAS,
    POS,
    SLOW,
    VEL,
    slow_states,
)
from imu_fusion.geometry.gravity import gravity_world


def smoothed_samples(problem: Problem, change: Change) -> np.ndarray:
    """Structured array of SAMPLE, one per recorded sample.

    Args:
        problem: solved. change: its last one, with covariances.
    """
    recorded = problem.imu.recorded
    x, log = problem.x[recorded], problem.imu.log
    cov, sd = change.cov[recorded], _sds(problem, change)
    samples = np.empty(len(x), SAMPLE)
    samples["stamp"] = log.stamp[recorded]
    samples["position_world"], samples["vel_world"] = x[:, POS:POS + 3], x[:, VEL:VEL + 3]
    samples["quat_world_imu"] = x[:, ATT:ATT + 4]
    for block, name in enumerate(("cov_position", "cov_velocity", "cov_attitude")):
        samples[name] = cov[:, block]
    noise = np.sqrt(reading_variances(samples["stamp"], problem.params))
    for i, (name, first) in enumerate((("gyr", GYR_BIAS), ("acc", ACC_BIAS))):
        bias, bias_sd = slow_states(x, first, 3), sd[:, first - SLOW:first - SLOW + 3]
        samples[name + "_bias"], samples[name + "_bias_sd"] = bias, bias_sd
        samples[name] = (log.gyr, log.acc)[i][recorded] - bias
        samples[name + "_sd"] = np.hypot(bias_sd, noise[i])
    _correct_scales(samples, problem, sd)
    _recover_clipped(samples, problem)
    return samples


def smoothed_states(problem: Problem, change: Change) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Name of each optional block that is present -> values and standard deviations (m, k), SI, of
    the recorded samples. Arguments as of :func:`smoothed_samples`."""
    x, sd = problem.x[problem.imu.recorded], _sds(problem, change)
    states = {}
    for block in BLOCKS:
        first = getattr(problem.blocks, block.name)
        if first >= 0:
            states[block.name] = (
                block.si * slow_states(x, first, block.width),
                block.si * sd[:, first - SLOW:first - SLOW + block.width])
    return states


def _sds(problem: Problem, change: Change) -> np.ndarray:
    """Standard deviations (m, n - 9) of the slow states of the recorded samples."""
    return np.sqrt(np.maximum(change.var[problem.imu.recorded], 0.0))


def _correct_scales(samples: np.ndarray, problem: Problem, sd: np.ndarray) -> None:
    """Take the errors of gyroscope scale and accelerometer matrix off the readings."""
    recorded, blocks = problem.imu.recorded, problem.blocks
    x = problem.x[recorded]
    gyr, acc = problem.imu.log.gyr[recorded], problem.imu.log.acc[recorded]
    if blocks.gyr_scale >= 0:
        i = blocks.gyr_scale
        samples["gyr"] += slow_states(x, i, 3) * gyr
        samples["gyr_sd"] = np.hypot(samples["gyr_sd"], sd[:, i - SLOW:i - SLOW + 3] * gyr)
    if blocks.acc_matrix >= 0:
        i = blocks.acc_matrix
        matrix = slow_states(x, i, 9).reshape(-1, 3, 3)
        samples["acc"] += np.einsum("nij,nj->ni", matrix, acc)
        spread = sd[:, i - SLOW:i - SLOW + 9].reshape(-1, 3, 3) * acc[:, None, :]
        samples["acc_sd"] = np.sqrt(samples["acc_sd"] ** 2 + (spread ** 2).sum(axis=2))


def _recover_clipped(samples: np.ndarray, problem: Problem) -> None:
    """Where a reading was clipped, take that of the smoothed motion from sample to sample.

    Its variance is that of the difference, as if the errors at the two ends had nothing in
    common, or of what was assumed of the lost reading if that is less.
    """
    gap, log, x, around = problem.params.gap, problem.imu.log, problem.x, problem.around
    clipped = problem.imu.clipped
    inner = np.flatnonzero(clipped.any(axis=1))
    inner = inner[(inner > 0) & (inner < len(x) - 1)]
    if not len(inner):
        return
    row = np.cumsum(problem.imu.recorded) - 1   # of a sample in ``samples``
    span = ((log.stamp[inner + 1] - log.stamp[inner - 1]) * 1e-9)[:, None]
    attitude = scipy.spatial.transform.Rotation.from_quat(x[:, ATT:ATT + 4])
    velocity = x[:, VEL:VEL + 3]
    rate = (attitude[inner - 1].inv() * attitude[inner + 1]).as_rotvec() / span
    rate += attitude[inner].inv().apply(around.earth_rate)
    fall = np.array([gravity_world(at, around.gravity) for at in x[inner, POS:POS + 3]])
    fall -= 2.0 * np.cross(around.earth_rate, velocity[inner])
    force = attitude[inner].inv().apply((velocity[inner + 1] - velocity[inner - 1]) / span - fall)
    turn = attitude[inner].as_matrix()
    cov_velocity = samples["cov_velocity"][row[inner]]
    ends = (samples["cov_attitude"][row[inner]].diagonal(0, 1, 2),
            np.einsum("nji,njk,nki->ni", turn, cov_velocity, turn))
    for name, value, end, unknown, lost in (
            ("gyr", rate, ends[0], gap.gyro_noise_density, clipped[inner, 0:3]),
            ("acc", force, ends[1], gap.acc_noise_density, clipped[inner, 3:6])):
        sd = np.sqrt(np.minimum(2.0 * end / span ** 2, unknown ** 2 / span))
        for field, new in ((name, value), (name + "_sd", sd)):
            samples[field][row[inner]] = np.where(lost, new, samples[field][row[inner]])
