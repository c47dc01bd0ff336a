"""Filter, smoother and maximum likelihood of the rigid-body model of acceleration fields.

The model and its kernels are in :mod:`imu_fusion.estimation.acceleration_field.kernel`; here
they are given memory and order.
"""

import numpy as np
from imu_fusion.kernels import njit
from scipy.optimize import minimize

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.acceleration_field.kernel import (TOUCHED, backward, channel_row,
                                                             forward)
from imu_fusion.estimation.acceleration_field.rows import (GAP, MISSING, SATURATED, VALUES,
                                                           put_row, rigid_gradient)
from imu_fusion.estimation.acceleration_field.start import motion_spread
from imu_fusion.geometry.rotation import quat_exp, quat_multiply, quat_normalize

# Samples whose covariances the smoother keeps at a time; others are filtered again when needed.
_CHUNK = 256


def _trace(samples, size, channels):
    return (np.zeros((samples, size)), np.zeros((samples, size, size)), np.zeros((samples, 3)),
            np.zeros(samples), np.zeros((samples, channels, size)), np.zeros((samples, channels)),
            np.zeros((samples, channels)), np.zeros((samples, channels, TOUCHED)))


def noise_variance(params, layout):
    """Variance of one sample of each channel, (m,)."""
    return (params.noise_scale * layout.density) ** 2 * params.sample_rate


class RigidBodyFilter:
    """The causal extended Kalman filter: a start, then samples in order."""

    def __init__(self, params, layout, start):
        x, cov, quat = start
        self._params = params
        self._layout = layout
        self.state = {"x": x.copy(), "cov": cov.copy(), "quat": quat.copy(),
                      "last": np.array([-1], dtype=np.int64)}
        self._spread = motion_spread(params)
        self._one = _trace(1, len(x), len(layout.density))

    def process(self, stamp, readings):
        """Rows' values (n, 71) and flags (n,) of samples: stamp (n,), readings (n, m)."""
        values = np.empty((len(stamp), VALUES))
        flags = np.empty(len(stamp), dtype=np.uint32)
        self.forward(stamp, readings, np.zeros((1, 3)), False, values, flags, self._one)
        return values, flags

    def forward(self, stamp, readings, at, fixed_at, values, flags, trace):
        """The kernel with this filter's state; see the kernel for the arguments."""
        p, l, s = self._params, self._layout, self.state
        return forward(s["x"], s["cov"], s["quat"], s["last"], stamp, readings, l.is_gyro,
                       l.direction, l.lever, noise_variance(p, l), l.range,
                       l.bias_walk, p.motion__jerk_density, p.motion__rate,
                       p.motion__acceleration_rate_density, p.max_gap, self._spread, at, fixed_at,
                       l.reference, p.gravity, l.specific_force, values, flags, trace)


_NO_VALUES, _NO_FLAGS = np.empty((0, VALUES)), np.empty(0, dtype=np.uint32)


def smooth(params, layout, start, stamp, readings):
    """The iterated smoother: rows' values (n, 71) and flags (n,) given all samples.

    The readings are linearised at the smoothed angular velocity of the previous iteration
    (Gauss-Newton on the posterior), until it moves by less than a thousandth of its standard
    deviation or ``smoother.iterations`` are used up. The attitude is the integral of the smoothed
    angular velocity, by Hermite quadrature and the fourth-order Magnus expansion.

    Args:
        start: (x, cov, quat) before the first sample.
        stamp: (n,) int64 ns.
        readings: (n, m), NaN for missing channels.
    """
    at = np.zeros((len(stamp), 3))
    for iteration in range(params.smoother__iterations):
        mean, cov = _smooth_once(params, layout, start, stamp, readings, at, iteration > 0)
        moved = np.abs(mean[:, 3:6] - at)
        at = np.ascontiguousarray(mean[:, 3:6])
        variance = np.einsum("nii->ni", cov)[:, 3:6]
        if iteration > 0 and np.all(moved ** 2 <= 1e-6 * variance):
            break
    values = np.empty((len(stamp), VALUES))
    flags = np.zeros(len(stamp), dtype=np.uint32)
    _put_smoothed(stamp, readings, mean, cov, start[2].copy(), layout.is_gyro, layout.direction,
                  layout.lever, noise_variance(params, layout), layout.range,
                  params.max_gap, layout.reference, params.gravity, layout.specific_force, values,
                  flags)
    return values, flags


def _smooth_once(params, layout, start, stamp, readings, at, fixed_at):
    size, channels = len(start[0]), len(layout.density)
    keeper = RigidBodyFilter(params, layout, start)
    trace = _trace(min(_CHUNK, len(stamp)), size, channels)
    bounds = [(i, min(i + _CHUNK, len(stamp))) for i in range(0, len(stamp), _CHUNK)]
    checkpoints = []
    for i, j in bounds:
        checkpoints.append({k: v.copy() for k, v in keeper.state.items()})
        keeper.forward(stamp[i:j], readings[i:j], at[i:j], fixed_at, _NO_VALUES, _NO_FLAGS,
                       trace)
    mean = np.empty((len(stamp), size))
    cov = np.empty((len(stamp), 18, 18))
    adjoint, information = np.zeros((size, 1)), np.zeros((size, size))
    for (i, j), checkpoint in zip(reversed(bounds), reversed(checkpoints)):
        keeper.state = checkpoint
        part = tuple(a[:j - i] for a in trace)
        keeper.forward(stamp[i:j], readings[i:j], at[i:j], fixed_at, _NO_VALUES, _NO_FLAGS, part)
        backward(adjoint, information, part, params.motion__rate, layout.is_gyro,
                 layout.direction, layout.lever, mean[i:j], cov[i:j])
    return mean, cov


@njit
def _put_smoothed(stamp, readings, mean, cov, quat, is_gyro, direction, lever, variance, ranges,
                  max_gap, reference, gravity, specific_force, values, flags):
    index = np.empty(TOUCHED, np.int64)
    row = np.empty(TOUCHED)
    quat[:] = quat_normalize(quat_multiply(quat, quat_exp(mean[0, 0:3])))
    x = np.zeros(18)
    for n in range(len(stamp)):
        if n > 0:
            dt = (stamp[n] - stamp[n - 1]) * 1e-9
            w0, w1 = mean[n - 1, 3:6], mean[n, 3:6]
            if dt > max_gap:
                flags[n] |= GAP
            else:
                phi = (0.5 * dt * (w0 + w1)
                       + dt * dt / 12.0 * (mean[n - 1, 6:9] - mean[n, 6:9] + np.cross(w0, w1)))
                quat[:] = quat_normalize(quat_multiply(quat, quat_exp(phi)))
        squares, used = 0.0, 0
        for c in range(len(variance)):
            if np.isnan(readings[n, c]):
                flags[n] |= MISSING
                continue
            if abs(readings[n, c]) >= ranges[c]:
                flags[n] |= SATURATED
                continue
            count, constant = channel_row(is_gyro[c], direction[c], lever[c], c, mean[n, 3:6],
                                          index, row)
            residual = readings[n, c] - constant
            for k in range(count):
                residual -= row[k] * mean[n, index[k]]
            squares += residual * residual / variance[c]
            used += 1
        x[3:18] = mean[n, 3:18]
        put_row(values[n], rigid_gradient(x[3:6], x[6:9]), x, cov[n], quat, reference, gravity,
                specific_force, np.sqrt(squares / used) if used > 0 else np.nan)


def log_likelihood(params, layout, start, stamp, readings):
    """Log likelihood of the readings under the causal filter, a float."""
    keeper = RigidBodyFilter(params, layout, start)
    trace = _trace(min(_CHUNK, len(stamp)), len(start[0]), len(layout.density))
    return sum(keeper.forward(stamp[i:i + _CHUNK], readings[i:i + _CHUNK], np.zeros((1, 3)),
                              False, _NO_VALUES, _NO_FLAGS, trace)
               for i in range(0, len(stamp), _CHUNK))


def fit_densities(params, layout, make_start, stamp, readings):
    """Maximum likelihood of the motion model and, if asked, of a common scale of the noise.

    Args:
        params: ``maximum_likelihood`` names what is fitted: ``motion`` (jerk_density,
            acceleration_rate_density and, unless it is zero, rate) or ``motion_and_noise``
            (noise_scale as well). Its values are where the search begins.
        make_start: function of the parameters that returns the start (its spread depends on
            the densities).

    Returns:
        The parameters with the fitted values.

    Raises:
        EstimationError: fewer than ten samples, or no maximum.
    """
    if len(stamp) < 10:
        raise EstimationError(f"maximum likelihood: {len(stamp)} samples are too few, give ten or "
                              "more, or set the motion densities")
    names = ["motion__jerk_density", "motion__acceleration_rate_density"]
    if params.motion__rate > 0:
        names.append("motion__rate")
    if params.maximum_likelihood == "motion_and_noise":
        names.append("noise_scale")
    first = np.log([getattr(params, name) for name in names])

    def candidate(logs):
        return params.replace(**dict(zip(names, np.exp(logs).tolist())))

    def cost(logs):
        if np.any(np.abs(logs - first) > 20):
            return np.inf
        chosen = candidate(logs)
        return -log_likelihood(chosen, layout, make_start(chosen), stamp, readings)

    # Five per cent in the densities changes no estimate noticeably; half a unit of log
    # likelihood is half a standard deviation of a parameter.
    found = minimize(cost, first, method="Nelder-Mead",
                     options={"xatol": 0.05, "fatol": 0.5,
                              "initial_simplex": np.vstack([first, first + np.eye(len(first))])})
    if not np.isfinite(found.fun):
        raise EstimationError("maximum likelihood: no finite likelihood; check the units of the "
                              "readings and of the noise densities")
    return candidate(found.x)
