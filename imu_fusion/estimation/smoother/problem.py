"""One recording as an optimisation problem: its trajectory, and the step that improves it."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.smoother.backward_pass import THINNING
from imu_fusion.estimation.smoother.forward_filter import filter_segment, make_storage
from imu_fusion.estimation.smoother.imu_input import ImuInput
from imu_fusion.estimation.smoother.jump_events import JumpEvents
from imu_fusion.estimation.smoother.linear_solve import solve_linear
from imu_fusion.estimation.smoother.measurements.registry import (
    DELAYS,
    FIX,
    KINDS,
    MEASUREMENTS,
)
from imu_fusion.estimation.smoother.measurements.surface_contact import (
    Spread,
    evaluate_constraints,
    in_flight,
    put_lever_derivatives,
    surface_points,
)
from imu_fusion.estimation.smoother.motion import columns_of, intervals_of
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.records import CONTACT, FIT, MODEL, Recording, make_scratch
from imu_fusion.estimation.smoother.state import (
    ACC_BIAS,
    ATT,
    GYR_BIAS,
    POS,
    SLOW,
    StatePrior,
    boxminus,
    slow_states,
)
from imu_fusion.estimation.smoother.surroundings import Surroundings
from imu_fusion.surfaces.constraint import Constraint

_BEGINNING = 20_000_000_000   # ns, from which first attitudes are judged at least
_MOVED = 20.0                 # sd of a fix, by which fixes have moved far beyond their noise
_DELAY_SDS = 3.0              # standard deviations within which a delay of stamps is believed
_UNLIKELY = 1e4               # standard deviations, beside which what is left is nothing
# Squared standard deviations of the Cauchy loss by which first attitudes are judged: wide enough
# that a start that errs for a while is told from one that errs throughout.
_JUDGED = 25.0


@dataclass(frozen=True)
class Change:
    """What a step did: ``largest`` changes (3,) in m, m/s, rad; negative logarithm ``surprise``
    of the likelihood of all rows before it. If it was asked to: covariances
    ``cov`` (N, 3, 3, 3) of position, velocity, attitude, and variances ``var`` (N, n - 9) of the
    slow states."""

    largest: np.ndarray
    surprise: float = np.inf
    cov: np.ndarray = field(default_factory=lambda: np.empty((0, 3, 3, 3)))
    var: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def has_cov(self) -> bool:
        """Whether it was asked for covariances."""
        return len(self.cov) > 0


class NoiseFactors(NamedTuple):
    """Factors: ``noise`` (2,) of the densities of rates and forces, ``walk`` (2,) of the walks of
    their biases; name of readings -> of their standard deviations (``receiver``); name of a block
    that is a Gauss-Markov process -> of its variance density and of its correlation time
    (``wander``)."""

    noise: Sequence[float]
    walk: Sequence[float]
    receiver: Mapping[str, float]
    wander: Mapping[str, Sequence[float]]


def model_of(prior: StatePrior, around: Surroundings, lever_arm: Sequence[float]) -> np.ndarray:
    """One-element array of MODEL; lever_arm: (3,) m, of the antenna."""
    model = np.zeros(1, MODEL)
    values = model[0]
    values["gravity"], values["earth_rate"] = around.gravity, around.earth_rate
    values["magnetic_field"], values["lever_arm"] = around.magnetic_field, lever_arm
    values["blocks"] = tuple(prior.blocks)
    n, columns = len(prior.sd), columns_of(prior.blocks)
    values["decay_rate"][:n], values["walk"][:n] = prior.decay_rate, prior.walk
    values["columns"][:len(columns)], values["n_columns"] = columns, len(columns)
    return model


def log_density(readings: np.ndarray) -> float:
    """What whitening readings of records.READING does to the logarithm of their likelihood."""
    sizes = np.diagonal(readings["whiten"], axis1=1, axis2=2)
    return float(np.log(sizes[sizes > 0.0]).sum())


class Problem:
    """Everything fixed during the iteration, and the trajectory ``x`` (N, n + 1) with the
    ``cost`` before each step.

    Args:
        imu: ImuInput. readings: (m,) of records.READING.
        around: Surroundings.
        constraints: of the surface.
        prior: StatePrior, whose mean may be completed before the first step.
        felt: whether an Imu felt the motion.
    """

    def __init__(self, imu: ImuInput, params: SmootherParams, readings: np.ndarray,
                 around: Surroundings, constraints: Sequence[Constraint], prior: StatePrior,
                 felt: bool = True):
        self.imu, self.params, self.around, self.felt = imu, params, around, felt
        self.constraints, self.prior = tuple(constraints), prior
        self.mean, self.prior_sd = prior.mean.copy(), prior.sd
        self.blocks, self.size = prior.blocks, len(prior.sd)
        self.delays = [i for i in (getattr(prior.blocks, name) for name in DELAYS) if i >= 0]
        self.model = model_of(prior, around, params.gnss.lever_arm)
        self.intervals = intervals_of(imu.steps, imu.means, imu.noise)
        self.free = in_flight(imu.log, around.gravity, params.surface.lever_arm)
        self.contact_start = np.zeros(len(imu.log) + 1, np.int64)
        self.contacts = np.empty(0, CONTACT)
        self._start()
        self._all_readings = readings
        self._bound = np.zeros(len(MEASUREMENTS))
        self.attach()

    def _start(self) -> None:
        self.x = np.zeros((len(self.imu.log), self.size + 1))
        self.cost: list[float] = []
        self._process = 0.0   # squared noise of the trajectory that the last step left
        self.spread = Spread(None) if self.on_rough_surface else None
        self.softness = 1.0
        self.lost_turns: list[int] = []   # stamps at which one of several turns was taken

    @property
    def recording(self) -> Recording:
        """For the kernels."""
        return Recording(self.model, self.intervals, self.readings, self.reading_start,
                         self.contacts, self.contact_start)

    @property
    def on_rough_surface(self) -> bool:
        """Whether a surface may bend within what the position is unsure by."""
        return any(constraint.rough for constraint in self.constraints)

    @property
    def rates_recovered(self) -> bool:
        """Whether there are a surface that holds always, and rates some of which were not
        measured, but recovered."""
        return (self.imu.log.gyr_sd is not None and len(self.constraints) > 0
                and all(constraint.phase == "always" for constraint in self.constraints))

    def attach(self, bind: bool = True) -> None:
        """Place the readings in time, for the delays of their stamps found so far; with
        ``bind`` anew at the sample before each, else after the sample that each is bound to,
        unless the delays have moved by more than a step since.

        Sets ``readings`` (M,), ``reading_start`` (N + 1,) and ``fit`` (M,), of records.FIT.
        """
        stamp = self.imu.log.stamp
        late = np.array([sum(self._delay(name) for name in m.delays) for m in MEASUREMENTS])
        taken = self._all_readings["stamp"] - np.round(late * 1e9).astype(
            np.int64)[self._all_readings["kind"]]
        if bind or np.abs(late - self._bound).max() > np.median(self.imu.steps):
            self._bind(taken)
            self._bound = late
        self.readings = self._all_readings[self._order]
        sample_stamp = np.repeat(stamp, np.diff(self.reading_start))
        self.readings["tau"] = (taken[self._order] - sample_stamp) * 1e-9

    def _delay(self, name: str) -> float:
        """s, of the state of this name; 0 where there is none."""
        i = getattr(self.blocks, name)
        return 0.0 if i < 0 else float(slow_states(self.x[0], i, 1)[0])

    def _bind(self, taken: np.ndarray) -> None:
        """Bind each reading, taken at (m,) ns, to the sample before it."""
        stamp = self.imu.log.stamp
        order = np.flatnonzero((taken >= stamp[0]) & (taken <= stamp[-1]))
        order = order[np.lexsort((self._all_readings["kind"][order], taken[order]))]
        sample = np.searchsorted(stamp, taken[order], side="right") - 1
        sample = np.minimum(sample, len(stamp) - 2)
        self._order = order
        self.reading_start = np.searchsorted(sample, np.arange(len(stamp) + 1))
        self.fit = np.zeros(len(order), FIT)

    def follow(self, count: int | None = None) -> float:
        """Extended Kalman filter over the first ``count`` samples; writes x.

        Returns:
            How little it expected the readings: a heading is judged by that, not by what it ended
            with.
        """
        self.x[0] = self.mean
        count = len(self.x) if count is None else count
        n = self.size
        filter_segment(0, count, True, self.x, np.zeros(n), np.diag(self.prior_sd ** 2),
                       self.recording, self.fit, make_storage(0, 0, n), make_scratch(n))
        squares = (self.fit["innovation"][:self.reading_start[count]] ** 2).sum(axis=1)
        return float(np.log1p(squares / _JUDGED).sum())

    def rank(self, candidates: np.ndarray) -> np.ndarray:
        """Filter the beginning from each attitude (k, 4); return them, the most plausible first.

        The beginning ends where the fixes have moved far beyond their noise, which is what
        tells headings apart, but not before ``_BEGINNING``: a start at speed moves at once, and
        only changes of velocity tell headings apart then.
        """
        sample = np.repeat(np.arange(len(self.x)), np.diff(self.reading_start))
        of_fix = self.readings["kind"] == FIX
        fixes = self.readings[of_fix]
        apart = np.linalg.norm(fixes["value"] - fixes["value"][:1], axis=1)
        moved = np.flatnonzero(apart * fixes["whiten"][:, 0, 0] > _MOVED)
        count = len(self.x) if not len(moved) else int(sample[of_fix][moved[0]]) + 1
        stamp = self.imu.log.stamp
        least = int(np.searchsorted(stamp, stamp[0] + _BEGINNING))
        count = min(max(count, least), len(self.x))
        scores = []
        for quat in candidates:
            self.mean[ATT:ATT + 4] = quat
            scores.append(self.follow(count))
        return candidates[np.argsort(scores, kind="stable")]

    def from_attitude(self, quat: np.ndarray) -> "Problem":
        """The same problem, not yet solved, with a first attitude (4,)."""
        other = copy.copy(self)
        other.mean = self.mean.copy()
        other._start()
        other.mean[ATT:ATT + 4] = quat
        other.x[0] = other.mean
        other.attach()
        return other

    def log_likelihood(self, factors: NoiseFactors, most: int) -> float:
        """Logarithm of the likelihood of the readings of the first ``most`` samples, linear about
        the trajectory, with other noise; but for a constant."""
        n, count = self.size, min(most, len(self.x))
        intervals = self.intervals.copy()
        readings = self.readings[:self.reading_start[count]].copy()
        model = self.model.copy()
        for name, first, factor, drift in zip(("gyr_noise", "acc_noise"), (GYR_BIAS, ACC_BIAS),
                                              factors.noise, factors.walk):
            intervals[name] *= factor ** 2
            model["walk"][0, first:first + 3] *= drift ** 2
        for name, factor in factors.receiver.items():
            readings["whiten"][readings["kind"] == KINDS[name]] /= factor
        delta, cov = np.zeros(n), np.diag(self.prior_sd ** 2)
        for name, (walk, tau) in factors.wander.items():
            first = getattr(self.blocks, name)
            here = slice(first, first + 3)
            model["walk"][0, here] *= walk
            model["decay_rate"][0, here] /= tau
            cov[here, here] *= walk * tau
        boxminus(self.mean, self.x[0], delta)
        _, surprise = filter_segment(
            0, count, False, self.x, delta, cov,
            self.recording._replace(model=model, intervals=intervals, readings=readings),
            self.fit.copy(), make_storage(0, 0, n), make_scratch(n))
        return log_density(readings) - surprise

    def carried(self, last: int, first: int = 0,
                begin: tuple[np.ndarray, np.ndarray] | None = None
                ) -> tuple[np.ndarray, np.ndarray]:
        """Deviation (n,) and covariance (n, n) before the rows of sample ``last``, from those
        before the rows of ``first``; None: the prior."""
        n = self.size
        if begin is None:
            delta, cov = np.zeros(n), np.diag(self.prior_sd ** 2)
            boxminus(self.mean, self.x[0], delta)
        else:
            delta, cov = begin[0].copy(), begin[1].copy()
        filter_segment(first, last, False, self.x, delta, cov, self.recording, self.fit.copy(),
                       make_storage(0, 0, n), make_scratch(n))
        return delta, cov

    def weights(self) -> np.ndarray:
        """Roots (M,) of the weights by which readings count."""
        return 1.0 / np.sqrt(1.0 + np.sum(self.fit["residual"] ** 2, axis=1)
                             / self.readings["loss"])

    def curvature(self, change: np.ndarray, slope: float) -> float:
        """Of the negative logarithm of the likelihood, linear about the trajectory, along a change
        (M, 3) of the values of readings, whose weights stay as they are.

        Args:
            slope: along the change, in which the likelihood is a parabola.
        """
        readings = self.readings.copy()
        readings["whiten"] *= self.weights()[:, None, None]
        readings["loss"] = np.inf
        sizes = np.linalg.norm(np.einsum("mij,mj->mi", readings["whiten"], change))
        if not sizes > 0.0:
            return 0.0
        # So large that nothing else makes readings unlikely: one pass tells it.
        size = _UNLIKELY * np.sqrt(len(readings)) / float(sizes)
        readings["value"] += size * change
        n = self.size
        delta, cov = self.carried(0)
        _, surprise = filter_segment(0, len(self.x), False, self.x, delta, cov,
                                     self.recording._replace(readings=readings), self.fit.copy(),
                                     make_storage(0, 0, n), make_scratch(n))
        return 2.0 * (surprise - size * slope) / size ** 2

    def shift(self, size: float, contacts: np.ndarray, first: int = 0, last: int | None = None,
              begin: tuple[np.ndarray, np.ndarray] | None = None) -> tuple[float, float]:
        """How large, in units of ``size``, a shift of contacts with the surface seems to be, and by
        how many standard deviations that is not zero: the likelihood, linear about the trajectory,
        is a parabola in it (score test: Rao 1948).

        Args:
            size: for which the likelihood is taken.
            contacts: (r,) m, for a shift of one.
            first: sample before which there is no shift. last: sample before which rows count.
            begin: what :meth:`carried` has before the rows of ``first``.
        """
        n = self.size
        delta, cov = self.carried(first) if begin is None else begin
        fit, storage, scratch = self.fit.copy(), make_storage(0, 0, n), make_scratch(n)
        found = []
        for factor in (-size, 0.0, size):
            shifted = self.contacts.copy()
            shifted["residual"] += factor * contacts
            found.append(float(filter_segment(
                first, len(self.x) if last is None else last, False, self.x, delta.copy(),
                cov.copy(), self.recording._replace(contacts=shifted), fit, storage, scratch)[1]))
        less, middle, more = found
        curvature, slope = less + more - 2.0 * middle, 0.5 * (less - more)
        if not curvature > 0.0:
            return 0.0, 0.0
        return size * slope / curvature, slope / float(np.sqrt(curvature))

    def _surface_lever(self):
        """Lever arm (3,) or (N, 3) m of the point that is held on the surface."""
        i = self.blocks.surface_lever_arm
        return self.params.surface.lever_arm if i < 0 else slow_states(self.x, i, 3)

    def surface_points(self, part: slice = slice(None)) -> np.ndarray:
        """Points (N, 3) m of (a part of) the trajectory that are held on the surface."""
        x = self.x[part]
        lever = np.broadcast_to(self._surface_lever(), (len(self.x), 3))[part]
        return surface_points(x[:, POS:POS + 3], x[:, ATT:ATT + 4], lever)

    def touch(self, events: JumpEvents | None, part: slice = slice(None),
               spread: Spread | None = None) -> None:
        """Evaluate the surface at a part of the trajectory."""
        elsewhere, points = np.ones(len(self.x), bool), np.zeros((len(self.x), 3))
        elsewhere[part], points[part] = False, self.surface_points(part)
        self.contact_start, self.contacts = evaluate_constraints(
            self.constraints, points, self.imu.log.stamp, events, self.params,
            self.free | elsewhere, self.spread if spread is None else spread)
        self.contacts["sigma"] *= self.softness
        lever = self._surface_lever()
        if self.blocks.surface_lever_arm >= 0 or np.any(lever):
            put_lever_derivatives(self.contact_start, self.contacts, self.x[:, ATT:ATT + 4], lever)
        if self.blocks.body_height < 0:
            self.contacts["residual"] -= np.where(
                self.contacts["height"], self.params.surface.body_height, 0.0)

    def step(self, events: JumpEvents | None, with_cov: bool = False) -> Change:
        """One Gauss-Newton step; moves x, and notes the cost of the trajectory before it."""
        n, total = self.size, len(self.x)
        with_cov = with_cov or self.spread is not None
        if self.constraints:
            self.touch(events)
        delta, cov = np.zeros(n), np.diag(self.prior_sd ** 2)
        boxminus(self.mean, self.x[0], delta)
        prior_cost = float(np.sum((delta / self.prior_sd) ** 2))
        covariances = np.empty((total if with_cov else 0, 3, 3, 3))
        variances = np.empty((total if with_cov else 0, n - SLOW))
        cost, surprise, process, largest = solve_linear(
            self.x, delta, cov, self.recording, self.fit, covariances, variances)
        self.cost.append(0.5 * (prior_cost + cost + self._process))
        self._process = process
        # A delay that runs away beyond belief takes the measurements with it.
        for i in self.delays:
            bound = _DELAY_SDS * self.prior_sd[i]
            late = slow_states(self.x, i, 1)
            np.clip(late, -bound, bound, out=late)
        if with_cov:
            sampled = np.append(np.arange(0, total - 1, THINNING), total - 1)
            for column in variances.T:
                column[:] = np.interp(np.arange(total), sampled, column[sampled])
        if self.spread is not None:
            self.spread = Spread(covariances[:, 0])
        return Change(largest, surprise, covariances, variances)
