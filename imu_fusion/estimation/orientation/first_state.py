"""The fusion filter's first state, from what the first interval says."""

import math

import numpy as np

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation.alignment import Alignment
from imu_fusion.estimation.orientation.measurements import magnetometer
from imu_fusion.kernels import njit

_BIAS_SD_FLOOR = 2e-4      # rad/s: a first second at rest shows no bias better than that
_GRAVITY = 9.81            # m/s^2
_REST_SD = 0.01            # m/s and m: velocity and position at a start at rest


def initialise(state: np.ndarray, par: np.ndarray, alignment: Alignment,
               before: np.void | None = None) -> None:
    """Start from an Alignment. state (1,): zeroed; par (1,): of kernel_parameters; before: the
    state that ended in a gap, of the same hypothesis."""
    s, p, a = state[0], par[0], alignment
    s["began_in_motion"] = not a.at_rest
    s["gyro_bias"] = a.gyr_bias
    s["gravity"] = a.gravity
    s["heading_var"] = es.UNIFORM_VARIANCE
    s["rest"]["mean_rate"] = a.gyr_bias
    sd = np.zeros(es.N)
    # Of a first force in motion a part may be acceleration that lasts, and lean the vertical.
    lasting = 0.0 if a.at_rest else p["lasting_acc_sd"]
    sd[es.ATTITUDE:es.ATTITUDE + 2] = math.hypot(math.sqrt(a.cov_attitude_world[0, 0]),
                                                 lasting / _GRAVITY)
    bias_sd = a.gyr_bias_sd if a.at_rest else p["sensor"]["gyro_bias_sd"]
    sd[es.GYRO_BIAS:es.GYRO_SCALE] = max(bias_sd, _BIAS_SD_FLOOR)
    sd[es.GYRO_SCALE:es.VELOCITY] = p["sensor"]["gyro_scale_sd"]
    sd[es.VELOCITY:es.POSITION] = _REST_SD if a.at_rest else p["fusion"]["velocity_sd"]
    sd[es.POSITION:es.FIELD] = _REST_SD if a.at_rest else p["fusion"]["position_sd"]
    sd[es.MAG_OFFSET:es.ACC_BIAS] = p["fusion"]["mag_offset_sd"]
    sd[es.ACC_BIAS:es.MAG_LAG] = math.hypot(a.acc_bias_sd, lasting)
    sd[es.MAG_LAG] = p["mag_delay_sd"]
    sd[es.MAG_MATRIX:es.CLIPPED_RATE] = p["fusion"]["mag_matrix_sd"]
    s["cov"] = np.diag(sd ** 2)
    iron = s["hard_iron"]
    iron["taken_off"], iron["heading_var"] = iron["offset"], 0.0
    s["cov"][es.MAG_OFFSET:es.ACC_BIAS, es.MAG_OFFSET:es.ACC_BIAS] += iron["cov"]
    if before is not None:
        _keep(s, p, before)
    if a.field_world is not None:
        follow = 1.0 if p["follows_field"] or not a.at_rest else 0.0
        _start_field(state, par, a.field_world, a.has_heading, follow)
        if before is not None and before["scattered"]:
            for name in ("field_scatter", "scattered"):
                s[name] = before[name]
            _doubt_first_needle(state, par)


def _keep(s, p, before):
    """What a gap does not change: the sensors, and what speaks for the hypothesis. A rest shows the
    bias anew."""
    kept = {"gyro_scale": (es.GYRO_SCALE, es.VELOCITY)}
    if s["began_in_motion"]:
        kept["gyro_bias"] = es.GYRO_BIAS, es.GYRO_SCALE
    if p["lasting_acc_sd"] == 0.0:    # else it is motion
        kept["acc_bias"] = es.ACC_BIAS, es.MAG_LAG
    for name, (start, end) in kept.items():
        s[name] = before[name]
        s["cov"][start:end, start:end] = before["cov"][start:end, start:end]
    for name in ("log_likelihood", "position_likelihood"):
        s[name] = before[name]


@njit
def _doubt_first_needle(state, par):
    magnetometer.doubt_first_needle(state[0], par[0])


@njit
def _start_field(state, par, z, has_heading, follow):
    magnetometer.start_field(state[0], par[0], (z[0], z[1], z[2]), has_heading, follow)
