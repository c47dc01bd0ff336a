"""The orientation estimator between its topics, live and in batch."""

import numpy as np

from imu_fusion.estimation.orientation import OrientationEstimator, OrientationParams
from imu_fusion.estimation.orientation_state import FLAG_STILL
from imu_fusion.messages.convert import (SAMPLE_TYPES, bool_message, orientation_message,
                                         rpy_message)
from imu_fusion.messages.layouts import BOOL_TYPE, IMU, MAG, VECTOR3
from imu_fusion.messages.streams import Stream
from imu_fusion.samples import MagLog, checks

IMU_TOPIC = "imu/data_raw"
MAG_TOPIC = "imu/mag"
ORIENTATION_TOPIC = "imu/data"
RPY_TOPIC = "imu/rpy/filtered"
STEADY_TOPIC = "imu/steady_state"

# A magnetometer sample comes before the Imu sample of its stamp, which then uses it.
INPUTS = {MAG_TOPIC: SAMPLE_TYPES[MAG.msgtype], IMU_TOPIC: SAMPLE_TYPES[IMU.msgtype]}
OUTPUTS = {ORIENTATION_TOPIC: IMU.msgtype, RPY_TOPIC: VECTOR3.msgtype, STEADY_TOPIC: BOOL_TYPE}


class _Writer:
    """Messages of the estimator's rows; knows what was said last of the steady state."""

    def __init__(self):
        self._steady = None

    def messages(self, rows, frame_id):
        """Yield (topic, stamp, cdr)."""
        for row in rows:
            stamp = int(row["stamp"])
            yield ORIENTATION_TOPIC, stamp, orientation_message(row, frame_id)
            yield RPY_TOPIC, stamp, rpy_message(row, frame_id)
            steady = bool(row["flags"] & FLAG_STILL)
            if steady != self._steady:
                self._steady = steady
                yield STEADY_TOPIC, stamp, bool_message(steady)


class OrientationStream(Stream):
    """See :class:`imu_fusion.messages.streams.Stream`; params: OrientationParams."""

    def __init__(self, params=OrientationParams(), emit=None, warn=lambda text: None):
        self.estimator = OrientationEstimator(params)
        super().__init__(INPUTS, emit, warn)

    def reset(self, session_topics=None):
        self._writer = _Writer()
        super().reset(session_topics)

    def restart(self):
        self.estimator.reset()

    def take(self, topic, stamp, sample):
        if topic == IMU_TOPIC:
            self._write(self.estimator.add_imu(stamp, sample[:3], sample[3:]))
        else:
            self._write(self.estimator.add_mag(stamp, sample))

    def flush(self):
        self._write(self.estimator.finish())

    def look_at(self, topic, logs):
        if topic == IMU_TOPIC:
            found = checks.check_acceleration(logs[topic].acc, logs[topic].stamp, topic)
        else:
            found = checks.check_field(logs[topic].mag, topic)
        if len(logs) == 2:
            found += checks.check_axes(logs[IMU_TOPIC], logs[MAG_TOPIC], MAG_TOPIC)
        return [finding.text for finding in found]

    def _write(self, rows):
        if len(rows):
            for message in self._writer.messages(rows, self.frame_ids[IMU_TOPIC]):
                self.emit(*message)


def findings(logs):
    """What looks wrong with whole logs: texts.

    Args:
        logs: dict of input topic to log, as recorded.
    """
    found = checks.check_imu(logs[IMU_TOPIC], IMU_TOPIC)
    if MAG_TOPIC in logs:
        found += checks.check_mag(logs[MAG_TOPIC], MAG_TOPIC)
        found += checks.check_axes(logs[IMU_TOPIC], logs[MAG_TOPIC], MAG_TOPIC)
    return [finding.text for finding in found]


def run(params, logs, report):
    """The messages that :class:`OrientationStream` emits for a session, from whole logs.

    Args:
        params: OrientationParams.
        logs: dict of input topic to (log, epochs) of guarded samples.
        report: gets the estimator's ``results``.

    Yields:
        (topic, stamp, cdr)
    """
    estimator = OrientationEstimator(params)
    writer = _Writer()
    imu, imu_epochs = logs[IMU_TOPIC]
    mag, mag_epochs = logs.get(MAG_TOPIC, (MagLog(np.empty(0, np.int64), np.empty((0, 3))),
                                           np.empty(0, np.int64)))
    for epoch in np.union1d(imu_epochs, mag_epochs):
        estimator.reset()
        rows = [estimator.run(imu[imu_epochs == epoch], mag[mag_epochs == epoch]),
                estimator.finish()]
        yield from writer.messages(np.concatenate(rows), imu.frame_id)
    report.results = estimator.summary()
