"""What is lost of the orientation where forces say nothing of the vertical.

Linear errors do not describe a body that may have turned by more than a radian in a gap: what a
filter then states of the turn about the field shrinks, though nothing tells it. Where the
accelerometer is not used, that turn stays unknown. So does all of the attitude where such a
recording begins in motion, or goes on in motion after a gap in which everything starts anew.
"""

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.estimation.orientation.error_state import UNIFORM_VARIANCE
from imu_fusion.estimation.orientation.params import OrientationParams

#: rad, by which a body may turn unseen before linear errors describe it no longer.
LOST = 1.0


def unseen_turn(params: OrientationParams, gap: float) -> float:
    """rad by which the body may have turned in ``gap`` s without samples; 0 in shorter ones than
    gap.max, and in those after which all starts anew."""
    return params.gap.rate_sd * gap if params.gap.max < gap <= params.gap.restart else 0.0


def is_blind(params: OrientationParams, at_rest: bool) -> bool:
    """Whether a start tells no attitude: in motion, where forces are not to be used."""
    return params.method == "fusion" and not params.fusion.use_acc and not at_rest


def widen_lost(rows: np.ndarray, params: OrientationParams, at_rest: bool) -> None:
    """State in rows (n,) ORIENTATION_DTYPE, in place, what is lost; at_rest: they begin so."""
    if is_blind(params, at_rest):
        rows["cov_attitude"] += UNIFORM_VARIANCE * np.eye(3)
    widen_after_gaps(rows, params)


def widen_after_gaps(rows: np.ndarray, params: OrientationParams) -> None:
    """State in rows (n,) ORIENTATION_DTYPE, in place, that from a gap on in which the body may have
    turned by more than :data:`LOST` the turn about the field is any."""
    steps = np.diff(rows["stamp"]) * 1e-9
    lost = np.flatnonzero([unseen_turn(params, step) > LOST for step in steps.tolist()])
    if params.fusion.use_acc or not len(lost):
        return
    after = rows[lost[0] + 1:]
    seen = after["mag_world"][np.isfinite(after["mag_world"]).all(axis=1)]
    if not len(seen):
        return
    field_imu = scipy.spatial.transform.Rotation.from_quat(after["quat_world_imu"]).inv().apply(
        seen.mean(axis=0) / np.linalg.norm(seen.mean(axis=0)))
    after["cov_attitude"] += UNIFORM_VARIANCE * field_imu[:, :, None] * field_imu[:, None, :]
