"""Which impact was the touch-down: candidates, each smoothed, compared by what they explain.

The largest force after take-off need not be the landing: on a short or soft jump the curve of the
out-run, or braking, is stronger. A wrong touch-down contradicts the hill: while the jumper slides,
a "flight" follows the profile; or the contact is claimed where the trajectory is in the air.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from imu_fusion.estimation.smoother.jump_events import JumpEvents, table_crossing
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.points import at_surface
from imu_fusion.samples.logs import ImuLog
from imu_fusion.surfaces.constraint import Constraint
from imu_fusion.surfaces.hill import Hill

if TYPE_CHECKING:
    from imu_fusion.estimation.smoother.result import SmootherResult

_CLOSE = 0.3          # m above the profile, within which a body is not in the air
FOLLOWS = 0.3         # s, for which a flight may be so close: the last drop takes less
_SHORTEST = 0.3       # s, that a flight takes at least: what is earlier belongs to the push-off
_APART = 0.3          # s, between two impacts
_RISE = 2.0           # m/s^2, of an impact above the force before it
_MOST = 8             # impacts that are tried, the largest
_MISFIT = 1.5         # excess of a surface, from which a contact is doubted
_SPREAD = 1.0         # m, over which heights in the air are spread: what a contact is told from


def likeliest(first: "SmootherResult", hill: Hill, imu: ImuLog, params: SmootherParams,
              smooth: Callable[[JumpEvents], "SmootherResult | None"]) -> "SmootherResult":
    """The result with the likeliest touch-down; the first one unless the hill contradicts it, or
    there was an impact in what is taken for its flight.

    Args:
        first: smoothed with the events that were detected.
        imu: of the recording. params: SmootherParams.
        smooth: result for given events, None where there is none.
    """
    events = first.events
    assert events is not None
    takeoff = table_crossing(hill, first.samples, None) or events.takeoff
    felt = impacts(imu, takeoff)
    if (first.jump is not None and not is_doubtful(first)
            and not np.any(felt < events.touchdown - _APART * 1e9)):
        return first
    tries = [events.touchdown - round(first.near_ground * 1e9), *felt]
    others = [smooth(JumpEvents(takeoff, touchdown)) for touchdown in tries
              if abs(touchdown - events.touchdown) > _APART * 1e9 or first.jump is None]
    results = [r for r in (first, *others) if r is not None and r.jump is not None]
    if not results:
        return first
    return min(results, key=lambda r: unexplained(r, hill.constraints(), params))


def stands_at_touch_down(result: "SmootherResult", constraints: Sequence[Constraint],
                         params: SmootherParams) -> bool:
    """Whether the body is at its height above the profile when it touches down: later heights,
    from which alone that follows, are those of a body that stands."""
    assert result.events is not None
    landing = _landing(constraints)
    touch = np.searchsorted(result.samples["stamp"], result.events.touchdown)
    return bool(abs(_height(result.samples, result.states, landing, params)[touch]) < _CLOSE)


def is_doubtful(result: "SmootherResult") -> bool:
    """Whether a flight follows the profile, or a landing does not."""
    fit = result.surface.get("landing")
    return fit is None or fit.excess > _MISFIT or result.near_ground > FOLLOWS


def near_ground(samples: np.ndarray, states: dict[str, tuple[np.ndarray, np.ndarray]],
                events: JumpEvents, constraints: Sequence[Constraint], params: SmootherParams
                ) -> float:
    """For how long, in s, until the touch-down a flight is close to the landing profile, or below.

    Args:
        samples, states, events: of the SmootherResult. constraints: of the hill.
        params: SmootherParams.
    """
    stamp = samples["stamp"]
    height = _height(samples, states, _landing(constraints), params)
    air = (stamp > events.takeoff + _SHORTEST * 1e9) & (stamp < events.touchdown)
    high = np.flatnonzero(air & ~(height < _CLOSE))
    began = stamp[high[-1]] if len(high) else np.min(stamp[air], initial=events.touchdown)
    return float(events.touchdown - began) * 1e-9


def impacts(imu: ImuLog, takeoff: int) -> np.ndarray:
    """Stamps (k,) ns of the peaks of force after a take-off, the largest rises first."""
    after = imu.stamp > takeoff + _SHORTEST * 1e9
    stamp, force = imu.stamp[after], np.linalg.norm(imu.acc[after], axis=1)
    rises: list[tuple[float, int]] = []
    for i in np.argsort(-force, kind="stable"):
        if all(abs(int(stamp[i]) - other) > _APART * 1e9 for _, other in rises):
            before = force[(stamp < stamp[i]) & (stamp > stamp[i] - 2 * _APART * 1e9)]
            rise = force[i] - np.median(before) if len(before) else 0.0
            if rise > _RISE:
                rises.append((rise, int(stamp[i])))
        if len(rises) == 3 * _MOST:
            break
    return np.array([at for _, at in sorted(rises, reverse=True)[:_MOST]], np.int64)


def unexplained(result: "SmootherResult", constraints: Sequence[Constraint],
                params: SmootherParams) -> float:
    """Negative log-likelihood of the touch-down of a result, up to a constant of the recording.

    The cost alone would favour the shortest contact. A row of contact is normal about the
    surface, where a height in the air is spread over metres: each expected height counts for
    contact by the ratio of the two densities. Nothing flies below the ground: there a height
    counts as it would in contact.
    """
    assert result.events is not None
    stamp, events = result.samples["stamp"], result.events
    step = np.median(np.diff(stamp)) * 1e-9 / params.surface.interval
    lasting = max(0.0, (stamp[-1] - events.touchdown) * 1e-9 - params.jump.event_margin)
    air = (stamp > events.takeoff + _SHORTEST * 1e9) & (
        stamp < events.touchdown + params.jump.event_margin * 1e9)
    cost = result.cost[-1]
    for constraint in constraints:
        if constraint.phase != "landing":
            continue
        height = _height(result.samples, result.states, constraint, params)[air]
        below = np.minimum(height, 0.0) / constraint.sigma
        cost += step * np.nansum(np.log1p(0.5 * below ** 2))
        fit = result.surface.get(constraint.name)
        if fit is not None:
            # Who falls, or sinks deeply, is beside the profile for a while and yet has landed.
            squares = 0.5 * (fit.residual / constraint.sigma) ** 2
            cost -= step * np.sum(squares - np.log1p(squares))
        cost -= lasting / params.surface.interval * np.log(
            _SPREAD / (np.sqrt(2.0 * np.pi) * constraint.sigma))
    return float(cost)


def _landing(constraints):
    return next(c for c in constraints if c.phase == "landing" and c.height)


def _height(samples, states, landing, params):
    """Heights (n,) m of the body above the landing profile."""
    points = at_surface(samples, states, params)["position_world"]
    return landing.evaluate(points)[0] - params.surface.body_height
