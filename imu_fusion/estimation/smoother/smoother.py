"""The smoother: trajectory, attitude and sensor errors from a whole recording."""

from dataclasses import replace

import numpy as np

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.smoother.extended_rts import ExtendedRts
from imu_fusion.estimation.smoother.gnss_lag import find_lag
from imu_fusion.estimation.smoother.imu_input import first_place, prepare_imu, reference_frame
from imu_fusion.estimation.smoother.initial import first_attitudes
from imu_fusion.estimation.smoother.iterated import Solution, solve
from imu_fusion.estimation.smoother.jump_events import JumpEvents, find_jump, refine_jump
from imu_fusion.estimation.smoother.jump_result import jump_result
from imu_fusion.estimation.smoother.measurements.registry import MEASUREMENTS, prepare_readings
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.problem import Problem
from imu_fusion.estimation.smoother.result import SAMPLE, SmootherResult
from imu_fusion.estimation.smoother.samples import smoothed_samples, smoothed_states
from imu_fusion.estimation.smoother.state import StatePrior
from imu_fusion.estimation.smoother.surface_fit import (
    at_surface,
    misfit_at_landing,
    surface_fits,
)
from imu_fusion.estimation.smoother.surroundings import surroundings_of
from imu_fusion.estimation.smoother.touch_down import likeliest
from imu_fusion.estimation.smoother.whiteness import wandering, widen
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.logs import FixLog, ImuLog, MagLog, VelocityLog
from imu_fusion.surfaces.constraint import Surface
from imu_fusion.surfaces.hill import Hill

# A wrong first attitude can end in another minimum: converged or not, fixes then do not fit.
_STARTS = 4          # first attitudes tried until one fits
_PLAUSIBLE = 1.5     # typical innovation of fixes, in standard deviations, that is taken as a fit

_LAG_SD = 0.2        # s, of a lag of the receiver's stamps that was found on a grid


class Smoother:
    """Smooths recordings; holds parameters only.

    Args:
        params: SmootherParams.
        surface: Surface or None.
    """

    def __init__(self, params: SmootherParams = SmootherParams(), surface: Surface | None = None):
        self.params, self.surface = params, surface

    def run(self, imu: ImuLog, mag: MagLog | None = None, fix: FixLog | None = None,
            velocity: VelocityLog | None = None, events: JumpEvents | None = None,
            initial_quat: np.ndarray | None = None) -> SmootherResult:
        """Smooth one recording.

        Args:
            imu: ImuLog. mag: MagLog or None. fix: FixLog. velocity: VelocityLog or None.
            events: JumpEvents, or None: found by ``find_jump`` when the surface needs them.
            initial_quat: (4,) attitude of the first sample; found from the data when None.

        Returns:
            SmootherResult.

        Raises:
            SampleError: unusable samples.
            EstimationError: no fix; events needed and not found; no convergence to finite
                values.
        """
        if self.params.method == "extended_rts":
            return ExtendedRts(self.params, self.surface).run(imu, mag, fix, velocity, events,
                                                              initial_quat)
        try:
            told = result = self._smooth(imu, mag, fix, velocity, events, initial_quat)
        except EstimationError:
            if self.surface is None or events is not None:
                raise
            # With fixes of another time no jump is found, and surfaces contradict.
            result = None
            told = Smoother(self.params)._smooth(imu, mag, fix, velocity, None, initial_quat)
            if not find_lag(told.samples, velocity):
                raise
        lag = find_lag(told.samples, velocity)
        if lag:
            result = self._earlier(lag)._smooth(imu, mag, _earlier(fix, lag),
                                                _earlier(velocity, lag), events, initial_quat)
            delay, sd = result.states["gnss_time_offset"]
            result = replace(result, gnss_lag=lag, states={
                **result.states, "gnss_time_offset": (delay + lag, sd)})
        return result

    def _earlier(self, lag):
        """A smoother whose state of the delay can tell what is left of a lag."""
        sd = max(self.params.gnss.time_offset_sd, _LAG_SD)
        return Smoother(self.params.replace(**{"gnss.time_offset_sd": sd}), self.surface)

    def _smooth(self, imu, mag, fix, velocity, events, initial_quat):
        """As :meth:`run`, with the stamps as they are."""
        params, surface = self.params, self.surface
        prepared = prepare_imu(imu, params)
        first = first_place(fix, params.initial.position)
        fix = fix if fix is not None and fix.usable.any() else None
        frame = reference_frame(surface, first)
        constraints = surface.constraints() if surface is not None else ()
        detected = events is None and any(c.phase != "always" for c in constraints)
        if detected:
            events = find_jump(prepared.log, velocity, params.jump.takeoff, params.jump.touchdown)
        readings = prepare_readings({"fix": fix, "velocity": velocity, "mag": mag}, frame, params)
        measured = {MEASUREMENTS[kind].name for kind in np.unique(readings["kind"])}
        around = surroundings_of(params, frame, int(prepared.log.stamp[0]), "mag" in measured)
        problem = Problem(prepared, params, readings, around, constraints,
                          StatePrior.of(params, measured))
        hill = surface if isinstance(surface, Hill) and events is not None else None
        best = None
        start = None if params.initial.position is None else frame.to_enu(*first)
        for quat in first_attitudes(problem, mag, initial_quat, start)[:_STARTS]:
            result = _smooth(problem, frame, hill, quat, events)
            if result is None:
                continue
            if best is None or result.cost[-1] < best.cost[-1]:
                best = result
            judge = "fix" if "fix" in measured else "mag"
            if result.converged and result.misfit().get(judge, 0.0) < _PLAUSIBLE:
                break
        if best is None:
            raise EstimationError("the smoother diverged: noise far below that of the data, or "
                                  "measurements of another recording")
        if detected and hill is not None and params.jump.touchdown is None:
            quat = best.samples["quat_world_imu"][0]
            best = likeliest(best, hill, prepared.log, params,
                             lambda events: _smooth(problem, frame, hill, quat, events))
        if best.failure:
            raise EstimationError(best.failure)
        return best


def _earlier(log, lag):
    """A log whose stamps are earlier by a lag (s)."""
    return replace(log, stamp=log.stamp - np.int64(round(lag * 1e9)))


def _smooth(problem: Problem, frame: LocalFrame, hill: Hill | None, quat: np.ndarray,
            events: JumpEvents | None) -> SmootherResult | None:
    """From one first attitude; None where it diverges."""
    def refine(problem: Problem, events: JumpEvents) -> JumpEvents:
        return events if hill is None else refine_jump(hill, _positions(problem), problem.imu.log,
                                                       events)

    attempt = problem.from_attitude(quat)
    solution = solve(attempt, events if hill is not None else None, refine)
    return _result(attempt, frame, hill, solution) if np.isfinite(attempt.x).all() else None


def _positions(problem: Problem) -> np.ndarray:
    samples = np.empty(len(problem.x), SAMPLE)
    samples["stamp"] = problem.imu.log.stamp
    samples["position_world"] = problem.surface_points()
    return samples


def _result(problem: Problem, frame: LocalFrame, hill: Hill | None, solution: Solution
            ) -> SmootherResult:
    samples = smoothed_samples(problem, solution.last)
    states = smoothed_states(problem, solution.last)
    innovations = {}
    for kind, measurement in enumerate(MEASUREMENTS):
        of_kind = problem.readings["kind"] == kind
        if np.any(of_kind):
            width = len(measurement.components)
            innovations[measurement.name] = (problem.readings["stamp"][of_kind],
                                             problem.innovation[of_kind][:, :width])
    wander = {name: wandering(*of_kind) for name, of_kind in innovations.items()}
    widen(samples, wander)
    fits = surface_fits(problem.constraints, samples, states, solution.events, problem.params)
    jump, failure = None, ""
    if hill is not None and solution.events is not None:
        try:
            jump = jump_result(hill, at_surface(samples, states, problem.params),
                               problem.imu.log, solution.events, misfit_at_landing(fits))
        except EstimationError as error:
            failure = str(error)
    return SmootherResult(samples, frame, states, innovations, tuple(problem.cost),
                          solution.steps, solution.converged, solution.events, jump, fits,
                          wander=wander, failure=failure)
