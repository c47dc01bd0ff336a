"""One attempt: a recording smoothed under one model of it."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.smoother.gnss_step import GnssStep
from imu_fusion.estimation.smoother.imu_input import (
    AT_REST,
    first_place,
    prepare_imu,
    reference_frame,
)
from imu_fusion.estimation.smoother.initial import first_attitudes
from imu_fusion.estimation.smoother.iterated import SOFTNESS, Solution, solve
from imu_fusion.estimation.smoother.jump_events import JumpEvents, find_jump, refine_jump
from imu_fusion.estimation.smoother.jump_result import jump_result
from imu_fusion.estimation.smoother.measurements.registry import (
    KINDS,
    MEASUREMENTS,
    REST,
    prepare_readings,
)
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.points import at_surface
from imu_fusion.estimation.smoother.problem import Problem, log_density
from imu_fusion.estimation.smoother.profile_fit import ProfileError
from imu_fusion.estimation.smoother.remarks import MOST_EXCESS
from imu_fusion.estimation.smoother.rests import Rest, contradicted, find_rests, stamps_of
from imu_fusion.estimation.smoother.result import SAMPLE, SmootherResult
from imu_fusion.estimation.smoother.samples import smoothed_samples, smoothed_states
from imu_fusion.estimation.smoother.sensor_lag import in_time
from imu_fusion.estimation.smoother.state import StatePrior
from imu_fusion.estimation.smoother.surface_fit import misfit_at_landing, surface_fits
from imu_fusion.estimation.smoother.surface_place import fixes_beside, widen_place
from imu_fusion.estimation.smoother.surroundings import surroundings_of
from imu_fusion.estimation.smoother.touch_down import FOLLOWS, likeliest, near_ground
from imu_fusion.estimation.smoother.whiteness import wandering, widen
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.centre import centre_in_flight, find_centre
from imu_fusion.samples.logs import FixLog, ImuLog, MagLog, VelocityLog, seconds
from imu_fusion.surfaces.constraint import Surface, split_sigma
from imu_fusion.surfaces.hill import PARTS, Hill

# A wrong first attitude can end in another minimum: converged or not, fixes then do not fit.
_STARTS = 4          # first attitudes tried until one fits
_MOVES = 3.0         # standard deviations of a speed that is no rest
_LIES = 1.0          # m, from the height of a sensor that stands to that of one that lies
_OFF_CENTRE, _CENTRE_SD = 5.0, 0.003    # standard deviations; m, by scales of accelerometers
_PLAUSIBLE = 1.5     # typical innovation of fixes, in standard deviations, that is taken as a fit


class Given(NamedTuple):
    """Arguments of :meth:`.smoother.Smoother.run`; ``felt``: whether an Imu felt the motion."""

    imu: ImuLog
    mag: MagLog | None
    fix: FixLog | None
    velocity: VelocityLog | None
    events: JumpEvents | None
    initial_quat: np.ndarray | None
    felt: bool = True

    def earlier(self, of_fixes: float, of_velocities: float) -> "Given":
        """With stamps of fixes and of velocities that are earlier by their lags (s)."""
        fix, velocity = self.fix, self.velocity
        return self._replace(
            fix=None if fix is None else replace(
                fix, stamp=fix.stamp - np.int64(round(of_fixes * 1e9))),
            velocity=None if velocity is None else replace(
                velocity, stamp=velocity.stamp - np.int64(round(of_velocities * 1e9))))

    def with_clock(self, rate: float) -> "Given":
        """With stamps of a receiver whose clock runs faster by a rate, and is right in the middle
        of the recording."""
        middle = (self.imu.stamp[0] + self.imu.stamp[-1]) // 2

        def in_time(log):
            return log if log is None or not rate else replace(log, stamp=log.stamp - np.round(
                (log.stamp - middle) * (rate / (1.0 + rate))).astype(np.int64))
        return self._replace(fix=in_time(self.fix), velocity=in_time(self.velocity))


class Model(NamedTuple):
    """What is taken to be true of a recording: ``params``; ``step_at``, stamp (ns) of the first
    fix after a step of all fixes, or None; ``noise``: name of readings -> factor of their stated
    standard deviations; ``repeats``: whether readings of the receiver that are the one before
    exactly are measurements; ``stands``: whether a jumper stands after the touch-down, so that the
    sensor is at its height above the profile; ``profile``: an error of the landing profile, which
    counts as much less as that is beyond chance; ``late``: "gyr" or "mag" -> s, by which these are
    later than the accelerometer; ``clock_rate``, by which the receiver's clock runs faster than
    that of the Imu; ``rests``; None: those that the recording shows."""

    params: SmootherParams
    step_at: int | None = None
    noise: Mapping[str, float] = {}
    repeats: bool = True
    stands: bool = True
    late: Mapping[str, float] = {}
    rests: tuple[Rest, ...] | None = None
    profile: ProfileError = ProfileError()
    clock_rate: float = 0.0

    def changed(self, changes: Mapping[str, Any]) -> "Model":
        """With other values of parameters, by their dotted names."""
        return self._replace(params=self.params.replace(**changes))


class Attempt(NamedTuple):
    """A solved problem, and what it says."""

    problem: Problem
    result: SmootherResult


def attempt(given: Given, model: Model, surface: Surface | None) -> Attempt:
    """Smooth a recording under a model of it.

    Raises: as :meth:`.smoother.Smoother.run`.
    """
    params = model.params
    imu, mag = in_time(given.imu, given.mag, model.late)
    given = given._replace(mag=mag).with_clock(model.clock_rate)
    prepared = prepare_imu(imu, params)
    first = first_place(given.fix, params.initial.position)
    frame = reference_frame(surface, first)
    constraints = surface.constraints() if surface is not None else ()
    if not model.stands:
        constraints = _lying(constraints, prepared.log, params)
    elif model.profile.sds:
        constraints = tuple(c if c.phase != "landing" else replace(
            c, sigma=c.sigma * abs(model.profile.sds)) for c in constraints)
    events = given.events
    detected = events is None and any(c.phase != "always" for c in constraints)
    if detected:
        events = find_jump(prepared.log, given.velocity, params.jump.takeoff,
                           params.jump.touchdown)
    rests = model.rests
    if rests is None:
        rests = find_rests(prepared, given.fix, given.velocity, frame, params) if given.felt else ()
    while True:
        found = _attempt(given, model, surface, constraints, prepared, frame, first, events,
                         detected, rests)
        refuted = () if model.rests is not None else _refuted(found, rests)
        if not refuted:
            if surface is not None:
                widen_place(found.result.samples, surface.constraints(),
                            max(1.0, abs(model.profile.sds)), *_fixes_beside(found))
            return found._replace(result=replace(found.result, rests=rests))
        rests = tuple(rest for rest in rests if rest not in refuted)


def _refuted(found, rests):
    """Those rests that an attempt contradicts."""
    problem = found.problem
    readings, first = problem.readings, int(problem.imu.log.stamp[0])
    begins = (rests[:1] and rests[0].first == first
              and problem.params.initial.speed_sd < AT_REST)
    of_rest = readings["kind"] == REST
    return contradicted(rests, readings["stamp"][of_rest], problem.fit["innovation"][of_rest],
                        bool(begins))


def _attempt(given, model, surface, constraints, prepared, frame, first, events, detected, rests):
    """Under the assumption of rests."""
    params = model.params
    readings = _readings(given, model, frame, stamps_of(rests, prepared.log.stamp))
    measured = {MEASUREMENTS[kind].name for kind in np.unique(readings["kind"])}
    around = surroundings_of(params, frame, int(prepared.log.stamp[0]), "mag" in measured)
    problem = Problem(prepared, params, readings, around, constraints,
                      StatePrior.of(params, measured), given.felt)
    hill = surface if isinstance(surface, Hill) and events is not None else None
    start = None if params.initial.position is None else frame.to_enu(*first)
    judge = "fix" if "fix" in measured else "mag"
    best = None
    for quat in first_attitudes(problem, given.mag, given.initial_quat, start)[:_STARTS]:
        found = _from_attitude(problem, frame, hill, quat, events)
        if found is None:
            continue
        if best is None or found.result.cost[-1] < best.result.cost[-1]:
            best = found
        if found.result.converged and found.result.misfit().get(judge, 0.0) < _PLAUSIBLE:
            break
    if best is None:
        raise EstimationError("the smoother diverged: noise far below that of the data, or "
                              "measurements of another recording")
    if detected and hill is not None and params.jump.touchdown is None:
        best = _likeliest(best, hill, frame)
    if best.result.failure:
        raise EstimationError(best.result.failure)
    if not model.repeats:
        best = best._replace(result=replace(best.result, repeats=_repeats(given, best.result)))
    if model.step_at is not None:
        offset, sd = (values[0] for values in best.result.states["gnss_step"])
        return best._replace(result=replace(best.result,
                                            gnss_step=GnssStep(model.step_at, offset, sd)))
    return best


def _lying(constraints, log, params):
    """With heights of the landing that tell, all together, no more than a metre."""
    rows = (log.stamp[-1] - log.stamp[0]) * 1e-9 / params.surface.interval
    return tuple(c if c.phase != "landing" else replace(c, sigma=_LIES * np.sqrt(rows))
                 for c in constraints)


def _readings(given, model, frame, rest):
    """Readings of records.READING, under the model; ``rest`` (m,) ns, stamps at rest."""
    fix, velocity = given.fix, given.velocity
    if not model.repeats:
        fix = None if fix is None else fix[is_news(fix)]
        velocity = None if velocity is None else velocity[is_news(velocity)]
    logs: dict[str, Any] = {"velocity": velocity, "mag": given.mag, "rest": rest}
    if fix is not None and fix.usable.any():
        fix = fix[fix.usable]
        moved = fix.stamp >= (np.inf if model.step_at is None else model.step_at)
        logs |= {"fix": fix[~moved], "moved_fix": fix[moved]} if moved.any() else {"fix": fix}
    readings = prepare_readings(logs, frame, model.params)
    for name, factor in model.noise.items():
        readings["whiten"][readings["kind"] == KINDS[name]] /= factor
    return readings


def _repeats(given, result):
    """Name -> number of readings that are the one before exactly, while the body moves."""
    found = {}
    for name, log in (("fix", given.fix), ("velocity", given.velocity)):
        if log is None:
            continue
        at = np.searchsorted(result.samples["stamp"], log.stamp[~is_news(log)])
        samples = result.samples[at[at < len(result.samples)]]
        speed = np.sum(samples["vel_world"] ** 2, axis=1) / np.trace(
            samples["cov_velocity"], axis1=1, axis2=2)
        if len(speed) and np.median(speed) > _MOVES ** 2:
            found[name] = len(speed)
    return found


def is_news(log: FixLog | VelocityLog) -> np.ndarray:
    """Mask (n,) of readings that are not the one before exactly; a velocity of zero may be."""
    if isinstance(log, FixLog):
        values = np.column_stack([log.latitude_deg, log.longitude_deg, log.height])
    else:
        values = log.vel_world
    same = np.all(values[1:] == values[:-1], axis=1)
    if isinstance(log, VelocityLog):
        same &= values[1:].any(axis=1)
    return np.append(True, ~same)[:len(log)]


def _likeliest(first, hill, frame):
    """The attempt with the likeliest touch-down."""
    problem, attempts = first.problem, [first]
    quat = first.result.samples["quat_world_imu"][0]

    def smooth(events):
        found = _from_attitude(problem, frame, hill, quat, events)
        if found is None:
            return None
        attempts.append(found)
        return found.result

    chosen = likeliest(first.result, hill, problem.imu.log, problem.params, smooth)
    return next(a for a in attempts if a.result is chosen)


def _from_attitude(problem, frame, hill, quat, events):
    """From one first attitude; None where it diverges."""
    def refine(problem: Problem, events: JumpEvents) -> JumpEvents:
        return events if hill is None else refine_jump(hill, _positions(problem), problem.imu.log,
                                                       events)

    solved = []
    for softness in SOFTNESS if problem.on_rough_surface else SOFTNESS[:1]:
        own = problem.from_attitude(quat)
        solution = solve(own, events if hill is not None else None, refine, softness)
        if np.isfinite(own.x).all():
            solved.append((own, solution))
    if not solved:
        return None
    own, solution = min(solved, key=lambda one: one[0].cost[-1])
    return Attempt(own, _result(own, frame, hill, solution))


def _fixes_beside(found):
    """Offset (3,) m of the fixes from a trajectory, and its standard deviation (3,)."""
    residuals = found.result.residuals.get("fix")
    if residuals is None:
        return np.zeros(3), np.full(3, np.inf)
    readings = found.problem.readings
    whiten = readings["whiten"][readings["kind"] == KINDS["fix"]]
    unit = np.median(1.0 / np.diagonal(whiten, axis1=1, axis2=2), axis=0)
    sds, sd = fixes_beside(residuals, found.result.wander["fix"])
    return unit * sds, unit * sd


def _positions(problem: Problem) -> np.ndarray:
    samples = np.empty(len(problem.x), SAMPLE)
    samples["stamp"] = problem.imu.log.stamp
    samples["position_world"] = problem.surface_points()
    return samples


def _result(problem: Problem, frame: LocalFrame, hill: Hill | None, solution: Solution
            ) -> SmootherResult:
    samples = smoothed_samples(problem, solution.last)
    states = smoothed_states(problem, solution.last)
    innovations, residuals = {}, {}
    for kind, measurement in enumerate(MEASUREMENTS):
        of_kind = problem.readings["kind"] == kind
        if np.any(of_kind) and kind != REST:    # which is no reading, and judged by itself
            width = len(measurement.components)
            fit = problem.fit[of_kind]
            innovations[measurement.name] = (problem.readings["stamp"][of_kind],
                                             fit["innovation"][:, :width])
            residuals[measurement.name] = fit["residual"][:, :width]
    # Innovations of velocities wander with accelerations that nobody felt.
    wander = {name: wandering(*of_kind) for name, of_kind in innovations.items()
              if problem.felt or name != "velocity"}
    fits = surface_fits(problem.constraints, samples, states, solution.events, problem.params,
                        problem.free[problem.imu.recorded])
    # A jump's landing makes its length less certain; other surfaces make all.
    off = {c.name: fits[c.name].excess for c in problem.constraints
           if c.phase == "always" and c.name in fits and fits[c.name].excess > MOST_EXCESS}
    widen(samples, wander | off)
    jump, near, failure = None, 0.0, ""
    if hill is not None and solution.events is not None:
        near = near_ground(samples, states, solution.events, problem.constraints, problem.params)
        try:
            jump = jump_result(hill, at_surface(samples, states, problem.params),
                               problem.imu.log, solution.events, misfit_at_landing(fits),
                               split_sigma(hill.sigma, PARTS)["landing"])
            if near > FOLLOWS:
                jump = replace(jump, length_sd=float(np.hypot(
                    jump.length_sd, near * jump.landing_speed)))
        except EstimationError as error:
            failure = str(error)
    return SmootherResult(samples, frame, states, innovations, tuple(problem.cost),
                          solution.steps, solution.converged, solution.events, jump, fits,
                          residuals=residuals, wander=wander, near_ground=near, failure=failure,
                          lost_turns=tuple(problem.lost_turns),
                          log_likelihood=log_density(problem.readings)
                          - solution.last.surprise)


def other_centre(problem: Problem) -> np.ndarray | None:
    """Where a tumbling body's centre is, if that is not where the surface is said to hold it."""
    surface = problem.params.surface
    if surface.lever_arm_sd or not any(c.phase == "always" for c in problem.constraints):
        return None
    log = problem.imu.log
    time = seconds(log.stamp, log.stamp[0])
    found = find_centre(time, log.acc, log.gyr)
    if found is not None:
        off = np.abs(found.point - surface.lever_arm)
        if np.any(off > _OFF_CENTRE * np.hypot(found.sd, _CENTRE_SD)):
            return found.point
    return centre_in_flight(time, log.acc, log.gyr, surface.lever_arm)


def clipped_forces(problem: Problem) -> tuple[int, float]:
    """Number of samples whose force was at the end of a range that nobody gave, and that range."""
    imu = problem.imu
    if problem.params.sensor.acc_range is not None:
        return 0, np.inf
    return int(imu.clipped[:, 3:].any(axis=1).sum()), float(imu.acc_range.min())
