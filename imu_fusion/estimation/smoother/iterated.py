"""The iterated smoother: Gauss-Newton on one explicit cost.

    J = sum of squared normalised process noise + squared normalised initial error
        + sum over fixes, velocities and magnetometer readings of loss(residual)
        + sum over constraint rows of (residual / sigma)^2

An extended Kalman filter gives the first trajectory. Each step linearises the motion and
all rows about the last trajectory and solves the linear problem exactly, by a filter
forward and the Bryson-Frazier pass back (:mod:`.kernel`); between samples the trajectory
may gape (multiple shooting), and the step closes the gaps.
"""

from dataclasses import dataclass, field

import numpy as np

from imu_fusion.estimation.smoother import kernel, model
from imu_fusion.estimation.smoother.inputs import evaluate_constraints
from imu_fusion.estimation.smoother.transition import boxminus



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
                       self.field_world, np.array(self.params.gnss_lever_arm))
        self.size = n
        self.attach()
        no_rows = np.zeros(len(self.imu.log) + 1, np.int64)
        self.rows = (no_rows, np.empty(0), np.empty((0, 3)), np.empty(0), np.empty(0, bool))

    def attach(self):
        """Bind the measurements to samples, for the delays of their stamps found so far."""
        m = self.measurements
        common, extra = (0.0 if i < 0 or self.x is None else float(self.x[0, i + 1])
                         for i in self.layout[[model.TIME_OFFSET, model.VELOCITY_OFFSET]])
        self.order, start, tau = m.attach(self.imu.log.stamp, common, common + extra)
        self.attached = (start, m.kind[self.order], tau, m.value[self.order],
                         m.whiten[self.order], m.loss[self.order])
        self.innovation = np.zeros((len(self.order), 3))

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

    def search_heading(self, candidates):
        """Filter the beginning from each attitude (k, 4); keep the most plausible one.

        The beginning ends where the fixes have moved far beyond their noise, which is what
        tells headings apart.
        """
        start, kind, _, value, whiten = self.attached[:5]
        sample = np.repeat(np.arange(len(self.x)), np.diff(start))
        fixes = kind == model.FIX
        apart = np.linalg.norm(value[fixes] - value[fixes][0], axis=1)
        moved = np.flatnonzero(apart * whiten[fixes, 0, 0] > 20.0)
        count = len(self.x) if not len(moved) else int(sample[fixes][moved[0]]) + 1
        scores = []
        for quat in candidates:
            self.prior[6:10] = quat
            scores.append(self.follow(count)[1])
        self.prior[6:10] = candidates[int(np.argmin(scores))]

    def step(self, events, margin, with_cov=False):
        """One Gauss-Newton step; moves x.

        Returns:
            The cost of the trajectory before the step, the largest changes (3,) in m, m/s,
            rad, and with ``with_cov`` the covariances (N, 3, 3, 3) and variances (N, n - 9).
        """
        n, total = self.size, len(self.x)
        if self.constraints:
            self.rows = evaluate_constraints(self.constraints, self.x[:, 0:3],
                                             self.imu.log.stamp, events, margin)
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
        if with_cov:
            sampled = np.append(np.arange(0, total - 1, kernel.THINNING), total - 1)
            for column in variances.T:
                column[:] = np.interp(np.arange(total), sampled, column[sampled])
        return largest, covariances, variances

    process = 0.0  # of the trajectory that the last step left


def solve(problem, events, refine):
    """Iterate to convergence; the last step computes covariances.

    Args:
        problem: Problem with ``prior`` and ``x`` set.
        events: first JumpEvents or None.
        refine: called with the problem after each convergence; returns better events.

    Returns:
        events, number of steps, whether it converged, covariances, variances.
    """
    params = problem.params
    margin = params.event_margin
    problem.follow()
    moving = (problem.layout[[model.TIME_OFFSET, model.VELOCITY_OFFSET]] >= 0).any()
    refined, converged, steps = events is None, False, 0
    while steps < params.max_iterations:
        largest, _, _ = problem.step(events, margin)
        steps += 1
        if not np.isfinite(problem.cost[-1] + largest.sum()):
            break
        if moving:
            problem.attach()
        # Where readings change their sample as a delay is found, the step may end in a tiny
        # cycle that no cost tells apart.
        still = len(problem.cost) > 1 and (
            abs(problem.cost[-1] - problem.cost[-2]) <= params.cost_tolerance)
        if largest.max() > params.tolerance and not still:
            continue
        if refined:
            converged = True
            break
        better, refined = refine(problem, events), True
        if better == events:
            converged = True
            break
        events = better
    _, covariances, variances = problem.step(events, margin, with_cov=True)
    return events, steps, converged, covariances, variances
