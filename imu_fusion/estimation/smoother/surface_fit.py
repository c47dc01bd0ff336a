"""How well a smoothed trajectory keeps to its surface."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.smoother.jump_events import JumpEvents
from imu_fusion.estimation.smoother.measurements.surface_contact import (
    evaluate_constraints,
    holds,
)
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.points import at_surface
from imu_fusion.surfaces.constraint import Constraint

_STRETCH = 1.0  # s, over which deviations are averaged: slower than what the Imu itself holds


@dataclass(frozen=True)
class SurfaceFit:
    """Deviations from one constraint: ``sample`` (r,) index where it holds, ``residual`` (r,) m
    less the body's height, their RMS ``rms`` m, ``largest`` m, ``sigma`` m of the surface.

    ``excess``: RMS of the means over stretches of a second (``surface.interval`` if longer), by
    the standard deviation that sigma gives such a mean. The smoother pulls the trajectory to
    the surface, so a surface that fits leaves less than 1.
    ``first_excess``: the same of stretches of a fifth of a second, over the first second in which
    it holds: a body that lands may sink or fall against what it stands on.
    ``silent``: share of the samples at which the constraint should hold, but the surface says
    nothing (outside of an elevation grid).
    """

    sample: np.ndarray
    residual: np.ndarray
    sigma: float
    rms: float
    largest: float
    excess: float
    first_excess: float = 0.0
    silent: float = 0.0


def surface_fits(constraints: Sequence[Constraint], samples: np.ndarray,
                 states: dict[str, tuple[np.ndarray, np.ndarray]], events: JumpEvents | None,
                 params: SmootherParams, free: np.ndarray | None = None
                 ) -> dict[str, SurfaceFit]:
    """Name of the constraint -> :class:`SurfaceFit`, for those that hold anywhere.

    Args:
        constraints: of the surface. samples, states, events: of the SmootherResult.
        params: SmootherParams. free: mask of the samples in free fall.

    Raises:
        EstimationError: none holds anywhere, though there are some.
    """
    fits = {}
    position_world = at_surface(samples, states, params)["position_world"]
    for constraint in constraints:
        start, contacts = evaluate_constraints(
            [constraint], position_world, samples["stamp"], events, params, free)
        residual = contacts["residual"]
        if not len(residual):
            continue
        sample = np.repeat(np.arange(len(samples)), np.diff(start))
        active = holds(constraint, samples["stamp"], events, params.surface.windows,
                       params.jump.event_margin, free)
        if constraint.height:
            height = states["body_height"][0][sample, 0] if "body_height" in states \
                else params.surface.body_height
            residual = residual - height
        stamp, interval = samples["stamp"][sample], params.surface.interval
        first = stamp < stamp[0] + _STRETCH * 1e9
        fits[constraint.name] = SurfaceFit(
            sample, residual, constraint.sigma, float(np.sqrt(np.mean(residual ** 2))),
            float(np.abs(residual).max()),
            _excess(stamp, residual, contacts["sigma"], max(_STRETCH, interval)),
            _excess(stamp[first], residual[first], contacts["sigma"][first],
                    max(0.2 * _STRETCH, interval)),
            1.0 - len(residual) / active.sum())
    if constraints and not fits:
        raise EstimationError("the surface says nothing at any sample of this recording: an "
                              "elevation grid must reach the trajectory (see its crs and extent), "
                              "surface.windows must lie within the recording")
    return fits


def misfit_at_landing(fits: dict[str, SurfaceFit]) -> float:
    """Factor, at least 1, by which a landing off its profile makes a jump less certain: the ratio
    of deviations to what they should be (Birge's), of the first second or of all."""
    fit = fits.get("landing")
    return 1.0 if fit is None else max(1.0, fit.first_excess, fit.excess)


def _excess(stamp, residual, sigma, length):
    stretch = (stamp - stamp[0]) // round(length * 1e9)
    stretch = np.unique(stretch, return_inverse=True)[1]
    information = np.bincount(stretch, 1.0 / sigma ** 2)
    means = np.bincount(stretch, residual / sigma ** 2)
    # The last stretch, or one with a gap, is a part of one.
    whole = information > 0.5 * np.median(information)
    return float(np.sqrt(np.mean(means[whole] ** 2 / information[whole])))
