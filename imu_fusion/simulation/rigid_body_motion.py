"""Random motions of a rigid body drawn from the very model of the rigid-body estimator.

For tests of its uncertainty: where the model is right, the errors must be as large as the
estimator says, no more and no less.
"""

import numpy as np
from scipy.linalg import cholesky
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.acceleration_field.motion_model import mean_rotation, motion_step, parts
from imu_fusion.estimation.acceleration_field.params import AccelerationFieldParams
from imu_fusion.estimation.acceleration_field.sensor_array import SensorArray
from imu_fusion.estimation.acceleration_field.start import Start
from imu_fusion.geometry.rotation import quat_exp, quat_multiply, quat_normalize
from imu_fusion.kernels import njit


@njit
def _walk(x, quat, h, step, factor, acc_factor, every, white, xs, quats):
    """Integrate the mean x (N,) and quat (4,) by steps of h s and their noise.

    step: (4, 4) of the chain; factor (4, 4), acc_factor (2, 2): roots of the noise; white:
    (steps, 4, 6). Every ``every`` steps a row of xs and quats is written.
    """
    s = parts(x)
    for n in range(len(white) + 1):
        if n % every == 0:
            xs[n // every] = x
            quats[n // every] = quat
        if n == len(white):
            break
        # The noise of the chain turns the body too, by its own integral (first row).
        push = factor @ white[n, :, :3]
        phi = mean_rotation(h, step, x) + push[0]
        quat = quat_normalize(quat_multiply(quat, quat_exp(phi)))
        chain = np.zeros((4, 3))
        chain[1], chain[2], chain[3] = s.omega, s.alpha, s.jerk
        chain = step @ chain + push
        s.omega[:], s.alpha[:], s.jerk[:] = chain[1], chain[2], chain[3]
        s.acc[:] += h * s.acc_rate + acc_factor[0, 0] * white[n, 0, 3:]
        s.acc_rate[:] += acc_factor[1, 0] * white[n, 0, 3:] + acc_factor[1, 1] * white[n, 1, 3:]


def draw_motion(params: AccelerationFieldParams, start: Start, samples: int,
                rng: np.random.Generator, substeps: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Draw a motion from the prior of
    :mod:`imu_fusion.estimation.acceleration_field.motion_model`.

    Args:
        params: the motion densities and the sample rate count.
        start: of the estimator: the first state is drawn from it.
        samples: number of samples.
        rng: numpy Generator.
        substeps: steps of the integration within one sample interval.

    Returns:
        (states (samples, N) with biases and mounting at the end, quaternions (samples, 4)).
    """
    mean, cov, quat, _ = start
    variance, vectors = np.linalg.eigh(cov)
    x = mean + vectors @ (np.sqrt(np.maximum(variance, 0.0)) * rng.standard_normal(len(mean)))
    quat = quat_normalize(quat_multiply(quat, quat_exp(parts(x).theta)))
    parts(x).theta[:] = 0.0
    h = 1.0 / params.sample_rate / substeps
    step, noise = motion_step(h, params.motion.rate)
    # Scaled to powers of h, the chain's covariance is well conditioned.
    scale = h ** np.array([3.5, 2.5, 1.5, 0.5])
    factor = scale[:, None] * cholesky(noise / np.outer(scale, scale), lower=True)
    acc_noise = np.array([[h ** 3 / 3, h ** 2 / 2], [h ** 2 / 2, h]])
    xs, quats = np.empty((samples, len(x))), np.empty((samples, 4))
    white = rng.standard_normal(((samples - 1) * substeps, 4, 6))
    _walk(x, quat, h, step, params.motion.jerk_density * factor,
          params.motion.acceleration_rate_density * cholesky(acc_noise, lower=True), substeps,
          white, xs, quats)
    return xs, quats


def ideal_readings(array: SensorArray, states: np.ndarray) -> np.ndarray:
    """Channel readings (n, m) of states (n, N), with biases and mounting and without noise."""
    s = parts(states)
    out = np.empty((len(states), len(array.channels)))
    for c, channel in enumerate(array.channels):
        u, r = channel["direction"], channel["lever"]
        turn, shift = channel["turn"], channel["shift"]
        if turn >= 0:
            u = Rotation.from_rotvec(states[0, turn:turn + 3]).apply(u)
        if channel["scale"] >= 0:
            u = (1.0 + states[0, channel["scale"]]) * u
        if shift >= 0:
            r = r + states[0, shift:shift + 3]
        if channel["is_gyro"]:
            out[:, c] = s.omega @ u
        else:
            out[:, c] = (s.acc + np.cross(s.alpha, r)
                         + np.cross(s.omega, np.cross(s.omega, r))) @ u
    return out + s.fixed[:, :len(array.channels)]
