"""The iterated smoother: Gauss-Newton on one explicit cost.

    J = 1/2 [ sum of squared normalised process noise + squared normalised initial error
              + sum over fixes, velocities and magnetometer readings of loss(residual)
              + sum over constraint rows of (residual / sigma)^2 ]

An extended Kalman filter gives the first trajectory. Each step linearises the motion and
all rows about the last trajectory and solves the linear problem exactly, by a filter
forward and the Bryson-Frazier pass back (:mod:`.kernel`); between samples the trajectory
may gape (multiple shooting), and the step closes the gaps.
"""

import copy
from dataclasses import dataclass, field

import numpy as np

from imu_fusion.estimation.smoother import kernel, model
from imu_fusion.estimation.smoother.inputs import (evaluate_constraints, lever_gradient,
                                                   surface_points)
from imu_fusion.estimation.smoother.transition import boxminus

_BEGINNING = 20_000_000_000   # ns, from which first attitudes are judged at least
_HELD_SD = 1e-6               # s, of a delay that is not estimated yet
_SETTLED = 0.01               # relative change of the cost with which delays are let go
_CYCLE = 0.1                  # of a step's change of the cost: two steps that end so near cycle
_NEAR = 3.0                   # tolerances: after such a step the next is likely the last
_DELAY_SDS = 3.0              # standard deviations within which a delay of stamps is believed


@dataclass
class Problem:
    """Everything fixed during the iteration: inputs, priors, measurements."""

    imu: object
    params: object
    measurements: object
    gravity: float
    earth_rate: np.ndarray
    field_world: np.ndarray
    constraints: tuple
    layout: np.ndarray
    prior_sd: np.ndarray
    decay_rate: np.ndarray
    walk: np.ndarray
    prior: np.ndarray = None
    x: np.ndarray = None
    cost: list = field(default_factory=list)

    def __post_init__(self):
        n = len(self.prior_sd)
        columns = list(range(model.ATT, model.CORE))
        for block, width in ((model.ACC_MATRIX, 9), (model.GYR_SCALE, 3)):
            if self.layout[block] >= 0:
                columns += range(self.layout[block], self.layout[block] + width)
        self.motion = (self.imu.steps, self.imu.means, self.imu.noise, self.gravity,
                       self.earth_rate, self.decay_rate, self.walk, self.layout, np.array(columns),
                       self.field_world, np.array(self.params.gnss.lever_arm))
        self.size = n
        self.attach()
        no_rows = np.zeros(len(self.imu.log) + 1, np.int64)
        self.rows = (no_rows, np.empty(0), np.empty((0, 3)), np.empty(0), np.empty(0, bool))

    def attach(self, bind=True):
        """Place the measurements in time, for the delays of their stamps found so far; with
        ``bind`` anew at the sample before each, else after the sample that each is bound to,
        unless the delays have moved by more than a step since."""
        m, stamp = self.measurements, self.imu.log.stamp
        common, extra = (0.0 if i < 0 or self.x is None else float(self.x[0, i + 1])
                         for i in self.layout[[model.TIME_OFFSET, model.VELOCITY_OFFSET]])
        late = np.array([common, common + extra])
        if bind or np.abs(late - self.bound).max() > np.median(self.imu.steps):
            self.order, self.start = m.bind(stamp, *late)
            self.bound, self.innovation = late, np.zeros((len(self.order), 3))
        tau = m.since(stamp, self.order, self.start, *late)
        self.attached = (self.start, m.kind[self.order], tau, m.value[self.order],
                         m.whiten[self.order], m.loss[self.order])

    def follow(self, count=None):
        """Extended Kalman filter over the first ``count`` samples; writes x."""
        self.x[0] = self.prior
        count = len(self.x) if count is None else count
        n = self.size
        cost = kernel.filter_segment(
            0, count, True, self.x, np.zeros(n), np.diag(self.prior_sd ** 2), self.motion,
            self.attached, self.rows, self.innovation, kernel.make_storage(0, 0, n))
        # A heading is judged by what the filter did not expect, not by what it ended with.
        start = self.attached[0]
        squares = (self.innovation[:start[count]] ** 2).sum(axis=1)
        return cost, float(np.log1p(squares / 25.0).sum())

    def rank(self, candidates):
        """Filter the beginning from each attitude (k, 4); return them, the most plausible first.

        The beginning ends where the fixes have moved far beyond their noise, which is what
        tells headings apart, but not before ``_BEGINNING``: a start at speed moves at once, and
        only changes of velocity tell headings apart then.
        """
        start, kind, _, value, whiten = self.attached[:5]
        sample = np.repeat(np.arange(len(self.x)), np.diff(start))
        fixes = kind == model.FIX
        apart = np.linalg.norm(value[fixes] - value[fixes][0], axis=1)
        moved = np.flatnonzero(apart * whiten[fixes, 0, 0] > 20.0)
        count = len(self.x) if not len(moved) else int(sample[fixes][moved[0]]) + 1
        stamp = self.imu.log.stamp
        least = int(np.searchsorted(stamp, stamp[0] + _BEGINNING))
        count = min(max(count, least), len(self.x))
        scores = []
        for quat in candidates:
            self.prior[6:10] = quat
            scores.append(self.follow(count)[1])
        return candidates[np.argsort(scores, kind="stable")]

    def from_attitude(self, quat):
        """The same problem, not yet solved, with a first attitude (4,)."""
        other = copy.copy(self)
        other.prior, other.x, other.cost = self.prior.copy(), np.empty_like(self.x), []
        other.prior[6:10] = quat
        other.x[0] = other.prior
        other.attach()
        return other

    def _surface_lever(self):
        """Lever arm (3,) or (N, 3) m of the point that is held on the surface."""
        i = self.layout[model.SURFACE_ARM]
        return self.params.surface.lever_arm if i < 0 else self.x[:, i + 1:i + 4]

    def surface_points(self):
        """Points (N, 3) m of the trajectory that are held on the surface."""
        return surface_points(self.x[:, 0:3], self.x[:, 6:10], self._surface_lever())

    def _constraint_rows(self, events):
        start, residual, gradient, sigma, height = evaluate_constraints(
            self.constraints, self.surface_points(), self.imu.log.stamp, events, self.params)
        state, lever = self.layout[model.SURFACE_ARM] >= 0, self._surface_lever()
        if state or np.any(lever):
            turned, along = lever_gradient(start, gradient, self.x[:, 6:10], lever)
            gradient = np.hstack([gradient, turned, along] if state else [gradient, turned])
        if self.layout[model.BODY_HEIGHT] < 0:
            residual = residual - np.where(height, self.params.surface.body_height, 0.0)
        return start, residual, gradient, sigma, height

    def step(self, events, with_cov=False):
        """One Gauss-Newton step; moves x.

        Returns:
            The cost of the trajectory before the step, the largest changes (3,) in m, m/s,
            rad, and with ``with_cov`` the covariances (N, 3, 3, 3) and variances (N, n - 9).
        """
        n, total = self.size, len(self.x)
        if self.constraints:
            self.rows = self._constraint_rows(events)
        delta, cov = np.zeros(n), np.diag(self.prior_sd ** 2)
        boxminus(self.prior, self.x[0], delta)
        prior_cost = float(np.sum((delta / self.prior_sd) ** 2))
        covariances = np.empty((total if with_cov else 0, 3, 3, 3))
        variances = np.empty((total if with_cov else 0, n - 9))
        cost, process, largest = kernel.solve_linear(
            self.x, delta, cov, self.motion, self.attached, self.rows, self.innovation, with_cov,
            covariances, variances)
        self.cost.append(0.5 * (prior_cost + cost + self.process))
        self.process = process
        # A delay that runs away beyond belief takes the measurements with it.
        for block in (model.TIME_OFFSET, model.VELOCITY_OFFSET):
            i = self.layout[block]
            if i >= 0:
                bound = _DELAY_SDS * self.prior_sd[i]
                np.clip(self.x[:, i + 1], -bound, bound, out=self.x[:, i + 1])
        if with_cov:
            sampled = np.append(np.arange(0, total - 1, kernel.THINNING), total - 1)
            for column in variances.T:
                column[:] = np.interp(np.arange(total), sampled, column[sampled])
        return largest, covariances, variances

    process = 0.0  # of the trajectory that the last step left


def solve(problem, events, refine):
    """Iterate to convergence; the last step, or one more, computes covariances.

    Args:
        problem: Problem with ``prior`` and ``x`` set.
        events: first JumpEvents or None.
        refine: called with the problem after each convergence; returns better events.

    Returns:
        events, number of steps, whether it converged, covariances, variances.
    """
    params = problem.params
    # Delays as loose as their prior would explain at first what the attitude still has wrong.
    delays = [i for i in problem.layout[[model.TIME_OFFSET, model.VELOCITY_OFFSET]] if i >= 0]
    moving = held = bool(delays)
    prior_sd = problem.prior_sd
    problem.prior_sd = prior_sd.copy()
    problem.prior_sd[delays] = _HELD_SD
    problem.follow()
    refined, converged, steps, changed = events is None, False, 0, 0
    near, covariances, variances = False, (), ()
    binding = moving
    while steps < params.iteration.max:
        if moving:
            problem.attach(binding)
        largest, covariances, variances = problem.step(events, with_cov=near)
        steps += 1
        near = refined and not held and largest.max() <= _NEAR * params.iteration.tolerance
        if not np.isfinite(problem.cost[-1] + largest.sum()):
            break
        # A cost is that before its step: the first two after a change cannot be compared.
        change = np.inf
        if len(problem.cost) > changed + 1:
            change = abs(problem.cost[-1] - problem.cost[-2])
        # Readings that change their sample as a delay is found put kinks into the cost, at which
        # steps may cross to and fro: two of them bring the cost back.
        if not held and len(problem.cost) > changed + 3 and change <= _SETTLED * problem.cost[-1]:
            back = abs(problem.cost[-1] - problem.cost[-3])
            binding = binding and back > _CYCLE * change
        if held and change <= _SETTLED * problem.cost[-1]:
            problem.prior_sd, held, changed = prior_sd, False, len(problem.cost)
            continue
        still = change <= params.iteration.cost_tolerance
        if held or (largest.max() > params.iteration.tolerance and not still):
            continue
        if refined:
            converged = True
            break
        better, refined = refine(problem, events), True
        if better == events:
            converged = True
            break
        events = better
    problem.prior_sd = prior_sd
    if not len(covariances):
        if moving:
            problem.attach(binding)
        _, covariances, variances = problem.step(events, with_cov=True)
    return events, steps, converged, covariances, variances
