"""The smoother between its topics: a collection of samples in, a trajectory out.

The node collects while a bag plays or a robot runs; batch reads whole logs. Both
end in :func:`smooth`, and so in the same messages.
"""

import math
from collections.abc import Callable, Container, Mapping
from dataclasses import replace
from typing import Any

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.estimation.orientation.recovered import recover
from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.estimation.smoother.imu_input import from_start
from imu_fusion.estimation.smoother.result import SmootherResult
from imu_fusion.messages.convert import SAMPLE_TYPES
from imu_fusion.messages.layouts import FIX, IMU, MAG, TWIST
from imu_fusion.samples.blocks import Samples, joined
from imu_fusion.streams.smoother_messages import OUTPUTS, Outcome, messages, outputs_of
from imu_fusion.streams.smoother_params import SmootherNodeParams, SmoothingParams
from imu_fusion.streams.stage import Stage, check_logs
from imu_fusion.streams.stream import (
    FIX_TOPIC,
    IMU_TOPIC,
    MAG_TOPIC,
    VELOCITY_TOPIC,
    Conclusion,
    EstimatorNodeParams,
    Messages,
    Stream,
)
from imu_fusion.surfaces.file import load_surface

INPUTS = {topic: SAMPLE_TYPES[layout.msgtype] for topic, layout in (
    (IMU_TOPIC, IMU), (MAG_TOPIC, MAG), (FIX_TOPIC, FIX), (VELOCITY_TOPIC, TWIST))}
_REQUIRED = (IMU_TOPIC, FIX_TOPIC)


def required_of(params: SmootherParams) -> tuple[str, ...]:
    """Topics that a trajectory is made of: without fixes, where the start is given."""
    return _REQUIRED if params.initial.position is None else (IMU_TOPIC,)


def lacking(params: SmootherParams, topics: Container[str | None]) -> list[str]:
    """What keeps the smoother from smoothing these topics: fixes are enough."""
    return [] if FIX_TOPIC in topics else [
        topic for topic in required_of(params) if topic not in topics]


def frame_of(logs: Mapping[str, Any]) -> str:
    """frame_id of what moves: the Imu, or else the receiver."""
    log = logs[IMU_TOPIC] if IMU_TOPIC in logs else logs[FIX_TOPIC]
    return str(log.frame_id)


class SmootherStream(Stream):
    """Collects samples, in compact arrays, until somebody calls :func:`smooth` on ``logs()``.

    One Imu sample takes 56 bytes, one of the magnetometer 32, one fix 112, one velocity
    104: 32 MB an hour for Imu and magnetometer at 100 Hz. When the clock is set back, what was
    collected before is dropped when live; in a replay and in batch the longest stretch is what is
    smoothed, and how much that leaves out is said.

    Args:
        params: SmoothingParams.
        limit: bytes; what comes beyond is counted and dropped.
        warn: called with a text when something is wrong.
    """

    one_clock = (IMU_TOPIC, MAG_TOPIC)

    def __init__(self, params: SmoothingParams = SmoothingParams(), limit: float = math.inf,
                 warn: Callable[[str], object] = lambda text: None) -> None:
        self.params = params
        self.limit = limit
        super().__init__(INPUTS, warn, params.calibration)

    def reset(self, session_topics: Container[str] | None = None) -> None:
        self._collected: dict[str, list[Samples]] = {topic: [] for topic in INPUTS}
        self._longest = self._collected    # of the stretches before
        self._samples = 0                  # of the Imu in them
        super().reset(session_topics)

    def restart(self) -> None:
        if self._merger.strict:
            self._samples += self._length(self._collected)[1]
            self._longest = max(self._longest, self._collected, key=self._length)
        self.dropped = 0
        self.bytes = 0
        self._collected = {topic: [] for topic in INPUTS}

    def use(self, samples: Mapping[str, Samples]) -> list[Messages]:
        for topic, (stamp, values) in samples.items():
            size = 8 * (1 + INPUTS[topic].width)
            room = len(stamp) if math.isinf(self.limit) else min(
                len(stamp), int((self.limit - self.bytes) // size))
            if room < len(stamp):
                if not self.dropped:
                    self.warn(f"the collection has reached its limit of {self.limit / 1e6:g} MB: "
                              "further samples are dropped; see memory_limit and smoother/clear")
                self.dropped += len(stamp) - room
            self.bytes += size * room
            if room:
                self._collected[topic].append((stamp[:room].copy(), values[:room].copy()))
        return []

    def flush(self) -> list[Messages]:
        return []

    def counts(self) -> dict[str, int]:
        """dict of topic to number of samples held."""
        return {topic: sum(len(stamp) for stamp, _ in parts)
                for topic, parts in self._collected.items()}

    def logs(self) -> dict[str, Any]:
        """A snapshot: dict of topic to log, topics without samples left out.

        Raises:
            EstimationError: the limit was reached, so that the data have a hole at the end, or a
                topic that is needed has no samples.
        """
        if self.dropped:
            raise EstimationError(f"{self.dropped} samples were dropped at the limit of "
                                  f"{self.limit / 1e6:g} MB: call smoother/clear, record less or "
                                  "raise memory_limit")
        chosen = max(self._longest, self._collected, key=self._length)
        if self._samples:
            total = self._samples + self._length(self._collected)[1]
            self.warn(f"the clock was set: only the longest stretch, {self._length(chosen)[1]} of "
                      f"{total} Imu samples, is smoothed")
        for parts in chosen.values():
            if len(parts) > 1:    # not again at the next call
                parts[:] = [joined(parts)]
        missing = lacking(self.params, [topic for topic in INPUTS if chosen[topic]])
        if missing:
            raise EstimationError(
                f"nothing to smooth: no samples on {' and '.join(missing)}"
                + (" since the clock was set back" if self.restarts else ""))
        return {topic: INPUTS[topic].log(*parts[0], self.frame_ids[topic])
                for topic, parts in chosen.items() if parts}

    def _length(self, stretch):
        """Whether a collection has what is needed, and its number of Imu samples."""
        return (not lacking(self.params, [topic for topic in INPUTS if stretch[topic]]),
                sum(len(stamp) for stamp, _ in stretch[IMU_TOPIC]))

    def conclude(self) -> Conclusion:
        """What the samples of a whole recording make: the smoothed trajectory; its detail is
        (SmootherResult, logs by topic)."""
        logs = self.logs()
        result = smooth(self.params, logs)
        outcome = Outcome.of(result, frame_of(logs), self.params.gnss.lever_arm)
        return Conclusion(messages(result.samples, outcome, self.params),
                          outcome.numbers, outcome.summary, outcome.remarks, (result, logs))


def smooth(params: SmoothingParams, logs: Mapping[str, Any]) -> SmootherResult:
    """Smooth collected samples.

    Args:
        params: SmoothingParams.
        logs: dict of topic to log, as SmootherStream.logs gives it.

    Returns:
        SmootherResult

    Raises:
        ImuFusionError: with the reason, if there is no meaningful result.
    """
    surface = load_surface(params.surface.file) if params.surface.file else None
    params = params.with_calibrated_magnetometer()
    imu, mag = logs.get(IMU_TOPIC), logs.get(MAG_TOPIC)
    fix, velocity = logs.get(FIX_TOPIC), logs.get(VELOCITY_TOPIC)
    if imu is None or not params.recover_rates:
        return Smoother(params, surface).run(imu, mag, fix, velocity)
    begun = from_start(imu, params)
    known = params.replace(**{"sensor.gyro_range": None, "initial.start": None})
    found = recover(begun, mag, recovery_params(params))
    result = Smoother(known, surface).run(found.imu, found.mag, fix, velocity)
    late = dict(result.late)
    if found.mag_lag:    # the smoother may have found more of it
        late["mag"] = late.get("mag", 0.0) + found.mag_lag
    return replace(result, left_out=len(imu) - len(begun), late=late,
                   lost_turns=tuple(sorted({*result.lost_turns, *found.lost})),
                   start_found=params.initial.start is None)


def recovery_params(params: SmootherParams) -> OrientationParams:
    """Parameters of the orientation estimator that recovers rates for the smoother: its sensor, and
    a body in free fall and under blows, whose force says nothing of gravity and whose spin has
    inertia."""
    shared = ("gyro_noise_density", "gyro_bias_sd", "gyro_scale_sd", "gyro_range", "mag_offset",
              "mag_matrix")
    return OrientationParams().replace(**{
        "fusion.use_acc": False, "fusion.angular_acc_sd": 100.0, "fusion.angular_acc_time": 0.1,
        **{f"sensor.{name}": getattr(params.sensor, name) for name in shared}})


def _configure(stage, params_file):
    (params,) = stage.read_params(params_file)
    if params.surface.file:
        load_surface(params.surface.file)  # a bad file is refused before anything is read
    return replace(stage, required=required_of(params), outputs=outputs_of(params)), [params]


STAGE = Stage("smoother", (SmoothingParams,), (EstimatorNodeParams, SmootherNodeParams), INPUTS,
              _REQUIRED, OUTPUTS, SmootherStream, check_logs, _configure,
              dispensable=(IMU_TOPIC,))
