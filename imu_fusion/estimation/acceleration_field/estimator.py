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
from imu_fusion.estimation.acceleration_field.maximum_likelihood import fit_densities
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
)
from imu_fusion.estimation.acceleration_field.rigid_body_filter import RigidBodyFilter
from imu_fusion.estimation.acceleration_field.rigid_body_smoother import smooth
from imu_fusion.estimation.acceleration_field.rows import ROW
from imu_fusion.estimation.acceleration_field.sensor_array import make_sensor_array
from imu_fusion.estimation.acceleration_field.start import Start, given_start, is_still, rest_start


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
        self.params = params
        self.array = make_sensor_array(tuple(sensors), params.sensor, params.use_gyro)
        if params.method != "rigid_body":
            self.array = self.array.for_affine_fit(params.max_condition)
        self.array.require(params.method, params.max_condition)
        self.fitted = params
        self.reset()

    @property
    def condition_number(self) -> float:
        """Of the fit that the method needs: affine for ao, sqrt_ao, else of a and alpha."""
        return (self.array.condition_rigid if self.params.method == "rigid_body"
                else self.array.condition_affine)

    def reset(self) -> None:
        """Forget all samples and start anew; ``fitted``, what the last maximum likelihood gave,
        stays."""
        self._filter: RigidBodyFilter | AffineFilter | None = None
        self._start: Start | None = None
        self._rest: np.ndarray | None = None
        self._last: int | None = None
        self._stamps: list[np.ndarray] = []
        self._readings: list[np.ndarray] = []

    def get_state(self) -> dict[str, Any]:
        """Everything that a later :meth:`set_state` needs to go on from here."""
        return {"filter": None if self._filter is None else self._filter.get_state(),
                "start": self._start, "rest": self._rest, "last": self._last,
                "stamps": list(self._stamps), "readings": list(self._readings)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from where :meth:`get_state` was called, in an estimator of equal parameters."""
        self._start, self._rest, self._last = state["start"], state["rest"], state["last"]
        self._stamps, self._readings = list(state["stamps"]), list(state["readings"])
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
            Structured array ROW: the row of this sample; nothing while waiting for rest, and
            nothing in mode smoothed (see :meth:`finish`).

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
            EstimationError: initial.mode is rest and the body never was still.
        """
        if self._filter is None and self._stamps:
            raise EstimationError(
                f"initial.mode rest: the body was never still for {self.params.initial.duration} "
                "s; give initial.orientation and initial.angular_velocity with initial.mode "
                "given, or raise initial.still_sd")
        if self.params.mode != "smoothed" or not self._stamps:
            return np.empty(0, ROW)
        stamp, readings = np.concatenate(self._stamps), np.concatenate(self._readings)
        params = self.params
        if params.maximum_likelihood != "off":
            params = fit_densities(params, self.array, self._make_start, stamp, readings)
            self.fitted = params
        rows = smooth(params, self.array, self._make_start(params), stamp, readings)
        self.reset()
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
        before = np.append(stamp[:1] - 1 if self._last is None else self._last, stamp[:-1])
        bad = np.flatnonzero(stamp <= before[:len(stamp)])
        if len(bad):
            raise SampleError(f"acceleration field: stamp {stamp[bad[0]]} ns is not later "
                              f"than {before[bad[0]]} ns before it; sort and merge the samples")
        return stamp, np.ascontiguousarray(flat[:, self.array.channels["column"]])

    def _take(self, stamp, readings):
        if len(stamp):
            self._last = int(stamp[-1])
        done = 0
        while self._filter is None and done < len(stamp):
            if self.params.initial.mode == "given":
                self._begin()
            else:
                self._wait_for_rest(stamp[done:done + 1], readings[done:done + 1])
                done += 1
        if self._filter is None or done == len(stamp):
            return np.empty(0, ROW)
        stamp, readings = stamp[done:], readings[done:]
        if self.params.mode == "smoothed":
            self._stamps.append(stamp)
            self._readings.append(readings)
            return np.empty(0, ROW)
        return self._filter.process(stamp, readings)

    def _wait_for_rest(self, stamp, readings):
        self._stamps.append(stamp)
        self._readings.append(readings)
        duration = int(round(self.params.initial.duration * 1e9))
        if self._stamps[-1][0] - self._stamps[0][0] < duration:
            return
        if is_still(self.params, self.array, np.concatenate(self._readings)):
            self._begin()
            return
        # A quarter of the window at a time: looking again at every sample would cost more than
        # the estimate itself.
        quarter = max(1, len(self._stamps) // 4)
        del self._stamps[:quarter], self._readings[:quarter]

    def _begin(self):
        self._rest = np.concatenate(self._readings) if self._readings else None
        self._start = self._make_start(self.params)
        self._filter = self._make_filter(self._start)
        self._stamps, self._readings = [], []

    def _make_start(self, params):
        if self._rest is None:
            return given_start(params, self.array)
        return rest_start(params, self.array, self._rest)

    def _make_filter(self, start):
        kind = RigidBodyFilter if self.params.method == "rigid_body" else AffineFilter
        return kind(self.params, self.array, start)
