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

_GROWS = 1.5     # s after touch-down, in which an error grows that is none there: other radii
_JUDGED = 4_000_000_000    # ns after touch-down, by which it is judged


class ProfileError(NamedTuple):
    """Metres by which heights of the landing profile seem too large, of a shape, and by how many
    standard deviations that is not zero."""

    metres: float = 0.0
    sds: float = 0.0


def profile_error(problem: Problem, events: JumpEvents) -> ProfileError:
    """The most certain of two errors: of the whole landing, and of what follows the touch-down.

    Args:
        problem: solved. events: JumpEvents.
    """
    landing = [c.phase == "landing" and c.height for c in problem.constraints]
    if not any(landing):
        return ProfileError()
    stamp = problem.imu.log.stamp
    first, last = (int(i) for i in np.searchsorted(
        stamp, [events.touchdown, events.touchdown + _JUDGED]))
    sample = np.repeat(np.arange(len(stamp)), np.diff(problem.contact_start))
    since = (stamp[sample] - events.touchdown) * 1e-9
    shapes = (1.0 * (since > 0.0), np.clip(since / _GROWS, 0.0, 1.0))
    size = float(np.min(problem.contacts["sigma"]))
    found = [ProfileError(*problem.shift(size, contacts=shape, first=first, last=last))
             for shape in shapes]
    return max(found, key=lambda error: abs(error.sds))


def widened_by_profile(result: "SmootherResult", error: ProfileError) -> "SmootherResult":
    """A result of a jump whose length and heights are less certain by an error of the profile."""
    assert result.jump is not None
    samples = result.samples.copy()
    samples["cov_position"][:, 2, 2] += error.metres ** 2
    return replace(result, samples=samples, jump=replace(
        result.jump, length_sd=float(np.hypot(result.jump.length_sd, error.metres))))
