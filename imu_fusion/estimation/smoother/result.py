"""What the smoother returns."""

from dataclasses import dataclass, field

import numpy as np

from imu_fusion.estimation.smoother.gnss_step import GnssStep
from imu_fusion.estimation.smoother.jump_events import JumpEvents
from imu_fusion.estimation.smoother.jump_result import JumpResult
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.profile_fit import ProfileError
from imu_fusion.estimation.smoother.remarks import remarks_on
from imu_fusion.estimation.smoother.rests import Rest
from imu_fusion.estimation.smoother.surface_fit import SurfaceFit
from imu_fusion.geometry.geodesy import LocalFrame

SAMPLE = np.dtype([
    ("stamp", "i8"), ("position_world", "f8", 3), ("vel_world", "f8", 3),
    ("quat_world_imu", "f8", 4), ("acc", "f8", 3), ("gyr", "f8", 3), ("gyr_bias", "f8", 3),
    ("acc_bias", "f8", 3), ("cov_position", "f8", (3, 3)), ("cov_velocity", "f8", (3, 3)),
    ("cov_attitude", "f8", (3, 3)), ("gyr_bias_sd", "f8", 3), ("acc_bias_sd", "f8", 3),
    ("gyr_sd", "f8", 3), ("acc_sd", "f8", 3)])

_GAUSSIAN_MEDIAN = 0.6745    # of |x|, x standard normal
_OUTLIER = 6.0               # standard deviations: the default of gnss.loss_scale


def _typical(values):
    """Standard deviation of values, by the median: outliers do not count."""
    return float(np.median(np.abs(values)) / _GAUSSIAN_MEDIAN)


@dataclass(frozen=True)
class Outliers:
    """``share`` of readings that lie beyond six times what is stated of them, and what is typical
    among them, so that the Cauchy loss lets go of them; number ``longest`` of the longest run of
    such, over ``duration`` s."""

    share: float
    longest: int
    duration: float

    @classmethod
    def of(cls, stamp: np.ndarray, residual: np.ndarray) -> "Outliers":
        """Of readings with stamps (m,) ns and residuals (m, k) in standard deviations."""
        limit = _OUTLIER * max(1.0, _typical(residual))
        out = np.concatenate([[False], np.linalg.norm(residual, axis=1) > limit, [False]])
        begins, ends = np.flatnonzero(out[1:] & ~out[:-1]), np.flatnonzero(out[:-1] & ~out[1:])
        if not len(begins):
            return cls(0.0, 0, 0.0)
        i = int(np.argmax(ends - begins))
        return cls(float(out[1:-1].mean()), int(ends[i] - begins[i]),
                   float(stamp[ends[i] - 1] - stamp[begins[i]]) * 1e-9)


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
    innovations (m, 3)), white with unit variance where the model is right; ``residuals``: name ->
    (m, 3) of the same readings against the smoothed trajectory, in standard deviations.
    ``surface``: name of a constraint -> SurfaceFit.
    ``log_likelihood`` of the readings under the model (Laplace's approximation), but for a constant
    of the recording.
    ``cost``: of the trajectory before each step; ``iterations`` counts the steps;
    ``converged``: None where the method passes once and so cannot tell.
    ``gnss_lag``: s, by which the receiver's stamps were found late and taken earlier;
    ``velocity_lag``: s, by which those of velocities were found later still.
    ``gnss_step``: a step of all fixes that was found, or None.
    ``repeats``: name -> number of readings that are the one before exactly and were left out.
    ``adapted``: name of a parameter -> value that was used in its place, as the readings are far
    likelier under it; ``noise``: name of readings -> factor of their stated standard deviations,
    likewise.
    ``wander``: name -> how much larger than white noise leaves them its innovations are in the
    mean over seconds (:func:`.whiteness.wandering`), 1 where they are white; what is stated has
    been widened by it (:func:`.whiteness.widen`).
    ``acc_density``: m/s^2/sqrt(Hz), of the accelerations of a body that carries no Imu, so that
    attitudes are unknown; None: it does.
    ``near_ground``: s until the touch-down, for which the flight is close to the landing profile,
    or below it.
    ``stands``: whether the sensor is at its height above the profile after a touch-down; False:
    these heights hardly count. ``profile``: an error of the landing profile that the readings show,
    which counts less for it.
    ``late``: "gyr" or "mag" -> s, by which these were found later than the accelerometer.
    ``clock_rate``: by which the receiver's clock was found to run faster than that of the Imu, in
    the middle of the recording right; its stamps were taken in time of the Imu.
    ``height_scale``: how many times as much as the body heights of the fixes change, at least.
    ``lost_turns``: stamps (ns) from which on the attitude is one of several that are about as
    likely: the turn about the field had been lost.
    ``centre``: (3,) m from the accelerometers, of a tumbling body whose surface.lever_arm is
    another; None: it is not.
    ``clipped_forces``: number of Imu samples whose force was at the end of a range that was found,
    and that range (m/s^2).
    ``left_out``: number of Imu samples before the start; ``start_found``: whether that was found.
    ``rests``: at which the velocity was taken for zero.
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
    residuals: dict[str, np.ndarray] = field(default_factory=dict)
    gnss_lag: float = 0.0
    velocity_lag: float = 0.0
    gnss_step: GnssStep | None = None
    repeats: dict[str, int] = field(default_factory=dict)
    adapted: dict[str, float] = field(default_factory=dict)
    noise: dict[str, float] = field(default_factory=dict)
    wander: dict[str, float] = field(default_factory=dict)
    acc_density: float | None = None
    near_ground: float = 0.0
    stands: bool = True
    profile: ProfileError = ProfileError()
    late: dict[str, float] = field(default_factory=dict)
    clock_rate: float = 0.0
    height_scale: float = 1.0
    lost_turns: tuple[int, ...] = ()
    centre: np.ndarray | None = None
    clipped_forces: tuple[int, float] = (0, np.inf)
    rests: tuple[Rest, ...] = ()
    left_out: int = 0
    start_found: bool = False
    failure: str = ""
    log_likelihood: float = -np.inf

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
        return {name: _typical(values)
                for name, (_, values) in self.innovations.items() if len(values)}

    def outliers(self) -> dict[str, Outliers]:
        """Name -> Outliers among its readings."""
        return {name: Outliers.of(self.innovations[name][0], residual)
                for name, residual in self.residuals.items()}

    def remarks(self) -> list[str]:
        """What a user should know before trusting the result: texts."""
        return list(remarks_on(self))
