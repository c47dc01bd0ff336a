"""The orientation estimator between its topics, live and in batch."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imu_fusion.errors import EstimationError, ParameterError
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.estimation.orientation.rows import FLAG_STILL
from imu_fusion.geometry.magnetic_field import decimal_year, declination
from imu_fusion.geometry.rotation import quat_exp, quat_multiply, quat_rotate, quat_rotate_inverse
from imu_fusion.messages.convert import (
    GYROSCOPE_FIRST,
    SAMPLE_TYPES,
    bool_message,
    orientation_message,
    rpy_message,
)
from imu_fusion.messages.layouts import BOOL_TYPE, FIX, IMU, MAG, TWIST, VECTOR3
from imu_fusion.messages.orientation_status import (
    FLAGS_TYPE,
    bias_message,
    flags_message,
    lasting_flags,
)
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.samples import MagLog, checks
from imu_fusion.sensors.magnetometer_calibration import MagCalibration, MagCalibrator
from imu_fusion.streams.stage import Stage
from imu_fusion.streams.stream import EstimatorNodeParams, Stream

FIX_TOPIC = "fix"
MAG_TOPIC = "imu/mag"
IMU_TOPIC = "imu/data_raw"
ORIENTATION_TOPIC = "imu/data"
RPY_TOPIC = "imu/rpy/filtered"
STEADY_TOPIC = "imu/steady_state"
FLAGS_TOPIC = "imu/flags"
BIAS_TOPIC = "imu/gyro_bias"
SMOOTHED_TOPIC = "imu/data_smoothed"

# At equal stamps in this order: an Imu sample uses the field of its own stamp.
INPUTS = {FIX_TOPIC: SAMPLE_TYPES[FIX.msgtype], MAG_TOPIC: SAMPLE_TYPES[MAG.msgtype],
          IMU_TOPIC: GYROSCOPE_FIRST}
OUTPUTS = {ORIENTATION_TOPIC: IMU.msgtype, RPY_TOPIC: VECTOR3.msgtype, STEADY_TOPIC: BOOL_TYPE,
           FLAGS_TOPIC: FLAGS_TYPE, BIAS_TOPIC: TWIST.msgtype, SMOOTHED_TOPIC: IMU.msgtype}

_UP = {"enu": 1.0, "nwu": 1.0, "ned": -1.0}  # z of the world frame's up
_BIAS_INTERVAL = 100_000_000  # ns; a bias does not change faster
_CALIBRATION_INTERVAL = 50_000_000  # ns; turning sensors show a new direction about as often


@dataclass(frozen=True)
class OrientationOutputParams(Parameters):
    """What is done with an orientation before it is published."""

    remove_gravity_vector: bool = param(
        False, doc="Publish imu/data with gravity taken out of the linear acceleration.")
    gravity: float = param(9.80665, unit="m/s^2", low=9.7, high=9.9,
                           doc="Gravity that remove_gravity_vector takes out.")
    heading_deg: float = param(0.0, unit="deg", low=-360.0, high=360.0, read_only=False,
                               doc="Yaw that the service set_heading makes the present one.")
    publish_tf: bool = param(
        False, doc="Also broadcast the orientation as the transform from fixed_frame to the Imu's "
                   "frame (node only; needs tf2_ros).")
    fixed_frame: str = param("odom", doc="Parent frame of that transform.")


def _without_lost(acc, had_force):
    """Specific force (n, 3), NaN where it is absent (zero) though it was there before.

    An Imu without accelerometer is used as a gyroscope; one that loses its force for a
    while is not in free fall: that sample is refused.
    """
    present = acc.any(axis=1)
    lost = ~present & (np.logical_or.accumulate(present) | had_force)
    return np.where(lost[:, None], np.nan, acc)


class _Writer:
    """Messages of the estimator's rows; turns them about the vertical by ``turn`` (rad).

    ``turn`` is positive counter-clockwise seen from above, whatever the world frame.
    """

    def __init__(self, params, output):
        self._up = _UP[params.world_frame]
        self._output = output
        self._flags = None
        self._next_bias = None
        self.turn = 0.0
        self.yaw: float | None = None

    def messages(self, rows: np.ndarray, frame_id: str) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, stamp, cdr)."""
        for row in rows:
            stamp = int(row["stamp"])
            row, message = self._orientation(row, frame_id)
            yield ORIENTATION_TOPIC, stamp, message
            yield RPY_TOPIC, stamp, rpy_message(row, frame_id)
            flags = lasting_flags(int(row["flags"]), self._flags or 0)
            if self._flags is None or (flags ^ self._flags) & FLAG_STILL:
                yield STEADY_TOPIC, stamp, bool_message(bool(flags & FLAG_STILL))
            if flags != self._flags:
                self._flags = flags
                yield FLAGS_TOPIC, stamp, flags_message(stamp, frame_id, flags)
            if self._next_bias is None or stamp >= self._next_bias:
                self._next_bias = stamp + _BIAS_INTERVAL
                yield BIAS_TOPIC, stamp, bias_message(row, frame_id)
        if len(rows):
            east = quat_rotate(row["quat_world_imu"], (1.0, 0.0, 0.0))
            self.yaw = math.atan2(self._up * east[1], east[0])

    def corrected(self, rows: np.ndarray, frame_id: str) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, stamp, cdr) of rows that looking ahead has corrected."""
        for row in rows:
            yield SMOOTHED_TOPIC, int(row["stamp"]), self._orientation(row, frame_id)[1]

    def restart(self) -> None:
        """What comes next is another stretch, perhaps at earlier stamps."""
        self.turn = 0.0
        self._next_bias = None

    def set_yaw(self, yaw: float) -> None:
        """Turn so that the last row's yaw (rad, counter-clockwise from above) is ``yaw``.

        Raises:
            EstimationError: there is no orientation yet.
        """
        if self.yaw is None:
            raise EstimationError("no orientation yet: nothing to set the heading of")
        self.turn += yaw - self.yaw

    def _orientation(self, row, frame_id):
        """A row as it is published, and its message."""
        has_force = bool(row["acc"].any())   # zero: a gyroscope without an accelerometer
        if self.turn or self._output.remove_gravity_vector:
            row = self._changed(row, has_force)
        return row, orientation_message(row, frame_id, has_force)

    def _changed(self, row, has_force):
        row = row.copy()
        turn = quat_exp((0.0, 0.0, self._up * self.turn))
        row["quat_world_imu"] = quat_multiply(turn, row["quat_world_imu"])
        if self._output.remove_gravity_vector and has_force:
            up = (0.0, 0.0, self._up * self._output.gravity)
            row["acc"] -= quat_rotate_inverse(row["quat_world_imu"], up)
        return row


def turn_to_true_north(params: OrientationParams, stamp: int,
                       sample: np.ndarray) -> float | None:
    """Turn (rad) from magnetic to true north at a fix, or None if there is nothing to do.

    Args:
        params: OrientationParams; a declination that is set wins.
        stamp: int nanoseconds, Unix time.
        sample: (13,) of convert.fix_values.

    Raises:
        ParameterError: the field model does not cover the stamp.
    """
    latitude, longitude, height, status = sample[[0, 1, 2, 12]]
    if params.declination_deg is not None or status < 0:
        return None
    # Magnetic north lies D east of true north: what was called north points to azimuth D.
    return -declination(latitude, longitude, height, decimal_year(stamp))


def warm_up(params: OrientationParams) -> None:
    """Compile, or load from the cache, what the first samples would otherwise wait for."""
    estimator = OrientationEstimator(params.replace(**{"alignment.duration": 0.05}))
    for i in range(20):
        stamp = i * 10_000_000
        estimator.add_mag(stamp, np.array([0.0, 2e-5, -4e-5]))
        estimator.add_imu(stamp, np.zeros(3), np.array([0.0, 0.0, 9.81]))
    estimator.finish()    # with a lag: the smoother


class OrientationStream(Stream):
    """See :class:`imu_fusion.streams.stream.Stream`.

    Args:
        params: OrientationParams.
        output: OrientationOutputParams.
    """

    same_frame = (IMU_TOPIC, MAG_TOPIC)

    def __init__(self, params: OrientationParams = OrientationParams(),
                 output: OrientationOutputParams = OrientationOutputParams(),
                 emit: Callable[[str, int, bytes], object] = lambda *message: None,
                 warn: Callable[[str], object] = lambda text: None) -> None:
        self.params, self.output = params, output
        self.estimator = OrientationEstimator(params)
        self._calibrator = MagCalibrator()
        self._next_calibration: int | None = None
        super().__init__(INPUTS, emit, warn)

    def reset(self, session_topics: Sequence[str] | None = None) -> None:
        self._writer = _Writer(self.params, self.output)
        super().reset(session_topics)

    def restart(self) -> None:
        self.estimator.reset()
        self._writer.restart()
        self._knows_north = False
        self._has_force = False

    def take(self, topic: str, stamp: int, sample: np.ndarray) -> None:
        if topic == IMU_TOPIC:
            force = _without_lost(sample[None, 3:], self._has_force)[0]
            self._has_force |= bool(force.any())
            self._write(self.estimator.add_imu(stamp, sample[:3], force))
        elif topic == MAG_TOPIC:
            saturated = self.estimator.mag_saturated
            self._write(self.estimator.add_mag(stamp, sample))
            if (self.estimator.mag_saturated == saturated
                    and (self._next_calibration is None or stamp >= self._next_calibration)):
                self._calibrator.add(sample)
                self._next_calibration = stamp + _CALIBRATION_INTERVAL
        elif not self._knows_north:
            self._find_north(stamp, sample)

    def flush(self) -> None:
        self._write(self.estimator.finish())

    def change(self, params: OrientationParams) -> None:
        """Go on with other values of parameters that may change at run time."""
        self.params = params
        self.estimator.set_params(params)

    def set_heading(self, yaw: float) -> None:
        """Call the present yaw ``yaw`` (rad, counter-clockwise from above).

        Raises:
            EstimationError: there is no orientation yet.
        """
        self._writer.set_yaw(yaw)
        self._knows_north = True

    def calibrate_magnetometer(self) -> MagCalibration:
        """Calibrate from the samples since the start and start anew with the result.

        Returns:
            MagCalibration.

        Raises:
            CalibrationError: the samples do not determine it.
        """
        calibration = self._calibrator.result()
        changes = calibration.to_parameters()
        if self.params.is_as_printed:
            del changes["fusion.mag_offset_sd"]    # the printed method knows no such thing
        self.params = self.params.replace(**changes)
        self.estimator = OrientationEstimator(self.params)
        self.restart()
        return calibration

    def look_at(self, topic: str, logs: Mapping[str, Any]) -> list[str]:
        if topic == IMU_TOPIC:
            found = checks.check_acceleration(logs[topic].acc, logs[topic].stamp, topic)
        elif topic == MAG_TOPIC:
            found = checks.check_field(logs[topic].mag, topic)
        else:
            found = checks.check_fix(logs[topic], topic)
        if topic in self.same_frame and all(name in logs for name in self.same_frame):
            found += checks.check_axes(logs[IMU_TOPIC], logs[MAG_TOPIC], MAG_TOPIC)
        return [finding.text for finding in found]

    def _find_north(self, stamp, sample):
        try:
            turn = turn_to_true_north(self.params, stamp, sample)
        except ParameterError as error:
            self.warn(f"north stays magnetic north: {error}; or set declination_deg")
            turn = 0.0
        if turn is not None:
            self._writer.turn += turn
            self._knows_north = True

    def _write(self, rows):
        if len(rows):
            for message in self._writer.messages(rows, self.frame_ids[IMU_TOPIC]):
                self.emit(*message)
        rows = self.estimator.take_corrected()
        if len(rows):
            for message in self._writer.corrected(rows, self.frame_ids[IMU_TOPIC]):
                self.emit(*message)


def findings(logs: Mapping[str, Any]) -> list[str]:
    """What looks wrong with whole logs: texts.

    Args:
        logs: dict of input topic to log, as recorded.
    """
    found = checks.check_imu(logs[IMU_TOPIC], IMU_TOPIC)
    if MAG_TOPIC in logs:
        found += checks.check_mag(logs[MAG_TOPIC], MAG_TOPIC)
        found += checks.check_axes(logs[IMU_TOPIC], logs[MAG_TOPIC], MAG_TOPIC)
    return [finding.text for finding in found]


def process_logs(logs: Mapping[str, Any], report: Any, params: OrientationParams,
                 output: OrientationOutputParams) -> Iterator[tuple[str, int, bytes]]:
    """The messages that :class:`OrientationStream` emits for a session, from whole logs.

    Args:
        logs: dict of input topic to (log, epochs) of guarded samples.
        report: gets the estimator's ``results``.
        params: OrientationParams.
        output: OrientationOutputParams.

    Yields:
        (topic, stamp, cdr)
    """
    estimator = OrientationEstimator(params)
    writer = _Writer(params, output)
    imu, imu_epochs = logs[IMU_TOPIC]
    nothing = np.empty(0, np.int64)
    mag, mag_epochs = logs.get(MAG_TOPIC, (MagLog(nothing, np.empty((0, 3))), nothing))
    fix, fix_epochs = logs.get(FIX_TOPIC, (None, nothing))
    for epoch in np.union1d(imu_epochs, mag_epochs):
        estimator.reset()
        writer.restart()
        imu_part, mag_part = imu[imu_epochs == epoch], mag[mag_epochs == epoch]
        imu_part = replace(imu_part, acc=_without_lost(imu_part.acc, False))
        stamp, turn = _first_north(params, fix, fix_epochs == epoch)
        if turn and params.mode == "smoothed":
            writer.turn = turn  # looking ahead, north is known from the start
        elif turn:
            # What is published from the first fix on refers to true north.
            before = [part[part.stamp < stamp] for part in (imu_part, mag_part)]
            yield from writer.messages(estimator.run(*before), imu.frame_id)
            yield from writer.corrected(estimator.take_corrected(), imu.frame_id)
            writer.turn = turn
            imu_part, mag_part = (part[part.stamp >= stamp] for part in (imu_part, mag_part))
        rows = [estimator.run(imu_part, mag_part), estimator.finish()]
        yield from writer.messages(np.concatenate(rows), imu.frame_id)
        yield from writer.corrected(estimator.take_corrected(), imu.frame_id)
    report.results = estimator.summary()


def _first_north(params, fix, mask):
    """(stamp, turn) of the first fix that tells true north; (None, 0.0) if none does."""
    if fix is None or not mask.any():
        return None, 0.0
    chosen = fix[mask]
    for stamp, sample in zip(chosen.stamp.tolist(), np.column_stack(
            [chosen.latitude_deg, chosen.longitude_deg, chosen.height,
             chosen.cov_enu.reshape(-1, 9), chosen.status])):
        try:
            turn = turn_to_true_north(params, stamp, sample)
        except ParameterError:
            return None, 0.0
        if turn is not None:
            return stamp, turn
    return None, 0.0


STAGE = Stage("orientation_estimator", (OrientationParams, OrientationOutputParams),
              (EstimatorNodeParams,), INPUTS, (IMU_TOPIC,), OUTPUTS, process_logs, findings)
