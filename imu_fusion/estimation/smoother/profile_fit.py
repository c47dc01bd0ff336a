"""Whether the landing profile of a hill is the one that was ridden.

Its heights hold a trajectory so firmly that a profile that is off takes the trajectory along: the
deviations that are left are small. What an error of a given shape would explain tells it.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from imu_fusion.estimation.smoother.jump_events import JumpEvents
from imu_fusion.estimation.smoother.problem import Problem

if TYPE_CHECKING:
    from imu_fusion.estimation.smoother.result import SmootherResult

_GROWS = 1.5     # s, in which an error grows that is none before: other radii
_BEGINS = np.arange(6.0)   # s after touch-down, when it does: short jumps land far before a curve
_JUDGED = 4.0    # s, by which it is judged


class ProfileError(NamedTuple):
    """Metres by which heights of the landing profile seem too large, of a shape, and by how many
    standard deviations that is not zero."""

    metres: float = 0.0
    sds: float = 0.0


def profile_error(problem: Problem, events: JumpEvents) -> ProfileError:
    """The most certain of some errors: of the whole landing, and of what follows the touch-down, or
    some time after it.

    Args:
        problem: solved. events: JumpEvents.
    """
    landing = [c.phase == "landing" and c.height for c in problem.constraints]
    if not any(landing):
        return ProfileError()
    stamp = problem.imu.log.stamp
    sample = np.repeat(np.arange(len(stamp)), np.diff(problem.contact_start))
    since = (stamp - events.touchdown) * 1e-9
    at_rows = since[sample]
    size = float(np.min(problem.contacts["sigma"]))
    found, before, begin = [ProfileError()], 0, None
    for begins in _BEGINS[since[-1] - _GROWS > _BEGINS]:
        first, last = (int(i) for i in np.searchsorted(since, [begins, begins + _JUDGED]))
        begin = problem.carried(first, before, begin)
        before = first
        shapes = [np.clip((at_rows - begins) / _GROWS, 0.0, 1.0)]
        if not begins:
            shapes.append(1.0 * (at_rows > 0.0))
        found += [ProfileError(*problem.shift(size, shape, first, last, begin))
                  for shape in shapes]
    return max(found, key=lambda error: abs(error.sds))


def widened_by_profile(result: "SmootherResult", error: ProfileError) -> "SmootherResult":
    """A result of a jump whose length and heights are less certain by an error of the profile, and
    velocities by what leads to it during the flight."""
    assert result.jump is not None
    samples = result.samples.copy()
    samples["cov_position"][:, 2, 2] += error.metres ** 2
    samples["cov_velocity"][:, 2, 2] += (error.metres / result.jump.flight_time) ** 2
    return replace(result, samples=samples, jump=replace(
        result.jump, length_sd=float(np.hypot(result.jump.length_sd, error.metres))))
