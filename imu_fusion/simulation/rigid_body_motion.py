"""Random motions of a rigid body drawn from the very model of the rigid-body estimator.

For tests of its uncertainty: where the model is right, the errors must be as large as the
estimator says, no more and no less.
"""

import numpy as np
from imu_fusion.kernels import njit
from scipy.linalg import cholesky

from imu_fusion.estimation.acceleration_field.kernel import mean_rotation, motion_step
from imu_fusion.geometry.rotation import quat_exp, quat_multiply, quat_normalize


@njit
def _walk(x, quat, h, step, factor, acc_factor, every, white, xs, quats):
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
        for k in range(1, 4):
            chain[k] = x[3 * k:3 * k + 3]
        chain = step @ chain + push
        for k in range(1, 4):
            x[3 * k:3 * k + 3] = chain[k]
        x[12:15] += h * x[15:18] + acc_factor[0, 0] * white[n, 0, 3:]
        x[15:18] += acc_factor[1, 0] * white[n, 0, 3:] + acc_factor[1, 1] * white[n, 1, 3:]


def draw_motion(params, start, samples, rng, substeps=20):
    """Draw a motion from the prior of :mod:`imu_fusion.estimation.acceleration_field.kernel`.

    Args:
        params: AccelerationFieldParams; the motion densities and the sample rate count.
        start: (x, cov, quat) of the estimator: the first state is drawn from it.
        samples: number of samples.
        rng: numpy Generator.
        substeps: steps of the integration within one sample interval.

    Returns:
        (states (samples, n) with the biases at the end, quaternions (samples, 4)).
    """
    mean, cov, quat = start
    variance, vectors = np.linalg.eigh(cov)
    x = mean + vectors @ (np.sqrt(np.maximum(variance, 0.0)) * rng.standard_normal(len(mean)))
    quat = quat_normalize(quat_multiply(quat, quat_exp(x[:3])))
    x[:3] = 0.0
    h = 1.0 / params.sample_rate / substeps
    step, noise = motion_step(h, params.motion__rate)
    # Scaled to powers of h, the chain's covariance is well conditioned.
    scale = h ** np.array([3.5, 2.5, 1.5, 0.5])
    factor = scale[:, None] * cholesky(noise / np.outer(scale, scale), lower=True)
    acc_noise = np.array([[h ** 3 / 3, h ** 2 / 2], [h ** 2 / 2, h]])
    xs, quats = np.empty((samples, len(x))), np.empty((samples, 4))
    white = rng.standard_normal(((samples - 1) * substeps, 4, 6))
    _walk(x, quat, h, step, params.motion__jerk_density * factor,
          params.motion__acceleration_rate_density * cholesky(acc_noise, lower=True), substeps,
          white, xs, quats)
    return xs, quats


def ideal_readings(layout, states):
    """Channel readings (n, m) of states (n, 18 + m), with biases and without noise."""
    omega, alpha, acc = states[:, 3:6], states[:, 6:9], states[:, 12:15]
    out = np.empty((len(states), len(layout.density)))
    for c, (u, r) in enumerate(zip(layout.direction, layout.lever)):
        if layout.is_gyro[c]:
            out[:, c] = omega @ u
        else:
            out[:, c] = (acc + np.cross(alpha, r) + np.cross(omega, np.cross(omega, r))) @ u
    return out + states[:, 18:]
