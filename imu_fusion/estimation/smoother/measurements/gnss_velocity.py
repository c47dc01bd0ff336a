"""A GNSS velocity: how fast the antenna was. v + R (w x l) + wandering error, at its stamp less
the delays."""

import numpy as np

from imu_fusion.estimation.smoother.measurements.gnss import chosen, put_gyr_scale, roots, vector
from imu_fusion.estimation.smoother.measurements.measurement import (
    Measurement,
    Readings,
    squared_scale,
)
from imu_fusion.estimation.smoother.motion import cross, put_cross_matrix
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.state import ATT, GYR_BIAS, VEL, slow
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.kernels import njit
from imu_fusion.samples.logs import VelocityLog


def prepare(velocity: VelocityLog, frame: LocalFrame, params: SmootherParams) -> Readings:
    """Finite velocities, in the world.

    Raises:
        SampleError: see :func:`.gnss.roots` and :func:`.gnss.even_stamps`.
    """
    velocity, stamp = chosen(velocity[np.isfinite(velocity.vel_world).all(axis=1)], params)
    return Readings(stamp, velocity.vel_world,
                    roots(velocity.cov_world, params.gnss.velocity_sd, params, "the velocities"),
                    squared_scale(params.gnss))


@njit
def predict(x, tau, step, model, rows):
    """Antenna velocity (3,) m/s at ``tau`` s after the sample, and its derivative (3, n), into
    ``rows``, where that is zero before."""
    blocks, rotation, acc_world = model.blocks, step.rotation, step.acc_world
    lever, rate, h = vector(step.lever_arm), vector(step.rate), rows.h
    swing = cross(rate, lever)
    put_cross_matrix(rotation, swing, -1.0, h, ATT)
    put_cross_matrix(rotation, lever, 1.0, h, GYR_BIAS)
    put_gyr_scale(x, rate, blocks, h)
    if tau != 0.0:
        for i in range(3):
            for e in range(model.n_columns):
                c = model.columns[e]
                h[i, c] += tau / step.dt * step.f_vel[i, c]
    for i in range(3):
        rows.predicted[i] = (x[VEL + i] + tau * acc_world[i] + rotation[i, 0] * swing[0]
                        + rotation[i, 1] * swing[1] + rotation[i, 2] * swing[2])
        h[i, VEL + i] = 1.0
    if blocks.gnss_velocity_error >= 0:
        for i in range(3):
            rows.predicted[i] += slow(x, blocks.gnss_velocity_error + i)
            h[i, blocks.gnss_velocity_error + i] = 1.0
    for delay in (blocks.gnss_time_offset, blocks.velocity_time_offset):
        if delay >= 0:
            for i in range(3):
                h[i, delay] = -acc_world[i]
    if blocks.gnss_lever_arm >= 0:
        put_cross_matrix(rotation, rate, 1.0, h, blocks.gnss_lever_arm)


MEASUREMENT = Measurement(
    "velocity", "velocity", ("east", "north", "up"), prepare,
    "the covariances of the messages (gnss.covariances: false) or gnss.velocity_sd may be "
    "too small, the stamps late (gnss.velocity_time_offset_sd: 0.2 finds it) or filtered "
    "(gnss.velocity_error_sd, gnss.min_interval)",
    delays=("gnss_time_offset", "velocity_time_offset"))
