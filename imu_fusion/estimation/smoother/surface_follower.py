"""A first trajectory that is held on a surface while it is being filtered.

A body whose rates are poorly known loses the turn about the magnetic field within seconds, and an
iteration that begins as wrong as that ends in another minimum, sure of it. What the surface holds
shows the turn as it is being lost. Where it has been lost by a radian, as in a gap in which a ball
tumbled, the filter goes on from several turns and keeps the likeliest (a sum of Gaussians: Alspach,
Sorenson 1972).
"""

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.estimation.smoother.forward_filter import filter_segment, make_storage
from imu_fusion.estimation.smoother.measurements.surface_contact import Spread
from imu_fusion.estimation.smoother.problem import Problem
from imu_fusion.estimation.smoother.records import CONTACT, make_scratch
from imu_fusion.estimation.smoother.state import ATT, POS, boxplus
from imu_fusion.estimation.smoother.transition import apply_step

# Turns and bounds were chosen on balls of this package's simulation, and tried on those of another:
# twice as many turns, or another bound, found no more. The odds were chosen on these.
_TOGETHER = 16     # samples over which one linearisation of the surface holds
_LOST = 0.7        # rad, standard deviation of an attitude from which the turn about the field is
_HELD = 0.35       # lost, whatever is stated later; turns are tried once the field holds the others
_TURNS = 0.25 * np.pi * np.arange(8)
_WITHIN = 0.4      # rad, to which each of them is known: they lie .8 apart
_JUDGED = 4.0      # s, after which they are judged
_SURE = 15.0       # of the log-likelihood, by which the chosen turn has to be likelier than those
_APART = 2         # steps away


def follow_surface(problem: Problem) -> None:
    """Extended Kalman filter over all samples with the rows of the surface; writes ``x``,
    ``lost_turns``, and ``spread`` where the surface is rough."""
    follower = _Follower(problem)
    total = len(problem.x)
    judged = max(int(_JUDGED / float(np.median(problem.imu.steps))), _TOGETHER)
    first, settled = 0, 0
    while first < total:
        if first >= settled and follower.is_lost(first):
            follower.choose_turn(first, min(first + judged, total))
            settled = first + judged
        follower.advance(first)
        first += _TOGETHER
    if problem.spread is not None:
        problem.spread = Spread(follower.places)


class _Follower:
    """The filter at the sample that :meth:`advance` has reached, and covariances ``places``
    (N, 3, 3) m^2 of the positions before it."""

    def __init__(self, problem: Problem):
        self.problem = problem
        problem.x[0] = problem.mean
        self.cov = np.diag(problem.prior_sd ** 2)
        self.places = np.empty((len(problem.x), 3, 3))
        self._scratch = make_scratch(problem.size)
        self._lost = False
        field = problem.around.magnetic_field
        self._field = field / np.linalg.norm(field)

    def advance(self, first: int) -> float:
        """Over the next samples; returns how unlikely their rows were."""
        problem, n = self.problem, self.problem.size
        last = min(first + _TOGETHER, len(problem.x))
        here, begin, delta = slice(first, last), problem.x[first].copy(), np.zeros(n)
        # Where the samples alone lead, then a linear pass about that.
        filter_segment(first, last, True, problem.x, delta.copy(), self.cov.copy(),
                       problem.recording, problem.fit, make_storage(0, 0, n), self._scratch)
        problem.x[first] = begin
        known = self.cov[POS:POS + 3, POS:POS + 3]
        problem.touch(None, here, Spread(np.broadcast_to(known, self.places.shape)))
        rows = 3 * (problem.reading_start[last] - problem.reading_start[first])
        kept = make_storage(last - first, int(rows) + len(problem.contacts), n)
        _, surprise = filter_segment(first, last, False, problem.x, delta, self.cov,
                                     problem.recording, problem.fit, kept, self._scratch)
        apply_step(problem.x[here], kept.delta, np.zeros(3))
        self.places[here] = kept.cov[:, POS:POS + 3, POS:POS + 3]
        if last < len(problem.x):
            boxplus(problem.x[last], delta)
        problem.contact_start[:], problem.contacts = 0, np.empty(0, CONTACT)
        return float(surprise)

    def is_lost(self, at: int) -> bool:
        """Whether the turn about the field has been lost, and it alone.

        While the field turns all axes back, linear errors make the turn about it look known.
        """
        block = self.cov[ATT:ATT + 3, ATT:ATT + 3]
        sd = np.sqrt(np.maximum(np.linalg.eigvalsh(block), 0.0))
        self._lost |= bool(sd[2] > _LOST)
        return self._lost and bool(sd[1] < _HELD)

    def choose_turn(self, at: int, until: int) -> None:
        """Go on from the turn about the field under which the samples before ``until`` are
        likeliest."""
        rotation = scipy.spatial.transform.Rotation
        begin = self.problem.x[at].copy()
        quat = rotation.from_quat(begin[ATT:ATT + 4])
        axis = np.zeros(len(self.cov))
        axis[ATT:ATT + 3] = quat.inv().apply(self._field)
        gain = self.cov @ axis
        known = self.cov - np.outer(gain, gain) / (axis @ gain + _WITHIN ** 2)
        known += np.outer(axis, axis) * max(_WITHIN ** 2 - float(axis @ known @ axis), 0.0)
        starts: list[np.ndarray] = []
        surprises: list[float] = []
        for turn in _TURNS:
            start = begin.copy()
            start[ATT:ATT + 4] = (rotation.from_rotvec(turn * self._field) * quat).as_quat()
            self.cov = known.copy()
            self.problem.x[at] = start
            surprises.append(sum(self.advance(k) for k in range(at, until, _TOGETHER)))
            starts.append(start)
        unlikely, step = np.array(surprises), np.arange(len(_TURNS))
        best = int(np.argmin(unlikely))
        apart = np.minimum((step - best) % len(step), (best - step) % len(step)) >= _APART
        if unlikely[apart].min() - unlikely[best] < _SURE:
            self.problem.lost_turns.append(int(self.problem.imu.log.stamp[at]))
        self.problem.x[at] = starts[best]
        self.cov, self._lost = known, False
