"""A fix: where the antenna was. p + R l + wandering error, at its stamp less the delay."""

from imu_fusion.estimation.smoother.measurements.gnss import chosen, put_gyr_scale, roots, vector
from imu_fusion.estimation.smoother.measurements.measurement import (
    Measurement,
    Readings,
    squared_scale,
)
from imu_fusion.estimation.smoother.motion import cross, put_cross_matrix
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.state import ATT, GYR_BIAS, POS, VEL, slow
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.kernels import njit
from imu_fusion.samples.logs import FixLog


def prepare(fix: FixLog, frame: LocalFrame, params: SmootherParams) -> Readings:
    """Usable fixes, as positions in the world.

    Raises:
        SampleError: see :func:`.gnss.roots` and :func:`.gnss.even_stamps`.
    """
    fix, stamp = chosen(fix[fix.usable], params)
    return Readings(stamp, frame.to_enu(fix.latitude_deg, fix.longitude_deg, fix.height),
                    roots(fix.cov_enu, params.gnss.fix_sd, params, "the fixes"),
                    squared_scale(params.gnss))


@njit
def predict(x, tau, step, model, rows):
    """Antenna position (3,) m at ``tau`` s after the sample, and its derivative (3, n), into
    ``rows``, where that is zero before.

    The acceleration's derivatives times tau^2 / 2 are left out (:func:`.magnetometer.predict` says
    what that does): at 10 ms 5e-5 m per m/s^2 of bias, 0.005 sd with 300 fixes good to 1 cm.
    """
    blocks, rotation, acc_world = model.blocks, step.rotation, step.acc_world
    lever, rate, h = vector(step.lever_arm), vector(step.rate), rows.h
    swing = cross(rate, lever)
    arm = (lever[0] + tau * swing[0], lever[1] + tau * swing[1], lever[2] + tau * swing[2])
    for i in range(3):
        rows.predicted[i] = (x[POS + i] + tau * (x[VEL + i] + 0.5 * tau * acc_world[i])
                        + rotation[i, 0] * arm[0] + rotation[i, 1] * arm[1]
                        + rotation[i, 2] * arm[2])
        h[i, POS + i] = 1.0
        h[i, VEL + i] = tau
    put_cross_matrix(rotation, arm, -1.0, h, ATT)
    put_cross_matrix(rotation, lever, tau, h, GYR_BIAS)
    put_gyr_scale(x, rate, blocks, h)
    if blocks.gnss_position_error >= 0:
        for i in range(3):
            rows.predicted[i] += slow(x, blocks.gnss_position_error + i)
            h[i, blocks.gnss_position_error + i] = 1.0
    if blocks.gnss_time_offset >= 0:
        for i in range(3):
            h[i, blocks.gnss_time_offset] = -(
                x[VEL + i] + tau * acc_world[i] + rotation[i, 0] * swing[0]
                + rotation[i, 1] * swing[1] + rotation[i, 2] * swing[2])
    if blocks.gnss_lever_arm >= 0:
        put_cross_matrix(rotation, rate, tau, h, blocks.gnss_lever_arm)
        for i in range(3):
            for j in range(3):
                h[i, blocks.gnss_lever_arm + j] += rotation[i, j]


MEASUREMENT = Measurement(
    "fix", "position", ("east", "north", "up"), prepare,
    "the covariances of the messages (gnss.covariances: false) or gnss.fix_sd may be too small, "
    "the stamps late (gnss.time_offset_sd: 0.2 finds it) or the errors wander "
    "(gnss.position_error_sd)",
    delays=("gnss_time_offset",))
