"""A body at rest: the velocity of its Imu is zero."""

import numpy as np

from imu_fusion.estimation.smoother.measurements.measurement import Measurement, Readings
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.state import VEL
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.kernels import njit


def prepare(stamp: np.ndarray, frame: LocalFrame, params: SmootherParams) -> Readings:
    """Velocities of zero at stamps (m,) ns."""
    root = np.broadcast_to(params.rest.velocity_sd * np.eye(3), (len(stamp), 3, 3))
    return Readings(stamp, np.zeros((len(stamp), 3)), root, np.inf)


@njit
def predict(x, tau, step, model, rows):
    """Velocity (3,) m/s at ``tau`` s after the sample, and its derivative (3, n), into ``rows``,
    where that is zero before."""
    for i in range(3):
        rows.predicted[i] = x[VEL + i] + tau * step.acc_world[i]
        rows.h[i, VEL + i] = 1.0
        if tau != 0.0:
            for e in range(model.n_columns):
                c = model.columns[e]
                rows.h[i, c] += tau / step.dt * step.f_vel[i, c]


MEASUREMENT = Measurement(
    "rest", "velocity at rest", ("east", "north", "up"), prepare,
    "the body may not have been at rest (rest.found: false)")
