"""Estimators between messages: CDR bytes in, CDR bytes out, live or batch.

Here it is decided once which topics an estimator takes and what it says on which
topic; nodes add DDS to it and batch adds recordings. Nothing here knows rclpy.
"""

from collections import deque

import numpy as np

from imu_fusion.errors import MessageError
from imu_fusion.estimation.orientation import OrientationEstimator, OrientationParams
from imu_fusion.estimation.orientation_state import FLAG_STILL
from imu_fusion.messages.convert import (bool_message, imu_values, mag_values,
                                         orientation_message, rpy_message)
from imu_fusion.messages.layouts import BOOL_TYPE, IMU, MAG, VECTOR3
from imu_fusion.samples import ImuLog, MagLog, checks
from imu_fusion.samples.merge import RESTART, SampleStream

IMU_TOPIC = "imu/data_raw"
MAG_TOPIC = "imu/mag"
ORIENTATION_TOPIC = "imu/data"
RPY_TOPIC = "imu/rpy/filtered"
STEADY_TOPIC = "imu/steady_state"

_LOOK_AT = 500  # samples of each topic whose units and axes are looked at, live


def _orientation_messages(rows, frame_id, steady):
    """Yield (topic, stamp, cdr) of the estimator's rows; ``steady`` was said last (or None)."""
    for row in rows:
        stamp = int(row["stamp"])
        yield ORIENTATION_TOPIC, stamp, orientation_message(row, frame_id)
        yield RPY_TOPIC, stamp, rpy_message(row, frame_id)
        now = bool(row["flags"] & FLAG_STILL)
        if now != steady:
            steady = now
            yield STEADY_TOPIC, stamp, bool_message(now)


class OrientationStream:
    """The orientation estimator between its topics; a stage of a flow Relay.

    Args:
        params: OrientationParams.
        emit: called as ``emit(topic, stamp, cdr)`` with every message made.
        warn: called with a text when something is wrong with the input.
    """

    inputs = {MAG_TOPIC: MAG, IMU_TOPIC: IMU}  # in order of rank at equal stamps
    outputs = {ORIENTATION_TOPIC: IMU.msgtype, RPY_TOPIC: VECTOR3.msgtype,
               STEADY_TOPIC: BOOL_TYPE}
    _values = {MAG_TOPIC: mag_values, IMU_TOPIC: imu_values}

    def __init__(self, params=OrientationParams(), emit=None, warn=lambda text: None):
        self.estimator = OrientationEstimator(params)
        self._emit = emit
        self._warn = warn
        self._queue = deque()
        self.stream = SampleStream(self.inputs, self._refused)
        self.bad_messages = 0
        self.reset()

    def reset(self, session_topics=None):
        """Start over: with strict merging of these topics, or live (None)."""
        self.estimator.reset()
        self.stream.begin(session_topics)
        self._queue.clear()
        self._steady = None
        self.frame_ids = {}
        self._first = {topic: [] for topic in self.inputs}

    def push(self, topic, cdr):
        """Take the bytes of one message; what may happen now is queued for :meth:`step`."""
        try:
            stamp, frame_id, values = self.inputs[topic].decode(cdr)
        except MessageError as error:
            self.bad_messages += 1
            self._warn(f"{topic}: message left out: {error}")
            return
        if topic not in self.frame_ids:
            self.frame_ids[topic] = frame_id
            self._check_frames()
        values = self._values[topic](values)
        if len(self._first[topic]) < _LOOK_AT:
            self._look_at(topic, stamp, values)
        self._queue.extend(self.stream.add(topic, stamp, values))

    def step(self):
        """Process one queued event; False if there is none."""
        if not self._queue:
            return False
        topic, stamp, values = self._queue.popleft()
        if topic == RESTART:
            self._warn("the clock was set back: the estimator starts anew")
            self._write(self.estimator.finish())
            self.estimator.reset()
        elif topic == IMU_TOPIC:
            self._write(self.estimator.add_imu(stamp, values[:3], values[3:]))
        else:
            self._write(self.estimator.add_mag(stamp, values))
        return True

    def topic_ended(self, topic):
        """Nothing more comes on this topic in this session."""
        self._queue.extend(self.stream.end(topic))

    def finish(self):
        """The end of the session: what the estimator still holds is emitted."""
        while self.step():
            pass
        self._write(self.estimator.finish())

    def _write(self, rows):
        for topic, stamp, cdr in _orientation_messages(rows, self.frame_ids.get(IMU_TOPIC, ""),
                                                       self._steady):
            if topic == STEADY_TOPIC:
                self._steady = cdr[-1] == 1
            self._emit(topic, stamp, cdr)

    def _look_at(self, topic, stamp, values):
        first = self._first[topic]
        first.append((stamp, values))
        if len(first) < _LOOK_AT:
            return
        logs = {t: _raw_log(t, rows) for t, rows in self._first.items()}
        findings = _unit_findings(topic, logs[topic])
        if all(len(log) >= _LOOK_AT for log in logs.values()):
            findings += checks.check_axes(logs[IMU_TOPIC], logs[MAG_TOPIC], MAG_TOPIC)
        for finding in findings:
            self._warn(finding.text)

    def _refused(self, topic, stamp, verdict):
        count = self.stream.guards[topic].counts[verdict]
        if count in (1, 10, 100) or count % 1000 == 0:
            self._warn(f"{topic}: sample at stamp {stamp} left out: {verdict.value} "
                       f"({count} so far)")

    def _check_frames(self):
        frames = self.frame_ids
        if len(set(frames.values())) > 1:
            self._warn(f"{MAG_TOPIC} is in frame '{frames[MAG_TOPIC]}' and {IMU_TOPIC} in "
                       f"'{frames[IMU_TOPIC]}': their axes are taken as parallel")


def _raw_log(topic, rows):
    stamps = np.array([stamp for stamp, _ in rows], dtype=np.int64)
    values = np.array([values for _, values in rows])
    if topic == IMU_TOPIC:
        return ImuLog(stamps, values[..., :3], values[..., 3:])
    return MagLog(stamps, values)


def _unit_findings(topic, log):
    if topic == IMU_TOPIC:
        return checks.check_acceleration(log.acc, log.stamp, topic)
    return checks.check_field(log.mag, topic)


def orientation_findings(logs):
    """What looks wrong with whole logs: texts.

    Args:
        logs: dict of input topic to log, as recorded.
    """
    findings = checks.check_imu(logs[IMU_TOPIC], IMU_TOPIC)
    if MAG_TOPIC in logs:
        findings += checks.check_mag(logs[MAG_TOPIC], MAG_TOPIC)
        findings += checks.check_axes(logs[IMU_TOPIC], logs[MAG_TOPIC], MAG_TOPIC)
    return [finding.text for finding in findings]


def orientation_batch(params, logs):
    """The messages that :class:`OrientationStream` emits for a session, from whole logs.

    Args:
        params: OrientationParams.
        logs: dict of input topic to (log, epochs) of guarded samples.

    Yields:
        (topic, stamp, cdr)
    """
    estimator = OrientationEstimator(params)
    imu, imu_epochs = logs[IMU_TOPIC]
    mag, mag_epochs = logs.get(MAG_TOPIC, (MagLog(np.empty(0, np.int64), np.empty((0, 3))),
                                           np.empty(0, np.int64)))
    steady = None
    for epoch in np.union1d(imu_epochs, mag_epochs):
        estimator.reset()
        rows = [estimator.run(imu[imu_epochs == epoch], mag[mag_epochs == epoch]),
                estimator.finish()]
        for topic, stamp, cdr in _orientation_messages(np.concatenate(rows), imu.frame_id, steady):
            if topic == STEADY_TOPIC:
                steady = cdr[-1] == 1
            yield topic, stamp, cdr
