"""The orientation estimator between its topics, live and in batch."""

from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from imu_fusion.errors import ParameterError
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.estimation.orientation.lost_turn import LOST, is_blind, unseen_turn
from imu_fusion.estimation.orientation.mag_screen import MagScreen
from imu_fusion.estimation.orientation.rows import ORIENTATION_DTYPE
from imu_fusion.estimation.orientation.summary import UNITS
from imu_fusion.geometry.magnetic_field import decimal_year, declination
from imu_fusion.messages.convert import GYROSCOPE_FIRST, SAMPLE_TYPES
from imu_fusion.messages.layouts import FIX, MAG
from imu_fusion.samples import ImuLog, MagLog, checks
from imu_fusion.samples.blocks import Samples, joined
from imu_fusion.samples.field_turning import check_axes
from imu_fusion.samples.findings import Finding
from imu_fusion.samples.turning import check_turning
from imu_fusion.sensors.magnetometer_calibration import MagCalibration, MagCalibrator
from imu_fusion.streams.orientation_messages import (
    OUTPUTS,
    OrientationOutputParams,
    OrientationWriter,
    Pace,
    outputs_of,
)
from imu_fusion.streams.stage import Stage, check_logs
from imu_fusion.streams.stream import (
    FIX_TOPIC,
    IMU_TOPIC,
    MAG_TOPIC,
    Conclusion,
    EstimatorNodeParams,
    Messages,
    Stream,
)

# At equal stamps in this order: an Imu sample uses the field of its own stamp.
INPUTS = {FIX_TOPIC: SAMPLE_TYPES[FIX.msgtype], MAG_TOPIC: SAMPLE_TYPES[MAG.msgtype],
          IMU_TOPIC: GYROSCOPE_FIRST}
_NO_FIX = np.empty(0, np.int64), np.empty((0, 13))
_NO_MAG = np.empty(0, np.int64), np.empty((0, 3))
_NO_IMU = np.empty(0, np.int64), np.empty((0, 6))
_FEW = 24    # samples that are handed over faster one by one
_CALIBRATION_INTERVAL = 50_000_000  # ns; turning sensors show a new direction about as often


def _without_lost(acc, had_force):
    """Specific force (n, 3), NaN where it is absent (zero) though it was there before.

    An Imu without accelerometer is used as a gyroscope; one that loses its force for a
    while is not in free fall: that sample is refused.
    """
    present = acc.any(axis=1)
    if present.all():
        return acc
    lost = ~present & (np.logical_or.accumulate(present) | had_force)
    return np.where(lost[:, None], np.nan, acc)


def turn_to_true_north(params: OrientationParams, stamp: int, sample: np.ndarray) -> float | None:
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


def _calibrated(params, output):
    """Parameters with a magnetometer's calibration where the estimator reads it."""
    return params.replace(**output.calibration.of_magnetometer(params.sensor))


def _take(estimator, stamp, gyr, acc, mag_stamp, mag):
    """Samples through the estimator; returns its rows."""
    if len(stamp) + len(mag_stamp) > _FEW:
        return estimator.run(ImuLog(stamp, gyr, acc), MagLog(mag_stamp, mag))
    rows, j = [], 0
    for i in range(len(stamp)):
        while j < len(mag_stamp) and mag_stamp[j] <= stamp[i]:
            rows.append(estimator.add_mag(int(mag_stamp[j]), mag[j]))
            j += 1
        rows.append(estimator.add_imu(int(stamp[i]), gyr[i], acc[i]))
    rows += [estimator.add_mag(int(mag_stamp[k]), mag[k]) for k in range(j, len(mag_stamp))]
    rows = [part for part in rows if len(part)]
    return rows[0] if len(rows) == 1 else np.concatenate([np.empty(0, ORIENTATION_DTYPE), *rows])


class OrientationStream(Stream):
    """See :class:`imu_fusion.streams.stream.Stream`.

    In mode ``smoothed`` nothing comes before the end of a session: then all of it does.

    Args:
        params: OrientationParams.
        output: OrientationOutputParams.
    """

    same_frame = one_clock = (IMU_TOPIC, MAG_TOPIC)
    answered = (IMU_TOPIC,)

    def __init__(self, params: OrientationParams = OrientationParams(),
                 output: OrientationOutputParams = OrientationOutputParams(),
                 warn: Callable[[str], object] = lambda text: None) -> None:
        params = _calibrated(params, output)
        self.params, self.output = params, output
        self.estimator = OrientationEstimator(params)
        self._calibrator, self._screen = MagCalibrator(), MagScreen(params)
        self._calibration_pace = Pace(_CALIBRATION_INTERVAL)
        super().__init__(INPUTS, warn, output.calibration)

    def reset(self, session_topics: Container[str] | None = None) -> None:
        self._writer = OrientationWriter(self.params, self.output)
        super().reset(session_topics)

    def restart(self) -> None:
        self.estimator.reset()
        self._writer.restart()
        self._knows_north = False
        self._has_force = False
        self._last_imu: int | None = None
        self._said_lost = False
        self._kept: list[tuple[Samples, Samples]] = []

    def use(self, samples: Mapping[str, Samples]) -> Iterator[Messages]:
        imu = samples.get(IMU_TOPIC, _NO_IMU)
        mag = samples.get(MAG_TOPIC, _NO_MAG)
        self._look_for_gaps(imu[0])
        # What is published from the first fix on refers to true north.
        stamp, turn = self._first_north(*samples.get(FIX_TOPIC, _NO_FIX))
        if self.params.mode == "smoothed":
            self._kept.append((imu, mag))
            self._writer.turn += turn
            return
        if stamp is not None:
            before = [np.searchsorted(stamps, stamp) for stamps, _ in (imu, mag)]
            yield from self._run(*((s[:k], v[:k]) for (s, v), k in zip((imu, mag), before)))
            imu, mag = ((s[k:], v[k:]) for (s, v), k in zip((imu, mag), before))
            self._writer.turn += turn
        yield from self._run(imu, mag)

    def _look_for_gaps(self, stamps):
        """Say once that the body may have turned by more than linear errors describe in a gap."""
        if not len(stamps) or self._said_lost:
            return
        first = int(stamps[0])
        longest = first - (first if self._last_imu is None else self._last_imu)
        if len(stamps) > 1:
            longest = max(longest, int((stamps[1:] - stamps[:-1]).max()))
        self._last_imu = int(stamps[-1])
        seconds = longest * 1e-9
        if seconds > self.params.gap.restart and is_blind(self.params, at_rest=False):
            self._said_lost = True
            self.warn(f"{IMU_TOPIC}: nothing for {seconds:.2f} s, after which all starts anew "
                      "(gap.restart): unless the body lies still then, nothing is known of its "
                      "orientation from there on. The smoother knows more, where there are fixes "
                      "or a surface")
        turn = unseen_turn(self.params, seconds)
        if turn > LOST and not self.params.fusion.use_acc:
            self._said_lost = True
            self.warn(f"{IMU_TOPIC}: nothing for {seconds:.2f} s, in which the body may have "
                      f"turned by {turn:.1f} rad (gap.rate_sd): from there on only the direction "
                      "of the field is known of its orientation, and nothing of the turn about "
                      "it. The smoother knows more, where there are fixes or a surface")

    def flush(self) -> list[Messages]:
        made: list[Messages] = []
        if self._kept:
            imu, mag = (joined(parts) for parts in zip(*self._kept))
            self._kept = []
            found = list(self._run(imu, mag))
            first = found[0].stamp[0] if found and len(found[0].stamp) else np.inf
            early = int(np.sum(np.isfinite(imu[1]).all(axis=1) & (imu[0] < first)))
            if early and found:
                self.warn(f"{early} Imu samples before the rest from which the orientation starts "
                          "are left out (alignment.start)")
            made += found
        return made + list(self._write(self.estimator.finish()))

    def conclude(self) -> Conclusion:
        return Conclusion(results={"units": UNITS} | self.estimator.summary(),
                          remarks=self.remarks())

    def remarks(self) -> list[str]:
        return self.estimator.remarks()

    def change(self, params: OrientationParams) -> None:
        """Go on with other values of parameters that may change at run time."""
        self.params = _calibrated(params, self.output)
        self.estimator.set_params(self.params)

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
        # The first samples at a limit came before it was known.
        calibration = self._calibrator.result(self._screen.limit)
        changes = calibration.to_parameters()
        if self.params.is_as_printed:
            del changes["fusion.mag_offset_sd"]    # the printed method knows no such thing
        self.params = self.params.replace(**changes)
        self.estimator = OrientationEstimator(self.params)
        self.restart()
        return calibration

    def look_at(self, topic: str, logs: Mapping[str, Any]) -> list[str]:
        if topic == IMU_TOPIC:
            imu = logs[topic]
            found = [*checks.check_parts(imu.gyr, imu.acc, topic),
                     *checks.check_acceleration(imu.acc, imu.stamp, topic),
                     *checks.check_gravity_sign(imu.acc, imu.stamp, topic),
                     *check_turning(imu, topic)]
        elif topic == MAG_TOPIC:
            found = checks.check_field(logs[topic].mag, topic)
        else:
            found = checks.check_fix(logs[topic], topic)
        if topic in self.same_frame and all(name in logs for name in self.same_frame):
            found += check_axes(logs[IMU_TOPIC], logs[MAG_TOPIC], MAG_TOPIC)
        return [finding.text for finding in found]

    def _first_north(self, stamps, values):
        """(stamp, turn) of the first fix that tells true north; (None, 0.0) if none does, or if it
        is known."""
        for stamp, sample in zip(stamps.tolist(), values):
            if self._knows_north:
                break
            try:
                turn = turn_to_true_north(self.params, stamp, sample)
            except ParameterError as error:
                self.warn(f"north stays magnetic north: {error}; or set declination_deg")
                turn = 0.0
            if turn is not None:
                self._knows_north = True
                return stamp, turn
        return None, 0.0

    def _run(self, imu, mag):
        """Samples through the estimator: (stamps, values) of both."""
        stamp, values = imu
        force = _without_lost(values[:, 3:], self._has_force)
        self._has_force |= bool(force.any())
        yield from self._write(_take(self.estimator, stamp, values[:, :3], force, *mag))
        self._collect(*mag)

    def _collect(self, stamps, values):
        """Samples for a calibration of the magnetometer, as often as they may be new."""
        usable = ~self._screen.saturated(values)
        stamps, values = stamps[usable], values[usable]
        for k in self._calibration_pace.chosen(stamps):
            self._calibrator.add(values[k])

    def _write(self, rows):
        frame_id = self.frame_ids.get(IMU_TOPIC, "")
        yield from self._writer.messages(rows, frame_id)
        yield from self._writer.corrected(self.estimator.take_corrected(), frame_id)


def warm_up(params: OrientationParams) -> None:
    """Compile, or load from the cache, what the first samples would otherwise wait for."""
    stream = OrientationStream(params.replace(**{"alignment.duration": 0.05}))
    for i in range(20):
        stamp = np.array([i * 10_000_000])
        list(stream.use({MAG_TOPIC: (stamp, np.array([[0.0, 2e-5, -4e-5]])),
                    IMU_TOPIC: (stamp, np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 9.81]]))}))
    stream.flush()    # with a lag: the smoother


def findings(logs: Mapping[str, Any]) -> list[Finding]:
    """What looks wrong with whole logs as recorded, but for the fixes: one is enough."""
    return check_logs({topic: log for topic, log in logs.items() if topic != FIX_TOPIC})


def _configure(stage, params_file):
    params, output = stage.read_params(params_file)
    return replace(stage, outputs=outputs_of(output)), [params, output]


STAGE = Stage("orientation_estimator", (OrientationParams, OrientationOutputParams),
              (EstimatorNodeParams,), INPUTS, (IMU_TOPIC,), OUTPUTS, OrientationStream, findings,
              _configure)
