"""Orientation of an IMU: the estimator that nodes and batch share.

:class:`OrientationEstimator` collects the first interval, finds the initial
orientation from it and then hands every sample to a compiled kernel. A sample at a
time or a whole log at once, the same kernel runs in the same order.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from imu_fusion.errors import EstimationError, ParameterError, SampleError
from imu_fusion.estimation.orientation import bank, hard_iron, kernel, remarks, summary
from imu_fusion.estimation.orientation.alignment import (
    Alignment,
    align,
    calibrated,
    fields_of,
    usable_mags,
)
from imu_fusion.estimation.orientation.error_state import TAPE
from imu_fusion.estimation.orientation.first_interval import from_start
from imu_fusion.estimation.orientation.fixed_interval import smooth
from imu_fusion.estimation.orientation.fixed_lag import FixedLag
from imu_fusion.estimation.orientation.gyro_limit import limits_of
from imu_fusion.estimation.orientation.imu_rejection import are_imu_samples, is_imu_sample
from imu_fusion.estimation.orientation.lost_turn import is_blind, widen_lost
from imu_fusion.estimation.orientation.mag_rejection import is_mag_sample
from imu_fusion.estimation.orientation.params import OrientationParams, kernel_parameters
from imu_fusion.estimation.orientation.rows import FLAG_GAP, ORIENTATION_DTYPE
from imu_fusion.estimation.orientation.state import COUNT_NAMES, COUNTS, new_state
from imu_fusion.geometry.rotation import quat_exp, quat_multiply, quat_to_rpy
from imu_fusion.samples.logs import ImuLog, MagLog

_CHUNK = 256
_NO_TAPES = np.zeros(0, TAPE)


class OrientationEstimator:
    """Orientation from gyroscope, accelerometer and magnetometer samples.

    Rows of ORIENTATION_DTYPE come out, one per accepted Imu sample, in order. None
    come while the first ``alignment.duration`` seconds are collected; then all of
    them at once.

    A sample that is not finite is counted and dropped, and so is an Imu sample
    that is not newer than the last. A magnetometer sample may come late by up to
    ``mag.max_latency``. After a gap the estimate goes on with a larger covariance, after one above
    ``gap.restart`` it starts anew.
    """

    def __init__(self, params: OrientationParams = OrientationParams()) -> None:
        self.params = params
        self._par = kernel_parameters(params)
        self._sample = np.empty(6)
        self._mag = np.empty(3)
        self._new_chunk()
        self.reset()

    def set_params(self, params: OrientationParams) -> None:
        """Go on with other parameters from the next sample on.

        Raises:
            ParameterError: another method or mode, which have another state.
        """
        if self._kind(params) != self._kind(self.params):
            raise ParameterError(
                "parameters 'method', 'gyro_mag.as_printed', 'mode', the numbers of values of "
                "'fusion.local_field_sd' and 'fusion.gyro_factor', and whether "
                "'fusion.lasting_acc_sd' is 0 cannot change while running: start another estimator")
        self.params, self._par = params, kernel_parameters(params)

    @staticmethod
    def _kind(params):
        return (params.method, params.is_as_printed, params.mode,
                len(params.fusion.local_field_sd), len(params.fusion.gyro_factor),
                params.fusion.use_acc and params.fusion.lasting_acc_sd > 0.0)

    def reset(self) -> None:
        """Forget all samples: the next ones start a new alignment."""
        self._start_at: int | None = None    # ns
        self._counted = np.zeros(1, COUNTS)
        self._yaw = 0.0
        self._forget()

    def _forget(self):
        self._adopt(new_state(len(self._par)))
        self._waiting = []
        self._waiting_imus = 0
        self._alignment: Alignment | None = None
        self._before: np.ndarray | None = None
        self._lag = None if self.params.lag is None else FixedLag(self.params.lag)

    def _adopt(self, state):
        self._state = state
        self._newest = state["stamp"]    # a view: (k,), all equal

    def add_imu(self, stamp: int, gyr: ArrayLike, acc: ArrayLike) -> np.ndarray:
        """Take one Imu sample.

        Args:
            stamp: int ns. gyr: (3,) rad/s. acc: (3,) specific force, m/s^2.

        Returns:
            ORIENTATION_DTYPE array of the rows that are now final, possibly none.
        """
        self._sample[:3] = gyr
        self._sample[3:] = acc
        last = self._last_imu()
        if (last is not None and stamp - last > self._restart_gap
                and is_imu_sample(self._sample)):
            return np.concatenate([self._restart(), self.add_imu(stamp, gyr, acc)])
        if self._alignment is None:
            return self._wait_imu(stamp)
        return self._step(stamp)

    def add_mag(self, stamp: int, mag: ArrayLike) -> np.ndarray:
        """Take one magnetometer sample: int ns, (3,) tesla. Returns rows like add_imu."""
        self._mag[:] = mag
        if self._alignment is None:
            if is_mag_sample(self._mag):
                self._waiting.append((stamp, self._mag.copy()))
            else:
                self._state["counts"]["mag_rejected"] += 1
        else:
            _, push_mag = kernel.live_calls()
            push_mag(self._state, self._par, stamp, self._mag)
            # While no Imu comes, none is kept: after that gap all starts anew.
            if (self._lag is not None
                    and stamp - int(self._newest[0]) <= self._restart_gap):
                self._lag.add_mag(np.array([stamp]), self._mag.copy()[None])
        return self._chunk[:0]

    def finish(self) -> np.ndarray:
        """The end of the stream: rows that still wait for the alignment."""
        rows = self._chunk[:0]
        if self._alignment is None and self._waiting_imus:
            rows = self._start()
        if self._lag is not None:
            self._lag.finish(self._par)
        return rows

    def take_corrected(self) -> np.ndarray:
        """Rows corrected by looking ahead (parameter ``lag``) since the last call; the last
        ones come with :meth:`finish`."""
        return self._chunk[:0] if self._lag is None else self._lag.take()

    def run(self, imu: ImuLog, mag: MagLog | None = None) -> np.ndarray:
        """Whole logs: the same as add_imu and add_mag in merge order, in one compiled loop.

        Merge order is by stamp, the magnetometer first where stamps are equal.

        Args:
            imu: ImuLog. mag: MagLog or None.

        In mode ``smoothed`` the log must be whole: nothing is carried over from or to
        other calls.

        Returns:
            ORIENTATION_DTYPE array; call :meth:`finish` for what a log shorter than the
            alignment leaves behind.

        Raises:
            EstimationError: mode ``smoothed`` in the middle of a stream.
        """
        mag_stamps = np.empty(0, dtype=np.int64) if mag is None else mag.stamp
        mags = np.empty((0, 3)) if mag is None else mag.mag
        parts = []
        i = j = 0
        for cut in self._restarts(imu):
            # A magnetometer sample comes before the Imu sample of its own stamp.
            end = max(int(np.searchsorted(mag_stamps, imu.stamp[cut], side="right")), j)
            parts += [self._run(imu[i:cut], mag_stamps[j:end], mags[j:end]), self._restart()]
            i, j = cut, end
        rows = self._run(imu[i:], mag_stamps[j:], mags[j:])
        return np.concatenate([*parts, rows]) if parts else rows

    def _run(self, imu, mag_stamps, mags):
        """:meth:`run` without a restart."""
        if self.params.mode == "smoothed":
            return self._run_smoothed(imu, mag_stamps, mags)
        parts = []
        i = j = 0
        while self._alignment is None and i < len(imu):
            while j < len(mag_stamps) and mag_stamps[j] <= imu.stamp[i]:
                self.add_mag(int(mag_stamps[j]), mags[j])
                j += 1
            parts.append(self.add_imu(int(imu.stamp[i]), imu.gyr[i], imu.acc[i]))
            i += 1
        if self._alignment is None:
            for later in range(j, len(mag_stamps)):
                self.add_mag(int(mag_stamps[later]), mags[later])
            return np.concatenate([self._chunk[:0], *parts])
        return np.concatenate([*parts, self._run_kernel(
            imu.stamp[i:], np.hstack([imu.gyr[i:], imu.acc[i:]]), mag_stamps[j:], mags[j:])])

    def _restarts(self, imu):
        """Indices of the samples before which the estimator starts anew."""
        good = np.flatnonzero(are_imu_samples(np.hstack([imu.gyr, imu.acc])))
        newest = np.maximum.accumulate(imu.stamp[good])
        last = self._last_imu()
        before = np.append(newest[:1] if last is None else last, newest[:-1])
        before = np.maximum(before, before[:1])
        return good[imu.stamp[good] - before > self._restart_gap].tolist()

    @property
    def _restart_gap(self):
        return int(self.params.gap.restart * 1e9)

    def _last_imu(self):
        """Stamp of the newest Imu sample taken, or None."""
        if self._alignment is not None:
            return int(self._newest[0])
        return next((s for s, v in reversed(self._waiting) if len(v) == 6), None)

    def _restart(self):
        """After a gap in which anything can have happened: rows that still wait, then align
        anew, at the yaw of before if nothing tells another."""
        rows = self.finish()
        best = self._likeliest()
        if self._alignment is not None:
            self._yaw = quat_to_rpy(self._state["quat_world_imu"][best])[2]
        corrected = self.take_corrected()
        self._counted = self._counts(best)
        self._counted["gaps"] += 1
        iron, before = self._state["hard_iron"][0].copy(), self._state
        if self._alignment is None:
            before = self._before
        self._forget()
        self._before = before
        self._state["hard_iron"] = iron    # which the sensor carries on
        self._state["hard_iron"]["count"] = 0
        self._state["waiting_flags"] |= FLAG_GAP
        if self._lag is not None:
            self._lag.keep(corrected)
        return rows

    def get_state(self) -> dict[str, Any]:
        """A snapshot for :meth:`set_state`: going on from it changes nothing."""
        return dict(kind=self._kind(self.params), state=self._state.copy(),
                    waiting=list(self._waiting), counted=self._counted.copy(), yaw=self._yaw,
                    alignment=self._alignment, start_at=self._start_at,
                    before=None if self._before is None else self._before.copy(),
                    lag=None if self._lag is None else self._lag.copy())

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from a snapshot of an estimator with the same parameters.

        Raises:
            SampleError: the snapshot is that of another method or mode.
        """
        if state["kind"] != self._kind(self.params):
            raise SampleError("the orientation snapshot was taken with another method or mode; "
                              f"this estimator runs '{self.params.method}', '{self.params.mode}'")
        self._adopt(state["state"].copy())
        self._waiting = list(state["waiting"])
        self._waiting_imus = sum(len(event[1]) == 6 for event in self._waiting)
        self._alignment, self._start_at = state["alignment"], state["start_at"]
        self._before = None if state["before"] is None else state["before"].copy()
        self._counted, self._yaw = state["counted"].copy(), state["yaw"]
        self._lag = None if state["lag"] is None else state["lag"].copy()

    @property
    def mag_saturated(self) -> int:
        """How many magnetometer samples were refused with an axis at its limit."""
        return int(self._state["counts"]["mag_saturated"][0] + self._counted["mag_saturated"][0])

    def summary(self) -> dict[str, Any]:
        """Plain numbers and strings for diagnostics, in :data:`summary.UNITS`.

        Of the hypotheses it is the likeliest: ``local_field_sd``, ``gyro_factor`` and
        ``lasting_acc_sd``, each with the weight of all that agree. ``wander_tilt`` and
        ``wander_heading`` are how many times more than white ones its innovations wander: the
        attitude's standard deviations are widened by what is above 1.
        """
        return summary.summary(self._state, self._par, self.params.method, self._alignment,
                               self._counts(self._likeliest())[0])

    def remarks(self) -> list[str]:
        """What makes the estimates so far doubtful, and what to do about it."""
        best = self._likeliest()
        blind = self._alignment is not None and is_blind(self.params, self._alignment.at_rest)
        return remarks.remarks(self._state[best], self._par[best],
                               int(self._counts(best)["realigned"][0]), blind)

    def _likeliest(self):
        return bank.likeliest(bank.weights(self._state, self._par))

    def _counts(self, hypothesis):
        """Counts of the present stretch, by one hypothesis, and of those before it, (1,) COUNTS."""
        total = self._counted.copy()
        for name in COUNT_NAMES:
            total[name] += self._state["counts"][name][hypothesis]
        return total

    def _step(self, stamp):
        if self._next == _CHUNK:
            self._new_chunk()
        if self._lag is not None:
            if stamp >= self._lag.border:
                self._lag.cross(stamp, self._state, self._par)
            self._lag.add_imu(np.array([stamp]), self._sample.copy()[None])
        row = self._chunk[self._next:self._next + 1]
        step_imu, _ = kernel.live_calls()
        if not step_imu(self._state, self._par, stamp, self._sample, row):
            return self._chunk[:0]
        self._next += 1
        return row

    def _new_chunk(self):
        # Rows are handed out as slices of a chunk: one allocation for many samples.
        self._chunk = np.zeros(_CHUNK, ORIENTATION_DTYPE)
        self._next = 0

    def _wait_imu(self, stamp):
        last = self._last_imu()
        if not is_imu_sample(self._sample) or (last is not None and stamp <= last):
            self._state["counts"]["imu_rejected"] += 1
            return self._chunk[:0]
        if self._start_at is None:
            self._start_at = stamp + round((self.params.alignment.start or 0.0) * 1e9)
        if stamp < self._start_at:
            return self._chunk[:0]
        self._waiting.append((stamp, self._sample.copy()))
        self._waiting_imus += 1
        first = next(s for s, v in self._waiting if len(v) == 6)
        if stamp - first < self.params.alignment.duration * 1e9:
            return self._chunk[:0]
        return self._start()

    def _run_smoothed(self, imu, mag_stamps, mags):
        if self._alignment is not None or self._waiting:
            raise EstimationError("mode 'smoothed' needs the whole recording in one run(); "
                                  "reset() first, or use mode 'causal'")
        if self._start_at is None:    # after a gap all that comes counts
            imu = from_start(imu, self.params)
            self._start_at = 0
        samples = np.hstack([imu.gyr, imu.acc])
        good = are_imu_samples(samples)
        if not good.any():
            return self._chunk[:0]
        origin = imu.stamp[np.argmax(good)]
        end = origin + int(self.params.alignment.duration * 1e9)
        first = good & (imu.stamp <= end)
        first_mag = mag_stamps <= end
        first_mag[first_mag] = [is_mag_sample(mag) for mag in mags[first_mag]]
        limits = limits_of(samples[good, :3], self._par)
        begun = imu.stamp[first], samples[first], mag_stamps[first_mag], mags[first_mag]
        at_rest = self._align(*begun)
        if hard_iron.search(
                self._state["hard_iron"], imu.stamp[good], samples[good, :3], limits["limit"][0],
                self._state["gyro_bias"][0], *fields_of(mag_stamps, mags, self._par), self.params):
            # What the whole recording shows is taken off from its first sample on.
            self._align(*begun)
        self._know_limits(limits)
        rows = np.zeros(len(imu), ORIENTATION_DTYPE)
        after = mag_stamps >= origin
        written = smooth(self._state, self._par, imu.stamp, samples, mag_stamps[after],
                         mags[after], rows)
        widen_lost(rows[:written], self.params, at_rest)
        return rows[:written]

    def _know_limits(self, found):
        """What the whole recording shows of the gyroscope's limits holds from its first sample."""
        for name in ("limit", "tolerance"):
            self._state["gyro_limit"][name] = found[name]

    def _start(self):
        """Align on the waiting samples and send them through the kernel."""
        imus = [(s, v) for s, v in self._waiting if len(v) == 6]
        mags = [(s, v) for s, v in self._waiting if len(v) == 3]
        self._waiting, self._waiting_imus = [], 0
        stamps = np.array([s for s, _ in imus], dtype=np.int64)
        samples = np.array([v for _, v in imus])
        mag_stamps = np.array([s for s, _ in mags], dtype=np.int64)
        mag = np.array([v for _, v in mags]).reshape(-1, 3)
        self._align(stamps, samples, mag_stamps, mag)
        after = mag_stamps >= stamps[0]
        return self._run_kernel(stamps, samples, mag_stamps[after], mag[after])

    def _align(self, stamps, samples, mag_stamps, mag):
        par = self._par
        usable = usable_mags(mag, par)
        usable &= mag_stamps >= stamps[0]    # how the sensor turned before, nobody knows
        mag_stamps, mag = mag_stamps[usable], mag[usable]
        field = calibrated(mag, par) - self._state["hard_iron"]["offset"][0]
        self._alignment = align(stamps, samples[:, :3], samples[:, 3:], mag_stamps, field,
                                self.params, limits_of(samples[:, :3], par)["limit"][0])
        if not self._alignment.has_heading and self._yaw:
            turn = self._yaw - quat_to_rpy(self._alignment.quat_world_imu)[2]
            self._alignment = replace(self._alignment, quat_world_imu=np.array(
                quat_multiply(quat_exp((0.0, 0.0, turn)), self._alignment.quat_world_imu)))
        if self.params.sensor.mag_delay is not None:
            self._state["mag_lag"] = self.params.sensor.mag_delay - par["gyro_delay"]
        kernel.initialise(self._state, par, self._alignment, self._before)
        self._state["align_until"] = stamps[-1]
        return self._alignment.at_rest

    def _run_kernel(self, stamps, samples, mag_stamps, mags):
        if self._lag is None:
            return self._run_window(stamps, samples, mag_stamps, mags)
        parts = []
        i = j = 0
        while i < len(stamps) or j < len(mag_stamps):
            if i < len(stamps) and stamps[i] >= self._lag.border:
                self._lag.cross(int(stamps[i]), self._state, self._par)
            beyond = np.flatnonzero(stamps[i:] >= self._lag.border)
            end = i + int(beyond[0]) if len(beyond) else len(stamps)
            # A magnetometer sample comes before the Imu sample of its own stamp.
            end_mag = (np.searchsorted(mag_stamps, stamps[end], side="right")
                       if end < len(stamps) else len(mag_stamps))
            end_mag = max(end_mag, j)
            imus, mag_part = (stamps[i:end], samples[i:end]), (mag_stamps[j:end_mag],
                                                               mags[j:end_mag])
            parts.append(self._run_window(*imus, *mag_part))
            self._lag.add_imu(*imus)
            self._lag.add_mag(*mag_part)
            i, j = end, end_mag
        return np.concatenate([self._chunk[:0], *parts])

    def _run_window(self, stamps, samples, mag_stamps, mags):
        rows = np.zeros(len(stamps), ORIENTATION_DTYPE)
        cursor = np.zeros(1, kernel.CURSOR)
        kernel.forward(self._state, self._par, stamps, samples, mag_stamps, mags, cursor, rows,
                       _NO_TAPES)
        return rows[:cursor["row"][0]]
