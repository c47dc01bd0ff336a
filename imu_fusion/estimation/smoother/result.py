"""What the smoother returns."""

from dataclasses import dataclass, field

import numpy as np

from imu_fusion.estimation.smoother.jump_events import JumpEvents
from imu_fusion.estimation.smoother.jump_result import JumpResult
from imu_fusion.estimation.smoother.measurements.registry import MEASUREMENTS
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.surface_fit import SurfaceFit
from imu_fusion.geometry.geodesy import LocalFrame

SAMPLE = np.dtype([
    ("stamp", "i8"), ("position_world", "f8", 3), ("vel_world", "f8", 3),
    ("quat_world_imu", "f8", 4), ("acc", "f8", 3), ("gyr", "f8", 3), ("gyr_bias", "f8", 3),
    ("acc_bias", "f8", 3), ("cov_position", "f8", (3, 3)), ("cov_velocity", "f8", (3, 3)),
    ("cov_attitude", "f8", (3, 3)), ("gyr_bias_sd", "f8", 3), ("acc_bias_sd", "f8", 3),
    ("gyr_sd", "f8", 3), ("acc_sd", "f8", 3)])

_GAUSSIAN_MEDIAN = 0.6745    # of |x|, x standard normal
_MISFIT = 3.0
# RMS of a single pass. Simulated jumps: 1.0 to 1.1 where the attitude is within 1 deg of the truth,
# 1.7 where it is 6 deg off.
_SINGLE_PASS = 1.3
_EXCESS = 1.5                # of the deviation from a surface; see smoother_surface_fit
# Simulated jumps, sunk by 0.3 m: up to 1.4; by 0.7 m, or a fall of 0.4 m: from 2.5.
_FIRST_EXCESS = 2.0
_LEAP_SECONDS = 18.0         # s, GPS time ahead of UTC since 2017
_SILENT = 0.01               # share of the samples
_BESIDE = 5.0                # standard deviations of the median innovation of fixes
_MEDIAN_SD = 1.2533          # of the median, by that of the mean: sqrt(pi / 2)
_WANDERS = {
    "fix": "of the receiver: gnss.position_error_sd; a change of datum or antenna",
    "velocity": "of the receiver: gnss.velocity_error_sd",
    "mag": "of the field: iron nearby, sensor.mag_bias_sd"}
_ADVICE = {m.name: m.advice for m in MEASUREMENTS}


def reading_variances(stamp: np.ndarray, params: SmootherParams) -> np.ndarray:
    """Variances (2,) of the noise in one sample of rate and of force, of the stated densities.

    Args:
        stamp: (n,) ns. params: SmootherParams.
    """
    rate = 1e9 / np.median(np.diff(stamp))
    return rate * np.square([params.sensor.gyro_noise_density,
                              params.sensor.acc_noise_density])


@dataclass(frozen=True)
class SmootherResult:
    """What the smoother found.

    ``samples``: structured array (:data:`SAMPLE`), one per usable Imu sample; ``acc`` and
    ``gyr`` are corrected of the estimated errors, in the imu frame, and still carry the noise
    of their sample: ``acc_sd`` and ``gyr_sd`` are of all of it. Where a reading was clipped,
    they are those of the smoothed motion. ``cov_attitude`` is that of the rotation vector in
    imu axes. ``states``: name -> (values (n, k), sd (n, k)) of the
    optional states, in SI units. ``innovations``: name -> (stamp (m,), normalised
    innovations (m, 3)), white with unit variance where the model is right.
    ``surface``: name of a constraint -> SurfaceFit.
    ``cost``: of the trajectory before each step; ``iterations`` counts the steps;
    ``converged``: None where the method passes once and so cannot tell.
    ``gnss_lag``: s, by which the receiver's stamps were found late and taken earlier.
    ``wander``: name -> how much larger than white noise leaves them its innovations are in the
    mean over seconds (:func:`.whiteness.wandering`), 1 where they are white; what is stated has
    been widened by it (:func:`.whiteness.widen`).
    ``failure``: why nothing could be read off a jump; empty in what the smoother returns.
    """

    samples: np.ndarray
    frame: LocalFrame
    states: dict[str, tuple[np.ndarray, np.ndarray]]
    innovations: dict[str, tuple[np.ndarray, np.ndarray]]
    cost: tuple[float, ...]
    iterations: int
    converged: bool | None
    events: JumpEvents | None = None
    jump: JumpResult | None = None
    surface: dict[str, SurfaceFit] = field(default_factory=dict)
    gnss_lag: float = 0.0
    wander: dict[str, float] = field(default_factory=dict)
    failure: str = ""

    def summary(self) -> str:
        """One line."""
        jump = f", jump length {self.jump.length:.1f} m" if self.jump else ""
        state = "converged" if self.converged else "did not converge"
        steps = "a single pass" if self.converged is None else \
            f"{self.iterations} iterations ({state})"
        return f"{len(self.samples)} samples, {steps}, cost {self.cost[-1]:.6g}{jump}"

    def misfit(self) -> dict[str, float]:
        """Name -> typical size of its innovations, in standard deviations: 1 where the model is
        right. By the median, so that outliers do not count."""
        return {name: float(np.median(np.abs(values)) / _GAUSSIAN_MEDIAN)
                for name, (_, values) in self.innovations.items() if len(values)}

    def _astray(self):
        """Name and RMS of the largest innovations of a single pass, None where all fit.

        By the RMS: no iteration mends a wrong first attitude, and what it costs the first
        seconds is lost in a median.
        """
        if self.converged is not None:
            return None
        rms = {name: float(np.sqrt(np.mean(values ** 2)))
               for name, (_, values) in self.innovations.items() if len(values)}
        name = max(rms, key=lambda name: rms[name], default=None)
        return (name, rms[name]) if name and rms[name] > _SINGLE_PASS else None

    def _beside(self):
        """Medians (3,) of the normalised innovations of fixes, None if they may be chance or no
        surface holds the trajectory."""
        if not self.surface or "fix" not in self.innovations:
            return None
        values = self.innovations["fix"][1]
        middle = np.median(values, axis=0)
        certain = np.abs(middle).max() > _BESIDE * _MEDIAN_SD / np.sqrt(len(values))
        return middle if certain else None

    def remarks(self) -> list[str]:
        """What a user should know before trusting the result: texts."""
        texts = []
        if self.converged is False:
            texts.append(f"the smoother did not converge in {self.iterations} iterations: take its "
                         "result as provisional")
        if self.gnss_lag:
            leap = ": GPS time that was not turned into UTC" if abs(
                abs(self.gnss_lag) - _LEAP_SECONDS) < 0.5 else ""
            texts.append(f"the stamps of fixes and velocities are {abs(self.gnss_lag):.1f} s "
                         f"{'late' if self.gnss_lag > 0 else 'early'} against those of the Imu, "
                         f"as turns and forces tell{leap}; they were taken so much "
                         f"{'earlier' if self.gnss_lag > 0 else 'later'}. Correct the recording, "
                         "or see that both clocks are one")
        astray = self._astray()
        if astray is not None:
            texts.append(f"the {astray[0]} innovations of the single pass have an RMS of "
                         f"{astray[1]:.1f} standard deviations: it may have begun with a wrong "
                         "attitude and kept to it, or the noise is another; method: iterated "
                         "starts from several and repeats")
        for name, size in self.misfit().items():
            if size > _MISFIT:
                texts.append(f"the {name} innovations are {size:.1f} times as large as their "
                             f"standard deviations: {_ADVICE[name]}")
        for name, excess in self.wander.items():
            if excess > 1.0:
                texts.append(
                    f"the {name} innovations wander: their means over seconds are {excess:.1f} "
                    "times as large as white noise leaves them: a step or slow errors "
                    f"({_WANDERS.get(name, 'sensor noise')}), or noise and bias walks of the Imu "
                    "that are too small (sensor.gyro_noise_density, sensor.acc_noise_density, "
                    "sensor.gyro_bias_walk, sensor.acc_bias_walk); the standard deviations of "
                    f"{'headings' if name == 'mag' else 'all'} are as much larger")
        beside = self._beside()
        if beside is not None:
            texts.append("the fixes lie beside the trajectory that the surface holds, by "
                         + "/".join(f"{b:+.1f}" for b in beside) + " (east/north/up) of their "
                         "standard deviations: the origin of the surface may be off, the sensor "
                         "ride above it (surface.body_height) or the fixes wander "
                         "(gnss.position_error_sd)")
        for name, fit in self.surface.items():
            if fit.silent > _SILENT:
                texts.append(f"the surface ({name}) says nothing at {100 * fit.silent:.0f} % of "
                             "the samples that it should hold: its grid may end there")
            if fit.first_excess > _FIRST_EXCESS and fit.excess <= _EXCESS and self.jump:
                texts.append(
                    f"in the first second the trajectory stands off the surface ({name}) by "
                    f"{fit.first_excess:.1f} times as much as its sigma of {fit.sigma:g} m allows: "
                    "a fall, a deep landing or another touch-down; standard deviations of the "
                    "landing are as much larger (jump.event_margin, jump.touchdown)")
            if fit.excess > _EXCESS:
                texts.append(
                    f"the trajectory stands off the surface ({name}) by {fit.rms:.2f} m (RMS; "
                    f"largest {fit.largest:.2f} m), over seconds {fit.excess:.1f} times as much as "
                    f"its sigma of {fit.sigma:g} m allows: the surface may be another than the one "
                    "given, or the sensor move against it (a larger sigma or surface.interval, "
                    "surface.body_height_sd)")
        return texts
