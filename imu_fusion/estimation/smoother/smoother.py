"""The smoother: trajectory, attitude and sensor errors from a whole recording."""

from dataclasses import replace

import numpy as np

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.smoother.attempt import Attempt, Given, Model, attempt
from imu_fusion.estimation.smoother.extended_rts import ExtendedRts
from imu_fusion.estimation.smoother.gnss_lag import find_lags
from imu_fusion.estimation.smoother.hypotheses import likelier
from imu_fusion.estimation.smoother.imu_input import from_start
from imu_fusion.estimation.smoother.jump_events import JumpEvents
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.receiver_alone import smooth_receiver
from imu_fusion.estimation.smoother.result import SmootherResult
from imu_fusion.samples.logs import FixLog, ImuLog, MagLog, VelocityLog
from imu_fusion.surfaces.constraint import Surface

_LAG_SD = 0.2        # s, of a lag of the receiver's stamps that was found on a grid


class Smoother:
    """Smooths recordings; holds parameters only.

    Args:
        params: SmootherParams.
        surface: Surface or None.
    """

    def __init__(self, params: SmootherParams = SmootherParams(), surface: Surface | None = None):
        self.params, self.surface = params, surface

    def run(self, imu: ImuLog | None, mag: MagLog | None = None, fix: FixLog | None = None,
            velocity: VelocityLog | None = None, events: JumpEvents | None = None,
            initial_quat: np.ndarray | None = None) -> SmootherResult:
        """Smooth one recording.

        Args:
            imu: ImuLog; None: fixes and velocities alone, see :mod:`.receiver_alone`.
            mag: MagLog or None. fix: FixLog. velocity: VelocityLog or None.
            events: JumpEvents, or None: found by ``find_jump`` when the surface needs them.
            initial_quat: (4,) attitude of the first sample; found from the data when None.

        Returns:
            SmootherResult.

        Raises:
            SampleError: unusable samples.
            EstimationError: no fix; events needed and not found; no convergence to finite
                values.
        """
        if imu is None:
            return smooth_receiver(fix, velocity, self.params, self.surface)
        if self.params.method == "extended_rts":
            return ExtendedRts(self.params, self.surface).run(imu, mag, fix, velocity, events,
                                                              initial_quat)
        mag, whole, imu = _calibrated(mag, self.params), len(imu), from_start(imu, self.params)
        given, model = Given(imu, mag, fix, velocity, events, initial_quat), Model(self.params)
        found, lags = self._smooth_and_time(given, model)
        further = lags[1] - lags[0]
        if found is None or any(lags):
            # What is left of a lag is for the states of delays.
            given = given.earlier(*lags)
            gnss = self.params.gnss
            model = model.changed({"gnss.time_offset_sd": max(gnss.time_offset_sd, _LAG_SD)})
            if further:
                model = model.changed({"gnss.velocity_time_offset_sd": max(
                    gnss.velocity_time_offset_sd, _LAG_SD)})
            found = attempt(given, model, self.surface)
        result = likelier(found, model, lambda other: attempt(given, other, self.surface))
        if any(lags):
            states = dict(result.states)
            for name, lag in (("gnss_time_offset", lags[0]), ("velocity_time_offset", further)):
                if name in states:
                    states[name] = states[name][0] + lag, states[name][1]
            result = replace(result, gnss_lag=lags[0], velocity_lag=further, states=states)
        return replace(result, left_out=whole - len(imu),
                       start_found=self.params.initial.start is None)

    def _smooth_and_time(self, given: Given, model: Model
                         ) -> tuple[Attempt | None, tuple[float, float]]:
        """Smoothed with the stamps as they are (None where that cannot be), and the lags (s) of
        fixes and velocities that it tells."""
        try:
            found = attempt(given, model, self.surface)
        except EstimationError:
            if self.surface is None or given.events is not None:
                raise
            # With fixes of another time no jump is found, and surfaces contradict.
            lags = self._lags(given, attempt(given, model, None))
            if not any(lags):
                raise
            return None, lags
        return found, self._lags(given, found)

    def _lags(self, given: Given, found: Attempt) -> tuple[float, float]:
        return find_lags(found.result.samples, found.result.frame, given.fix, given.velocity)


def _calibrated(mag, params):
    """The field as sensor.mag_offset and mag_matrix make it of a MagLog or None."""
    if mag is None:
        return None
    matrix = np.reshape(params.sensor.mag_matrix, (3, 3))
    return replace(mag, mag=(mag.mag - params.sensor.mag_offset) @ matrix.T)
