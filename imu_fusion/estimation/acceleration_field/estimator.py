"""Estimator of the acceleration field of a rigid body from accelerometers.

Three methods behind one interface: the accelerometer-only algorithm of Rahaman 2019 (``ao``),
its variant with the angular velocity from the symmetric part (``sqrt_ao``), and an estimator on
the rigid-body model itself (``rigid_body``), causal or smoothed.

    estimator = AccelerationFieldEstimator(params, accelerometers)
    for stamp, readings in samples:        # live
        rows = estimator.add(stamp, readings)
    rows = estimator.run(stamps, readings)  # batch: the same numbers, bit for bit
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from imu_fusion.errors import EstimationError, SampleError
from imu_fusion.estimation.acceleration_field.affine import AffineFilter
from imu_fusion.estimation.acceleration_field.kernel_params import kernel_params
from imu_fusion.estimation.acceleration_field.maximum_likelihood import fit_densities
from imu_fusion.estimation.acceleration_field.motion_model import (
    ALPHA,
    BIAS,
    OMEGA,
    State,
    parts,
)
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
)
from imu_fusion.estimation.acceleration_field.range_limits import RangeLimits
from imu_fusion.estimation.acceleration_field.rigid_body_filter import RigidBodyFilter
from imu_fusion.estimation.acceleration_field.rigid_body_smoother import smooth
from imu_fusion.estimation.acceleration_field.rows import ROW, put_still_rows
from imu_fusion.estimation.acceleration_field.sensor_array import make_sensor_array
from imu_fusion.estimation.acceleration_field.sensor_faults import (
    SensorFit,
    coarse_remarks,
    fit_remarks,
    sensor_fits,
)
from imu_fusion.estimation.acceleration_field.standing_axes import StandingAxes
from imu_fusion.estimation.acceleration_field.start import Start, given_start, is_still, rest_start
from imu_fusion.estimation.acceleration_field.wrong_start import turn_to_reckon_with

_BARE = 3    # samples in which accelerometers at their limits leave too few: worth a remark


class AccelerationFieldEstimator:
    """Acceleration field, angular velocity and orientation of a rigid body.

    Args:
        params: AccelerationFieldParams.
        accelerometers: sequence, or mapping by name, of AccelerometerParams.

    Raises:
        LayoutError: an array that the method cannot use.

    Samples are (N, 3) readings in the sensors' own axes, m/s^2, NaN where there is none. A
    saturated or missing channel is left out of its sample and flagged.
    """

    def __init__(self, params: AccelerationFieldParams,
                 accelerometers: Sequence[AccelerometerParams] | Mapping[str, AccelerometerParams]):
        sensors = (accelerometers.values() if isinstance(accelerometers, Mapping)
                   else accelerometers)
        self.names = ([*accelerometers] if isinstance(accelerometers, Mapping)
                      else [str(k) for k in range(len(sensors))])
        self.params = params
        self.array = make_sensor_array(tuple(sensors), params.sensor, params.use_gyro)
        self.array = (self.array.with_mounting_states() if params.method == "rigid_body"
                      else self.array.for_affine_fit(params.max_condition))
        self.array.require(params.method, params.max_condition)
        self.fitted = params
        self._smoothed: State | None = None
        self.reset()

    @property
    def condition_number(self) -> float:
        """Of the fit that the method needs: affine for ao, sqrt_ao, else of a and alpha."""
        return (self.array.condition_rigid if self.params.method == "rigid_body"
                else self.array.condition_affine)

    def reset(self, start_known: bool = True) -> None:
        """Forget all samples and start anew; ``fitted``, what the last maximum likelihood gave,
        stays, and so does what :meth:`finish` found of the sensors. start_known: whether the next
        sample is the first one, of which initial.mode given tells; else the body has to be still
        before there are estimates again."""
        self._waits = self.params.initial.mode == "rest" or not start_known
        self._filter: RigidBodyFilter | AffineFilter | None = None
        self._start: Start | None = None
        self._rest: np.ndarray | None = None
        self._last: int | None = None
        self._stamps: list[np.ndarray] = []
        self._readings: list[np.ndarray] = []
        self._late: list[np.ndarray] = []    # rows of mode smoothed before its first sample
        self._limits = RangeLimits(self.array)
        self._standing = StandingAxes(self.params, self.array)

    def sensor_fits(self) -> list[SensorFit]:
        """How each accelerometer fits to the others, by the samples so far (or by those that
        :meth:`finish` smoothed); none by the methods ao and sqrt_ao, and before the first."""
        state = self._judged
        return [] if state is None else sensor_fits(self.names, self.array, state,
                                                    self._standing.texts(self.names))

    def remarks(self) -> list[str]:
        """What is wrong with the sensors, and what to do, by the samples so far."""
        found = []
        mounting = self.array.felt[["position_sd", "axes_sd", "scale_sd"]].tolist()
        if self.params.method != "rigid_body" and np.any(mounting):
            found.append(f"method '{self.params.method}' takes positions, axes and scales as "
                         "exact: what it states leaves their errors out; use rigid_body, or say "
                         "that they are (position_sd, axes_sd and scale_sd 0)")
        if self._judged is not None:
            found += fit_remarks(self.sensor_fits(), self.array, self.params, self._judged)
        found += [text for text in self._standing.texts(self.names).values() if text not in found]
        found += coarse_remarks(self.names, self.array, self.params, self._limits.steps)
        unit = {"gyroscope": "rad/s"}
        for name, limits in self.limits_found.items():
            known = ", ".join(f"{limit:.6g}" for limit in limits if np.isfinite(limit))
            where = "sensor.gyro_range" if name == "gyroscope" else f"accelerometers.{name}.range"
            found.append(f"{name}: stands at its limit of {known} {unit.get(name, 'm/s^2')} and is "
                         f"not used there: set {where}, and take a sensor of a larger range if the "
                         "others are at theirs, too")
        bare, samples = self._limits.bare.tolist()
        if bare >= _BARE:
            found.append(f"accelerometers at their limits leave too few channels in {bare} of "
                         f"{samples} samples to check or even to tell how it moves: what follows "
                         "may be further off than stated; take sensors of a larger range")
        return found

    @property
    def _judged(self) -> State | None:
        return (self._filter.state if isinstance(self._filter, RigidBodyFilter)
                and self.params.mode == "causal" else self._smoothed)

    @property
    def limits_found(self) -> dict[str, tuple[float, ...]]:
        """Ranges that were found from flat tops, by accelerometer ("gyroscope" for it), three axes;
        inf where none was."""
        names = [*self.names, "gyroscope"]
        return {names[k]: tuple(own.tolist()) for k, own in enumerate(self._limits.learnt)
                if np.isfinite(own).any()}

    def get_state(self) -> dict[str, Any]:
        """Everything that a later :meth:`set_state` needs to go on from here."""
        return {"filter": None if self._filter is None else self._filter.get_state(),
                "start": self._start, "rest": self._rest, "last": self._last, "waits": self._waits,
                "limits": self._limits.get_state(),
                "standing": (self._standing.found.copy(), self._standing.others.copy()),
                "late": list(self._late),
                "stamps": list(self._stamps), "readings": list(self._readings)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from where :meth:`get_state` was called, in an estimator of equal parameters."""
        self._start, self._rest, self._last = state["start"], state["rest"], state["last"]
        self._waits = state["waits"]
        self._stamps, self._readings = list(state["stamps"]), list(state["readings"])
        self._limits.set_state(state["limits"])
        self._standing.found, self._standing.others = (part.copy() for part in state["standing"])
        self._late = list(state["late"])
        self._filter = None
        if state["filter"] is not None:
            self._filter = self._make_filter(self._start)
            self._filter.set_state(state["filter"])

    def add(self, stamp: int, readings: ArrayLike, gyr: ArrayLike | None = None) -> np.ndarray:
        """Take one sample.

        Args:
            stamp: int ns, later than the one before.
            readings: (N, 3) m/s^2 in the sensors' axes.
            gyr: (3,) rad/s if there is a gyroscope.

        Returns:
            Structured array ROW: the row of this sample; nothing while waiting for rest (those rows
            come when it is over), and nothing in mode smoothed (see :meth:`finish`).

        Raises:
            SampleError: wrong shape, or a stamp that is not later than the previous one.
        """
        return self.take(np.array([stamp]), np.asarray(readings, dtype=float)[None],
                         None if gyr is None else np.asarray(gyr, dtype=float)[None])

    def take(self, stamp: ArrayLike, readings: ArrayLike,
             gyr: ArrayLike | None = None) -> np.ndarray:
        """:meth:`add` of n samples: stamp (n,), readings (n, N, 3), gyr (n, 3). Returns ROWs."""
        stamp = np.ascontiguousarray(stamp, dtype=np.int64)
        return self._take(*self._check(stamp, np.asarray(readings, dtype=float), gyr))

    def run(self, stamp: ArrayLike, readings: ArrayLike,
            gyr: ArrayLike | None = None) -> np.ndarray:
        """Take n samples and finish: stamp (n,), readings (n, N, 3), gyr (n, 3). Returns ROWs."""
        return np.concatenate([self.take(stamp, readings, gyr), self.finish()])

    def finish(self) -> np.ndarray:
        """Rows of all samples in mode smoothed, else none. Forgets the samples it smoothed.

        Raises:
            EstimationError: the body never was still, as it has to be with initial.mode rest.
        """
        if self._filter is None and self._stamps:
            raise EstimationError(
                f"the body was never still for {self.params.initial.duration} s, as it has to be "
                "with initial.mode rest, and where the clock was set, or what it felt was not "
                "gravity (units?); give initial.orientation and initial.angular_velocity with "
                "initial.mode given, or raise initial.still_sd")
        if self.params.mode != "smoothed":
            return np.empty(0, ROW)
        if not self._stamps:
            rows = np.concatenate([np.empty(0, ROW), *self._late])
            self.reset()
            return rows
        stamp, readings = np.concatenate(self._stamps), np.concatenate(self._readings)
        limits = RangeLimits(self.array)
        limits.mark(readings)    # first what the whole recording tells of them
        limits.bare[:] = 0
        standing = StandingAxes(self.params, self.array)
        readings = standing.mark(self._channels(limits.mark(readings)))
        params = self.params
        if params.maximum_likelihood != "off":
            params = fit_densities(params, self.array, self._make_start, stamp, readings)
            self.fitted = params
        rows, self._smoothed = smooth(params, self.array, self._make_start(params), stamp, readings)
        rows = np.concatenate([*self._late, rows])
        self.reset()
        self._limits, self._standing = limits, standing
        return rows

    def _check(self, stamp, readings, gyr):
        expected = (len(stamp), self.array.accelerometers, 3)
        if readings.shape != expected:
            raise SampleError(f"acceleration field: readings of shape {readings.shape}, expected "
                              f"{expected}: samples, accelerometers, axes")
        flat = readings.reshape(len(stamp), -1)
        if self.params.use_gyro:
            gyr = np.full((len(stamp), 3), np.nan) if gyr is None else np.asarray(gyr, dtype=float)
            flat = np.hstack([flat, gyr.reshape(len(stamp), 3)])
        late = len(stamp) > 0 and self._last is not None and stamp[0] <= self._last
        if late or (len(stamp) > 1 and (stamp[1:] <= stamp[:-1]).any()):
            before = np.append(stamp[:1] - 1 if self._last is None else self._last, stamp[:-1])
            bad = np.argmax(stamp <= before)
            raise SampleError(f"acceleration field: stamp {stamp[bad]} ns is not later "
                              f"than {before[bad]} ns before it; sort and merge the samples")
        return stamp, flat

    def _channels(self, flat):
        """Readings (n, m) of the channels of flattened samples."""
        return np.ascontiguousarray(flat[:, self.array.channels["column"]])

    def _take(self, stamp, flat):
        if not len(stamp):
            return np.empty(0, ROW)
        self._last = int(stamp[-1])
        readings = self._standing.mark(self._channels(self._limits.mark(flat)))
        rows, done = [], 0
        while self._filter is None and done < len(stamp):
            if not self._waits:
                self._begin()
            else:
                rows.append(self._wait_for_rest(stamp[done:done + 1], readings[done:done + 1]))
                done += 1
        if self.params.mode == "smoothed":
            self._late += rows
            if self._filter is not None and done < len(stamp):
                self._stamps.append(stamp[done:])
                self._readings.append(flat[done:])
            return np.empty(0, ROW)
        if self._filter is not None and done < len(stamp):
            rows.append(self._filter.process(stamp[done:], readings[done:]))
        return rows[0] if len(rows) == 1 else np.concatenate([np.empty(0, ROW), *rows])

    def _wait_for_rest(self, stamp, readings):
        """Take one sample; returns the rows of all since the body is still, once it was so for long
        enough."""
        self._stamps.append(stamp)
        self._readings.append(readings)
        duration = int(round(self.params.initial.duration * 1e9))
        if self._stamps[-1][0] - self._stamps[0][0] < duration:
            return np.empty(0, ROW)
        if is_still(self.params, self.array, np.concatenate(self._readings)):
            stamps = np.concatenate(self._stamps)
            return self._still_rows(stamps, self._begin())
        # A quarter of the window at a time: looking again at every sample would cost more than
        # the estimate itself.
        quarter = max(1, len(self._stamps) // 4)
        del self._stamps[:quarter], self._readings[:quarter]
        return np.empty(0, ROW)

    def _still_rows(self, stamp, start):
        x = parts(start.x)
        rows = np.empty(len(stamp), ROW)
        doubt = np.zeros(BIAS)
        doubt[OMEGA:ALPHA] = turn_to_reckon_with(start.about)
        put_still_rows(kernel_params(self.params, self.array), stamp, start.quat, x.omega, x.alpha,
                       x.acc, np.ascontiguousarray(start.cov[:BIAS, :BIAS]), doubt, rows)
        return rows

    def _begin(self):
        self._rest = np.concatenate(self._readings) if self._readings else None
        self._start = self._make_start(self.params)
        self._filter = self._make_filter(self._start)
        self._stamps, self._readings = [], []
        return self._start

    def _make_start(self, params):
        if self._rest is None:
            return given_start(params, self.array)
        return rest_start(params, self.array, self._rest)

    def _make_filter(self, start):
        if self.params.method == "rigid_body":
            return RigidBodyFilter(self.params, self.array, start, asks=True)
        return AffineFilter(self.params, self.array, start)
