"""How well a smoothed trajectory keeps to its surface."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.smoother.inputs import evaluate_constraints, surface_points

_STRETCH = 1.0  # s, over which deviations are averaged: slower than what the Imu itself holds


@dataclass(frozen=True)
class SurfaceFit:
    """Deviations from one constraint: ``sample`` (r,) index where it holds, ``residual`` (r,) m
    less the body's height, their RMS ``rms`` m, ``largest`` m, ``sigma`` m of the surface.

    ``excess``: RMS of the means over stretches of a second (``surface_interval`` if longer), by
    the standard deviation that sigma gives such a mean. The smoother pulls the trajectory to
    the surface, so a surface that fits leaves less than 1.
    """

    sample: np.ndarray
    residual: np.ndarray
    sigma: float
    rms: float
    largest: float
    excess: float


def at_surface(samples, states, params):
    """Samples whose ``position_world``, ``vel_world`` and ``cov_position`` are those of the point
    that is held on the surface: p + R l, v + R (w x l).

    The errors of position, attitude and lever arm count as uncorrelated. Across the surface
    they are not, and the point is known better than that.

    Args:
        samples, states: of the SmootherResult.
        params: SmootherParams.
    """
    lever, sd = states.get("surface_lever_arm", (np.array(params.surface_lever_arm), 0.0))
    if not np.any(lever):
        return samples
    lever = np.broadcast_to(lever, samples["position_world"].shape)
    turn = Rotation.from_quat(samples["quat_world_imu"])
    # Rows of R [l]x are those of R, crossed with l.
    arm = np.cross(turn.as_matrix(), lever[:, None])
    moved = samples.copy()
    moved["position_world"] = surface_points(samples["position_world"],
                                             samples["quat_world_imu"], lever)
    moved["vel_world"] += turn.apply(np.cross(samples["gyr"], lever))
    spread = turn.as_matrix() * np.broadcast_to(sd, lever.shape)[:, None]
    moved["cov_position"] += (arm @ samples["cov_attitude"] @ arm.swapaxes(1, 2)
                              + spread @ spread.swapaxes(1, 2))
    return moved


def surface_fits(constraints, samples, states, events, params):
    """Name of the constraint -> :class:`SurfaceFit`, for those that hold anywhere.

    Args:
        constraints: of the surface. samples, states, events: of the SmootherResult.
        params: SmootherParams.
    """
    fits = {}
    position_world = at_surface(samples, states, params)["position_world"]
    for constraint in constraints:
        start, residual, _, sigma, _ = evaluate_constraints(
            [constraint], position_world, samples["stamp"], events, params)
        if not len(residual):
            continue
        sample = np.repeat(np.arange(len(samples)), np.diff(start))
        if constraint.height:
            height = states["body_height"][0][sample, 0] if "body_height" in states \
                else params.body_height
            residual = residual - height
        fits[constraint.name] = SurfaceFit(
            sample, residual, constraint.sigma, float(np.sqrt(np.mean(residual ** 2))),
            float(np.abs(residual).max()),
            _excess(samples["stamp"][sample], residual, sigma, params.surface_interval))
    return fits


def _excess(stamp, residual, sigma, interval):
    stretch = (stamp - stamp[0]) // round(max(_STRETCH, interval) * 1e9)
    stretch = np.unique(stretch, return_inverse=True)[1]
    information = np.bincount(stretch, 1.0 / sigma ** 2)
    means = np.bincount(stretch, residual / sigma ** 2)
    # The last stretch, or one with a gap, is a part of one.
    whole = information > 0.5 * np.median(information)
    return float(np.sqrt(np.mean(means[whole] ** 2 / information[whole])))
