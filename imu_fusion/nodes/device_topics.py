"""What the driver publishes: one topic each, with covariances and a regard for its rate."""

import time
from dataclasses import dataclass

import numpy as np
from rclpy.qos import QoSProfile

from imu_fusion.messages.layouts import FIX, IMU, MAG, NANOSECONDS, POSE, TWIST
from imu_fusion.messages.samples import NoiseSd, sample_messages
from imu_fusion.nodes.base import Node, message_class
from imu_fusion.parameters.declare import Parameters
from imu_fusion.samples.logs import Log
from imu_fusion.sensors.params import sensor
from imu_fusion.sources.source import (
    ARRAY_TOPIC,
    FIX_TOPIC,
    IMU_TOPIC,
    MAG_TOPIC,
    VELOCITY_TOPIC,
)

# Others are poses.
_TYPES = {IMU_TOPIC: IMU, MAG_TOPIC: MAG, FIX_TOPIC: FIX, VELOCITY_TOPIC: TWIST}
_RATED = 20          # samples that tell the rate
_GAP = 1.8           # usual intervals: a longer one has lost a sample


@dataclass(frozen=True)
class DriverSensor(Parameters):
    """``sensor.*``: noise of what tells no accuracy itself. Defaults are those of phones."""

    gyro_noise_density: float = sensor("gyro_noise_density", 3e-4)
    acc_noise_density: float = sensor("acc_noise_density", 2e-3)
    mag_noise_sd: float = sensor("mag_noise_sd", 1e-6)


class DeviceTopic:
    """One topic.

    Args:
        node: publishes it. topic: relative name. frame: frame_id, None for that of the samples.
        noise: of what tells no accuracy. qos: of the publisher.

    ``count`` messages were published; ``gaps`` and ``backwards`` count intervals with a sample
    missing, and stamps that did not rise.
    """

    def __init__(self, node: Node, topic: str, frame: str | None, noise: DriverSensor,
                 qos: QoSProfile) -> None:
        layout = IMU if topic.startswith(ARRAY_TOPIC) else _TYPES.get(topic, POSE)
        self._publisher = node.create_publisher(message_class(layout.msgtype), topic, qos)
        self._frame, self._sensor = frame, noise
        self.count = self.gaps = self.backwards = 0
        self._last: int | None = None
        self._intervals: list[int] = []    # the first ones
        self._usual = 0.0
        self._asked = (time.monotonic(), 0)

    def subscribers(self) -> int:
        """Number of subscriptions."""
        return self._publisher.get_subscription_count()

    def rate(self) -> float:
        """Messages a second since it was asked last."""
        (before, count), self._asked = self._asked, (time.monotonic(), self.count)
        return (self.count - count) / max(self._asked[0] - before, 1e-9)

    def publish(self, log: Log) -> None:
        """Publish samples."""
        self._regard(log.stamp)
        for cdr in sample_messages(log, self._noise(), self._frame):
            self._publisher.publish(cdr)
        self.count += len(log)

    def _noise(self) -> NoiseSd:
        """Unknown until the rate is known."""
        per_root = np.sqrt(NANOSECONDS / self._usual) if self._usual else 0.0
        return NoiseSd(self._sensor.gyro_noise_density * per_root,
                       self._sensor.acc_noise_density * per_root, self._sensor.mag_noise_sd)

    def _regard(self, stamp: np.ndarray) -> None:
        step = np.diff(stamp, prepend=stamp[0] if self._last is None else self._last)
        if self._last is None:
            step = step[1:]
        self._last = int(stamp[-1])
        self.backwards += int((step <= 0).sum())
        if not self._usual:
            self._intervals += step[step > 0].tolist()
            if len(self._intervals) >= _RATED:
                self._usual = float(np.median(self._intervals))
        else:
            self.gaps += int((step > _GAP * self._usual).sum())
