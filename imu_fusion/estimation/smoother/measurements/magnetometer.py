"""A magnetometer sample: the field of the Earth in the axes of the sensor, scaled and biased."""

import numpy as np

from imu_fusion.estimation.smoother.measurements.measurement import (
    Measurement,
    Readings,
    squared_scale,
)
from imu_fusion.estimation.smoother.motion import cross
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.state import ATT, slow
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.kernels import njit
from imu_fusion.samples.logs import MagLog

#: Magnetic states and rows are kept in microtesla, near one in size.
MICRO = 1e6


def prepare(mag: MagLog, frame: LocalFrame, params: SmootherParams) -> Readings:
    """Finite samples, in microtesla. Their own covariances are not used."""
    mag = mag[np.isfinite(mag.mag).all(axis=1)]
    root = np.broadcast_to(params.sensor.mag_noise_sd * MICRO * np.eye(3), (len(mag), 3, 3))
    return Readings(mag.stamp, mag.mag * MICRO, root, squared_scale(params.mag))


@njit
def predict(x, tau, step, model, rows):
    """Reading (3,) at ``tau`` s after the sample (Fang 2020, eq. 50), and its derivative (3, n),
    into ``rows``, where that is zero before.

    With the field F in sensor axes: (1 + s) (G + a x G) + b, G = F - tau w x F, where the
    magnetometer is turned by -a (small: linear) against the Imu. What the errors of the
    gyroscope turn F by within tau (0.5 uT per rad/s at 10 ms) is left out of h. Residuals are
    exact, so N readings whose entries lack e shift a state by some sqrt(N) e sd / sigma of its
    standard deviation sd: 0.005 for the bias in a jump (N 2700, sigma 5 uT, sd 1e-3 rad/s).
    """
    blocks, rate, h = model.blocks, step.rate, rows.h
    field = _field(step.rotation, model.magnetic_field)
    swing = cross(rate, field)
    turned = (field[0] - tau * swing[0], field[1] - tau * swing[1], field[2] - tau * swing[2])
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        h[i, ATT + a] = -field[b]
        h[i, ATT + b] = field[a]
    if tau != 0.0:
        along = tau * (rate[0] * field[0] + rate[1] * field[1] + rate[2] * field[2])
        for i in range(3):
            # An error d of the attitude turns F by F x d, and w x (F x d) = F (w d) - d (w F).
            for j in range(3):
                h[i, ATT + j] -= tau * field[i] * rate[j]
            h[i, ATT + i] += along
    seen = turned
    if blocks.mag_axes >= 0:
        axes = (slow(x, blocks.mag_axes), slow(x, blocks.mag_axes + 1),
                slow(x, blocks.mag_axes + 2))
        seen = _turned(axes, turned)
        for j in range(3):
            h[0, ATT + j], h[1, ATT + j], h[2, ATT + j] = _turned(
                axes, (h[0, ATT + j], h[1, ATT + j], h[2, ATT + j]))
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        scale = 1.0 + slow(x, blocks.mag_scale + i)
        rows.predicted[i] = scale * seen[i] + slow(x, blocks.mag_bias + i)
        for j in range(3):
            h[i, ATT + j] *= scale
        h[i, blocks.mag_scale + i] = seen[i]
        h[i, blocks.mag_bias + i] = 1.0
        if blocks.mag_axes >= 0:
            h[i, blocks.mag_axes + a] = scale * turned[b]
            h[i, blocks.mag_axes + b] = -scale * turned[a]


@njit
def _turned(axes, v):
    """v + axes x v, a tuple: turned by a small rotation vector."""
    swing = cross(axes, v)
    return v[0] + swing[0], v[1] + swing[1], v[2] + swing[2]


@njit
def _field(rotation, field_world):
    """The field in the axes of the sensor, a tuple."""
    return (rotation[0, 0] * field_world[0] + rotation[1, 0] * field_world[1]
            + rotation[2, 0] * field_world[2],
            rotation[0, 1] * field_world[0] + rotation[1, 1] * field_world[1]
            + rotation[2, 1] * field_world[2],
            rotation[0, 2] * field_world[0] + rotation[1, 2] * field_world[1]
            + rotation[2, 2] * field_world[2])


MEASUREMENT = Measurement(
    "mag", "magnetic field", ("x", "y", "z"), prepare,
    "the field may be disturbed, or sensor.mag_noise_sd, mag_bias_sd and mag_scale_sd too small")
