"""The iterated smoother: Gauss-Newton on one explicit cost.

    J = 1/2 [ sum of squared normalised process noise + squared normalised initial error
              + sum over fixes, velocities and magnetometer readings of loss(residual)
              + sum over constraint rows of (residual / sigma)^2 ]

An extended Kalman filter gives the first trajectory. Each step linearises the motion and
all rows about the last trajectory and solves the linear problem exactly, by a filter
forward and the Bryson-Frazier pass back (:mod:`.linear_solve`); between samples the trajectory
may gape (multiple shooting), and the step closes the gaps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from imu_fusion.estimation.smoother.jump_events import JumpEvents
from imu_fusion.estimation.smoother.problem import Change, Problem
from imu_fusion.estimation.smoother.surface_follower import follow_surface

_HELD_SD = 1e-6               # s, of a delay that is not estimated yet
_SETTLED = 0.01               # relative change of the cost with which delays are let go
#: Times the sigma of a rough surface by which it counts before its own: ways to begin, of which the
#: one is taken that ends with the least cost.
SOFTNESS: tuple[tuple[float, ...], ...] = ((), (3.0,), (10.0, 3.0))
_SOFT_STEPS = 8
_CYCLE = 0.1                  # of a step's change of the cost: two steps that end so near cycle
_NEAR = 3.0                   # tolerances: after such a step the next is likely the last


@dataclass(frozen=True)
class Solution:
    """How the iteration ended: the events used last, the number of steps, and the last Change."""

    events: JumpEvents | None
    steps: int
    converged: bool
    last: Change


class _Delays:
    """Delays of stamps during an iteration. As loose as their prior they would explain at first
    what the attitude still has wrong: they are held at zero until the cost has settled."""

    def __init__(self, problem: Problem):
        self._problem, self._prior_sd = problem, problem.prior.sd
        indices = problem.delays
        self.held = self.any = bool(indices)
        self._binding = self.any
        held_sd = self._prior_sd.copy()
        held_sd[indices] = _HELD_SD
        problem.prior_sd = held_sd

    def attach(self) -> None:
        """Place the readings in time, for the delays found so far."""
        if self.any:
            self._problem.attach(self._binding)

    def release(self) -> None:
        """Estimate them from now on."""
        self._problem.prior_sd, self.held = self._prior_sd, False

    def check_cycle(self, cost: list[float], first: int, change: float) -> None:
        """Leave readings with their samples once steps go to and fro.

        Readings that change their sample as a delay is found put kinks into the cost, at which
        steps may cross and cross again: two of them bring the cost back.

        Args:
            cost: before each step; those from ``first`` on can be compared. change: by the last.
        """
        if not self.held and len(cost) > first + 3 and change <= _SETTLED * cost[-1]:
            back = abs(cost[-1] - cost[-3])
            self._binding = self._binding and back > _CYCLE * change


def _settle_softly(problem, events, softness):
    """Let a trajectory settle on a rough surface that counts little at first: held firmly it stays
    on the undulation on which it begins."""
    for factor in softness:
        problem.softness = factor
        first = len(problem.cost)
        for _ in range(_SOFT_STEPS):
            problem.step(events)
            cost = problem.cost[first:]
            if len(cost) > 1 and abs(cost[-1] - cost[-2]) <= _SETTLED * cost[-1]:
                break
    problem.softness = 1.0


def solve(problem: Problem, events: JumpEvents | None,
          refine: Callable[[Problem, JumpEvents], JumpEvents],
          softness: Sequence[float] = ()) -> Solution:
    """Iterate to convergence; the last step, or one more, computes covariances.

    Args:
        problem: with its prior set.
        events: first JumpEvents or None.
        refine: called with the problem and events after the first convergence; returns better
            events.
        softness: one of :data:`SOFTNESS`.
    """
    stop = problem.params.iteration
    delays = _Delays(problem)
    if problem.rates_recovered and events is None:
        follow_surface(problem)
    else:
        problem.follow()
    _settle_softly(problem, events, softness)
    refined, converged, steps, first = events is None, False, 0, len(problem.cost)
    last = Change(np.full(3, np.inf))
    near = False
    while steps < stop.max:
        delays.attach()
        last = problem.step(events, with_cov=near)
        steps += 1
        near = refined and not delays.held and last.largest.max() <= _NEAR * stop.tolerance
        if not np.isfinite(problem.cost[-1] + last.largest.sum()):
            break
        # A cost is that before its step: the first two after a change cannot be compared.
        change = np.inf
        if len(problem.cost) > first + 1:
            change = abs(problem.cost[-1] - problem.cost[-2])
        delays.check_cycle(problem.cost, first, change)
        if delays.held and change <= _SETTLED * problem.cost[-1]:
            delays.release()
            first = len(problem.cost)
            continue
        if delays.held or (last.largest.max() > stop.tolerance and change > stop.cost_tolerance):
            continue
        if events is None or refined:
            converged = True
            break
        better, refined = refine(problem, events), True
        if better == events:
            converged = True
            break
        events = better
    delays.release()
    if not last.has_cov:
        delays.attach()
        last = problem.step(events, with_cov=True)
    return Solution(events, steps, converged, last)
