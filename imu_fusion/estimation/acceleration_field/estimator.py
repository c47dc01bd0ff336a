"""Estimator of the acceleration field of a rigid body from accelerometers.

Three methods behind one interface: the accelerometer-only algorithm of Rahaman 2019 (``ao``),
its variant with the angular velocity from the symmetric part (``sqrt_ao``), and an estimator on
the rigid-body model itself (``rigid_body``), causal or smoothed.

    estimator = AccelerationFieldEstimator(params, accelerometers)
    for stamp, readings in samples:        # live
        rows = estimator.add(stamp, readings)
    rows = estimator.run(stamps, readings)  # batch: the same numbers, bit for bit
"""

from dataclasses import dataclass

import numpy as np

from imu_fusion.errors import EstimationError, LayoutError, SampleError
from imu_fusion.estimation.acceleration_field.affine import AffineFilter
from imu_fusion.estimation.acceleration_field.layout import AccelerometerParams, make_layout
from imu_fusion.estimation.acceleration_field.rigid import RigidBodyFilter, fit_densities, smooth
from imu_fusion.estimation.acceleration_field.rows import ROW, make_rows
from imu_fusion.estimation.acceleration_field.start import given_start, is_still, rest_start
from imu_fusion.parameters.declare import Parameters, flatten, param


@dataclass(frozen=True)
class GyroscopeParams(Parameters):
    """A gyroscope on the same body; in files and ROS below ``gyroscope.``"""

    axes: tuple[float, ...] = param(
        (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), length=9, low=-1, high=1,
        doc="Sensor axes in body coordinates, row by row; orthonormal.")
    noise_density: float = param(1e-3, unit="rad/s/sqrt(Hz)", low=1e-9, doc="White noise.")
    range: float | None = param(
        None, unit="rad/s", low=0, doc="Rates of this magnitude or more are clipped: not used.")
    bias_sd: float = param(0.02, unit="rad/s", low=0, doc="Uncertainty of the constant bias.")
    bias_walk: float = param(0.0, unit="rad/s/sqrt(s)", low=0, doc="Random walk of the bias.")


@dataclass(frozen=True)
class AccelerationFieldParams(Parameters):
    """Parameters of the estimator, apart from the sensors themselves."""

    accelerometers__names: tuple[str, ...] = param(
        (), doc="Names of the accelerometers; each is described below accelerometers.<name>.")
    sample_rate: float = param(
        1000.0, unit="Hz", low=1e-3, doc="Rate of the readings; scales noise densities.")
    points: tuple[float, ...] = param(
        (), unit="m", doc="Query points x y z in body coordinates, one after another.")
    method: str = param("rigid_body", choices=("rigid_body", "ao", "sqrt_ao"),
                        doc="rigid_body, or ao and sqrt_ao of the literature.")
    mode: str = param("causal", choices=("causal", "smoothed"),
                      doc="causal, or smoothed over the whole recording (rigid_body only).")
    integration: str = param(
        "paper", choices=("paper", "high_order"),
        doc="Of ao and sqrt_ao: trapezoid and Lie-Stoermer-Verlet as published, or third and "
            "fourth order.")
    initial__mode: str = param(
        "rest", choices=("rest", "given"),
        doc="rest: biases, tilt and zero rate from the still start; given: as below.")
    initial__duration: float = param(
        0.5, unit="s", low=0, doc="Still time that initial.mode rest needs.")
    initial__still_sd: float = param(
        0.3, unit="m/s^2", low=0, doc="Largest deviation, beyond noise, of a still body.")
    initial__orientation: tuple[float, ...] = param(
        (0.0, 0.0, 0.0, 1.0), length=4, doc="World from body, x y z w (rest: its heading).")
    initial__orientation_sd: float = param(
        0.0, unit="rad", low=0, doc="Uncertainty of the given orientation, each axis.")
    initial__angular_velocity: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), unit="rad/s", length=3, doc="Given angular velocity, body axes.")
    initial__angular_velocity_sd: float = param(
        0.01, unit="rad/s", low=0, doc="Uncertainty of the initial angular velocity, each axis.")
    motion__jerk_density: float = param(
        5e4, unit="rad/s^3/sqrt(s)", low=1e-12,
        doc="rigid_body: how fast the rate of the angular acceleration wanders.")
    motion__rate: float = param(
        0.0, unit="1/s", low=0,
        doc="rigid_body: how fast the angular acceleration forgets itself; 0: not at all.")
    motion__acceleration_rate_density: float = param(
        3e3, unit="m/s^3/sqrt(s)", low=1e-12,
        doc="rigid_body: how fast the rate of the linear acceleration wanders.")
    noise_scale: float = param(
        1.0, low=1e-6, doc="rigid_body: factor on all noise densities, for errors of the model.")
    maximum_likelihood: str = param(
        "off", choices=("off", "motion", "motion_and_noise"),
        doc="Mode smoothed: fit the motion densities (and noise_scale) to the recording first.")
    smoother__iterations: int = param(
        4, low=1, high=100, doc="Most iterations of the smoother.")
    max_gap: float = param(
        0.1, unit="s", low=0,
        doc="Across longer intervals nothing is integrated: rate and attitude are held.")
    max_condition: float = param(
        1e3, low=1, doc="Layouts of a larger condition number are refused.")
    gravity: float = param(9.80665, unit="m/s^2", low=0, doc="Gravity at the place.")


def parse_configuration(values, source=""):
    """Parameters of the estimator and its sensors from a mapping, nested or dotted.

    Returns:
        (AccelerationFieldParams, dict of name to AccelerometerParams, GyroscopeParams or None).

    Raises:
        ParameterError, LayoutError: with the name of what is wrong.
    """
    flat = flatten(values)
    names = flat.get("accelerometers.names", ())
    groups = [f"accelerometers.{name}." for name in names]
    params = AccelerationFieldParams.from_mapping(flat, source, ignore=(*groups, "gyroscope."))
    sensors = {name: AccelerometerParams.from_mapping(
        {k[len(group):]: v for k, v in flat.items() if k.startswith(group)},
        source=(source + ": " if source else "") + group[:-1])
        for name, group in zip(names, groups)}
    if len(sensors) < len(names):
        raise LayoutError(f"accelerometers.names {list(names)} names one accelerometer twice")
    rates = {k[len("gyroscope."):]: v for k, v in flat.items() if k.startswith("gyroscope.")}
    return params, sensors, GyroscopeParams.from_mapping(rates, source) if rates else None


class AccelerationFieldEstimator:
    """Acceleration field, angular velocity and orientation of a rigid body.

    Args:
        params: AccelerationFieldParams.
        accelerometers: sequence, or mapping by name, of AccelerometerParams.
        gyroscope: GyroscopeParams of an additional gyroscope (rigid_body only), or None.

    Raises:
        LayoutError: a layout that the method cannot use.
        EstimationError: smoothing or a gyroscope asked of a method that has none.

    Samples are (N, 3) readings in the sensors' own axes, m/s^2, NaN where there is none. A
    saturated or missing channel is left out of its sample and flagged.
    """

    def __init__(self, params, accelerometers, gyroscope=None):
        sensors = accelerometers.values() if hasattr(accelerometers, "values") else accelerometers
        self.params = params
        self.layout = make_layout(tuple(sensors), gyroscope)
        if params.method != "rigid_body":
            self.layout = self.layout.for_affine_fit(params.max_condition)
        self.layout.require(params.method, params.max_condition)
        if params.method != "rigid_body" and (params.mode == "smoothed" or gyroscope is not None):
            raise EstimationError(f"method '{params.method}' neither smooths nor uses a gyroscope; "
                                  "use method 'rigid_body'")
        self._has_gyroscope = gyroscope is not None
        self.fitted = params
        self.reset()

    @property
    def condition_number(self):
        """Of the fit that the method needs: affine for ao, sqrt_ao, else of a and alpha."""
        return (self.layout.condition_rigid if self.params.method == "rigid_body"
                else self.layout.condition_affine)

    def reset(self):
        """Forget all samples and start anew; ``fitted``, what the last maximum likelihood gave,
        stays."""
        self._filter = None
        self._start = None
        self._rest = None
        self._last = None
        self._stamps = []
        self._readings = []

    def get_state(self):
        """Everything that a later :meth:`set_state` needs to go on from here."""
        return {"filter": None if self._filter is None else {
                    k: v.copy() for k, v in self._filter.state.items()},
                "start": self._start, "rest": self._rest, "last": self._last,
                "stamps": list(self._stamps), "readings": list(self._readings)}

    def set_state(self, state):
        """Go on from where :meth:`get_state` was called, in an estimator of equal parameters."""
        self._start, self._rest, self._last = state["start"], state["rest"], state["last"]
        self._stamps, self._readings = list(state["stamps"]), list(state["readings"])
        self._filter = None
        if state["filter"] is not None:
            self._filter = self._make_filter(self._start)
            self._filter.state = {k: v.copy() for k, v in state["filter"].items()}

    def add(self, stamp, readings, gyr=None):
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

    def take(self, stamp, readings, gyr=None):
        """:meth:`add` of n samples: stamp (n,), readings (n, N, 3), gyr (n, 3). Returns ROWs."""
        stamp = np.ascontiguousarray(stamp, dtype=np.int64)
        return self._take(*self._check(stamp, np.asarray(readings, dtype=float), gyr))

    def run(self, stamp, readings, gyr=None):
        """Take n samples and finish: stamp (n,), readings (n, N, 3), gyr (n, 3). Returns ROWs."""
        return np.concatenate([self.take(stamp, readings, gyr), self.finish()])

    def finish(self):
        """Rows of all samples in mode smoothed, else none. Forgets the samples it smoothed.

        Raises:
            EstimationError: initial.mode is rest and the body never was still.
        """
        if self._filter is None and self._stamps:
            raise EstimationError(
                f"initial.mode rest: the body was never still for {self.params.initial__duration} "
                "s; give initial.orientation and initial.angular_velocity with initial.mode "
                "given, or raise initial.still_sd")
        if self.params.mode != "smoothed" or not self._stamps:
            return np.empty(0, ROW)
        stamp, readings = np.concatenate(self._stamps), np.concatenate(self._readings)
        params, start = self.params, self._start
        if params.maximum_likelihood != "off":
            params = fit_densities(params, self.layout, self._make_start, stamp, readings)
            start = self._make_start(params)
            self.fitted = params
        values, flags = smooth(params, self.layout, start, stamp, readings)
        self.reset()
        return make_rows(stamp, values, flags)

    def _check(self, stamp, readings, gyr):
        expected = (len(stamp), self.layout.accelerometers, 3)
        if readings.shape != expected:
            raise SampleError(f"acceleration field: readings of shape {readings.shape}, expected "
                              f"{expected}: samples, accelerometers, axes")
        flat = readings.reshape(len(stamp), -1)
        if self._has_gyroscope:
            gyr = np.full((len(stamp), 3), np.nan) if gyr is None else np.asarray(gyr, dtype=float)
            flat = np.hstack([flat, gyr.reshape(len(stamp), 3)])
        before = np.r_[[] if self._last is None else [self._last], stamp].astype(np.int64)
        bad = np.flatnonzero(np.diff(before) <= 0)
        if len(bad):
            raise SampleError(f"acceleration field: stamp {before[bad[0] + 1]} ns is not later "
                              f"than {before[bad[0]]} ns before it; sort and merge the samples")
        return stamp, np.ascontiguousarray(flat[:, self.layout.column])

    def _take(self, stamp, readings):
        if len(stamp):
            self._last = int(stamp[-1])
        done = 0
        while self._filter is None and done < len(stamp):
            if self.params.initial__mode == "given":
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
        return make_rows(stamp, *self._filter.process(stamp, readings))

    def _wait_for_rest(self, stamp, readings):
        self._stamps.append(stamp)
        self._readings.append(readings)
        duration = int(round(self.params.initial__duration * 1e9))
        if self._stamps[-1][0] - self._stamps[0][0] < duration:
            return
        if is_still(self.params, self.layout, np.concatenate(self._readings)):
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
            return given_start(params, self.layout)
        return rest_start(params, self.layout, self._rest)

    def _make_filter(self, start):
        kind = RigidBodyFilter if self.params.method == "rigid_body" else AffineFilter
        return kind(self.params, self.layout, start)
