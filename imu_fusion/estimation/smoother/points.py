"""Points of the body beside the sensor: what is held on a surface, and the antenna."""

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.estimation.smoother.measurements.surface_contact import surface_points
from imu_fusion.estimation.smoother.params import SmootherParams

_States = dict[str, tuple[np.ndarray, np.ndarray]]


def at_surface(samples: np.ndarray, states: _States, params: SmootherParams) -> np.ndarray:
    """Samples whose position and velocity, with covariances, are those of the point that is held
    on the surface.

    Args:
        samples, states: of the SmootherResult.
        params: SmootherParams.
    """
    given = np.array(params.surface.lever_arm), 0.0
    return _at_point(samples, *states.get("surface_lever_arm", given))


def at_antenna(samples: np.ndarray, states: _States, params: SmootherParams) -> np.ndarray:
    """As :func:`at_surface`, of the antenna."""
    given = np.array(params.gnss.lever_arm), 0.0
    return _at_point(samples, *states.get("gnss_lever_arm", given))


def _at_point(samples, lever, lever_sd):
    """At p + R l, v + R (w x l), for a lever arm (3,) or (n, 3) m.

    The errors of position, velocity, attitude, lever arm and rate count as uncorrelated. Across
    a surface they are not, and the point is known better than that.
    """
    if not np.any(lever):
        return samples
    lever = np.broadcast_to(lever, samples["position_world"].shape)
    lever_cov = np.broadcast_to(lever_sd, lever.shape)[:, None] ** 2 * np.eye(3)
    gyr_cov = samples["gyr_sd"][:, None] ** 2 * np.eye(3)
    turn = scipy.spatial.transform.Rotation.from_quat(samples["quat_world_imu"]).as_matrix()
    swing = np.cross(samples["gyr"], lever)

    def crossed(v):
        """R [v]x: the rows of R, each crossed with v."""
        return np.cross(turn, v[:, None])

    moved = samples.copy()
    moved["position_world"] = surface_points(samples["position_world"],
                                             samples["quat_world_imu"], lever)
    moved["vel_world"] += np.einsum("nij,nj->ni", turn, swing)
    for name, parts in (
            ("cov_position", ((crossed(lever), samples["cov_attitude"]), (turn, lever_cov))),
            ("cov_velocity", ((crossed(swing), samples["cov_attitude"]),
                              (crossed(lever), gyr_cov), (crossed(samples["gyr"]), lever_cov)))):
        for by, cov in parts:
            moved[name] += by @ cov @ by.swapaxes(1, 2)
    return moved
