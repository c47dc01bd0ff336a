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

    With the field F in sensor axes: (1 + s) (F - tau w x F) + b. What the errors of the
    gyroscope turn F by within tau (0.5 uT per rad/s at 10 ms) is left out of h. Residuals are
    exact, so N readings whose entries lack e shift a state by some sqrt(N) e sd / sigma of its
    standard deviation sd: 0.005 for the bias in a jump (N 2700, sigma 5 uT, sd 1e-3 rad/s).
    """
    blocks, rate, h = model.blocks, step.rate, rows.h
    field = _field(step.rotation, model.magnetic_field)
    swing = cross(rate, field)
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        turned = field[i] - tau * swing[i]
        scale = 1.0 + slow(x, blocks.mag_scale + i)
        rows.predicted[i] = scale * turned + slow(x, blocks.mag_bias + i)
        h[i, ATT + a] = -scale * field[b]
        h[i, ATT + b] = scale * field[a]
        h[i, blocks.mag_scale + i] = turned
        h[i, blocks.mag_bias + i] = 1.0
    if tau != 0.0:
        along = tau * (rate[0] * field[0] + rate[1] * field[1] + rate[2] * field[2])
        for i in range(3):
            # An error d of the attitude turns F by F x d, and w x (F x d) = F (w d) - d (w F).
            scale = 1.0 + slow(x, blocks.mag_scale + i)
            for j in range(3):
                h[i, ATT + j] -= scale * tau * field[i] * rate[j]
            h[i, ATT + i] += scale * along


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
