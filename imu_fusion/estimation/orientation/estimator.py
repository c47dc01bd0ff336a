"""Orientation of an IMU: the estimator that nodes and batch share.

:class:`OrientationEstimator` collects the first interval, finds the initial
orientation from it and then hands every sample to a compiled kernel. A sample at a
time or a whole log at once, the same kernel runs in the same order.
"""

import math
from dataclasses import replace

import numpy as np

from imu_fusion.errors import EstimationError, ParameterError, SampleError
from imu_fusion.estimation.orientation import fusion
from imu_fusion.estimation.orientation import gyro_mag
from imu_fusion.estimation.orientation import state as st
from imu_fusion.estimation.orientation.alignment import align, usable_mags
from imu_fusion.estimation.orientation.detect import limits_of
from imu_fusion.estimation.orientation.fixed_lag import FixedLag
from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.estimation.orientation.fixed_interval import smooth
from imu_fusion.estimation.orientation.state import ORIENTATION_DTYPE
from imu_fusion.geometry.rotation import quat_exp, quat_multiply, quat_to_rpy

# Rotation from ENU to the world frame that is published, xyzw.
_WORLD_FRAMES = {
    "enu": (0.0, 0.0, 0.0, 1.0),
    "nwu": (0.0, 0.0, -math.sqrt(0.5), math.sqrt(0.5)),
    "ned": (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0),
}
_CHUNK = 256
_COUNTERS = (st.IMU_USED, st.IMU_REJECTED, st.MAG_USED, st.MAG_REJECTED, st.MAG_LATE,
             st.MAG_DISTURBED, st.GAPS, st.SATURATED, st.MAG_SATURATED,
             st.RATES_HELD)


def _axes(value, default):
    """A parameter of one or three elements as (3,)."""
    return np.full(3, default) if value is None else np.broadcast_to(value, 3).astype(float)


class OrientationEstimator:
    """Causal orientation from gyroscope, accelerometer and magnetometer samples.

    Rows of ORIENTATION_DTYPE come out, one per accepted Imu sample, in order. None
    come while the first ``alignment_duration`` seconds are collected; then all of
    them at once.

    A sample that is not finite is counted and dropped, and so is an Imu sample
    that is not newer than the last. A magnetometer sample may come late by up to
    ``max_mag_lag``. After a gap the estimate goes on with a larger covariance, after one above
    ``restart_gap`` it starts anew.
    """

    def __init__(self, params=OrientationParams()):
        self.params = params
        self._kernel = {"fusion": fusion, "gyro_mag": gyro_mag}[params.method]
        self._par = self._pack(params)
        self._sample = np.empty(6)
        self._mag = np.empty(3)
        self._new_chunk()
        self.reset()

    def set_params(self, params):
        """Go on with other parameters from the next sample on.

        Raises:
            ParameterError: another method or mode, which have another state.
        """
        if (params.method, params.mode) != (self.params.method, self.params.mode):
            raise ParameterError("parameters 'method' and 'mode' cannot change while running: "
                                 "start another estimator")
        self.params, self._par = params, self._pack(params)

    def reset(self):
        """Forget all samples: the next ones start a new alignment."""
        self._counted = np.zeros(self._kernel.K_SIZE, dtype=np.int64)
        self._yaw = 0.0
        self._forget()

    def _forget(self):
        self._x = np.zeros(self._kernel.X_SIZE)
        self._k = np.zeros(self._kernel.K_SIZE, dtype=np.int64)
        self._waiting = []
        self._waiting_imus = 0
        self._alignment = None
        self._lag = FixedLag(self.params.lag) if self.params.lag else None

    def add_imu(self, stamp, gyr, acc):
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
                and st.is_imu_sample(self._sample)):
            return np.concatenate([self._restart(), self.add_imu(stamp, gyr, acc)])
        if self._alignment is None:
            return self._wait_imu(stamp)
        return self._step(stamp)

    def add_mag(self, stamp, mag):
        """Take one magnetometer sample: int ns, (3,) tesla. Returns rows like add_imu."""
        self._mag[:] = mag
        if self._alignment is None:
            if st.is_mag_sample(self._mag):
                self._waiting.append((stamp, self._mag.copy()))
            else:
                self._k[st.MAG_REJECTED] += 1
        else:
            self._kernel.push_mag(self._x, self._k, self._par, stamp, self._mag)
            # While no Imu comes, none is kept: after that gap all starts anew.
            if (self._lag is not None
                    and stamp - int(self._k[st.LAST_STAMP]) <= self._restart_gap):
                self._lag.add((), None, np.array([stamp]), self._mag.copy()[None])
        return self._chunk[:0]

    def finish(self):
        """The end of the stream: rows that still wait for the alignment."""
        rows = self._chunk[:0]
        if self._alignment is None and self._waiting_imus:
            rows = self._start()
        if self._lag is not None:
            self._lag.finish(self._par)
        return rows

    def take_corrected(self):
        """Rows corrected by looking ahead (parameter ``lag``) since the last call; the last
        ones come with :meth:`finish`."""
        return self._chunk[:0] if self._lag is None else self._lag.take()

    def run(self, imu, mag=None):
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
        good = np.flatnonzero(st.are_imu_samples(np.hstack([imu.gyr, imu.acc])))
        newest = np.maximum.accumulate(imu.stamp[good])
        last = self._last_imu()
        before = np.append(newest[:1] if last is None else last, newest[:-1])
        before = np.maximum(before, before[:1])
        return good[imu.stamp[good] - before > self._restart_gap].tolist()

    @property
    def _restart_gap(self):
        return int(self.params.restart_gap * 1e9)

    def _last_imu(self):
        """Stamp of the newest Imu sample taken, or None."""
        if self._alignment is not None:
            return int(self._k[st.LAST_STAMP])
        return next((s for s, v in reversed(self._waiting) if len(v) == 6), None)

    def _restart(self):
        """After a gap in which anything can have happened: rows that still wait, then align
        anew, at the yaw of before if nothing tells another."""
        rows = self.finish()
        if self._alignment is not None:
            self._yaw = quat_to_rpy(self._x[st.Q:st.Q + 4])[2]
        corrected = None if self._lag is None else self._lag.take()
        for counter in _COUNTERS:
            self._counted[counter] += self._k[counter]
        self._counted[st.GAPS] += 1
        self._forget()
        self._k[st.MAG_FLAGS] |= st.FLAG_GAP
        if self._lag is not None:
            self._lag.keep(corrected)
        return rows

    def get_state(self):
        """A snapshot for :meth:`set_state`: going on from it changes nothing."""
        return dict(x=self._x.copy(), k=self._k.copy(), waiting=list(self._waiting),
                    counted=self._counted.copy(), yaw=self._yaw,
                    alignment=self._alignment,
                    lag=None if self._lag is None else self._lag.copy())

    def set_state(self, state):
        """Go on from a snapshot of an estimator with the same parameters.

        Raises:
            SampleError: the snapshot is that of another method.
        """
        if state["x"].shape != self._x.shape or state["k"].shape != self._k.shape:
            raise SampleError("the orientation snapshot was taken with another method; "
                              f"this estimator runs '{self.params.method}'")
        self._x = state["x"].copy()
        self._k = state["k"].copy()
        self._waiting = list(state["waiting"])
        self._waiting_imus = sum(len(event[1]) == 6 for event in self._waiting)
        self._alignment = state["alignment"]
        self._counted, self._yaw = state["counted"].copy(), state["yaw"]
        self._lag = None if state["lag"] is None else state["lag"].copy()

    @property
    def mag_saturated(self):
        """How many magnetometer samples were refused with an axis at its limit."""
        return int(self._k[st.MAG_SATURATED] + self._counted[st.MAG_SATURATED])

    def summary(self):
        """Plain numbers and strings for diagnostics (angles in degrees, field in microtesla)."""
        k, x, a = self._k + self._counted, self._x, self._alignment
        counts = dict(
            method=self.params.method, aligned=a is not None, imu_used=int(k[st.IMU_USED]),
            imu_rejected=int(k[st.IMU_REJECTED]), mag_used=int(k[st.MAG_USED]),
            mag_rejected=int(k[st.MAG_REJECTED]), mag_late=int(k[st.MAG_LATE]),
            mag_disturbed=int(k[st.MAG_DISTURBED]),
            mag_saturated=int(k[st.MAG_SATURATED]), gaps=int(k[st.GAPS]),
            saturated=int(k[st.SATURATED]), rates_held=int(k[st.RATES_HELD]))
        if a is None:
            return counts
        bias = x[st.GYR_BIAS:st.GYR_BIAS + 3]
        return counts | dict(
            started_at_rest=a.at_rest, has_heading=bool(k[st.HEADING_KNOWN]),
            **{f"initial_quat_{c}": float(v) for c, v in zip("xyzw", a.quat_world_imu)},
            initial_tilt_sd_deg=math.degrees(math.sqrt(a.cov_attitude_world[0, 0])),
            initial_heading_sd_deg=math.degrees(math.sqrt(a.cov_attitude_world[2, 2])),
            inclination_deg=math.degrees(a.inclination), field_norm_ut=a.field_norm * 1e6,
            gravity=a.gravity,
            **{f"gyr_bias_{c}": float(v) for c, v in zip("xyz", bias)},
            gyro_delay=self._par[st.P_GYR_DELAY],
            mag_delay=self._par[st.P_GYR_DELAY] + float(x[st.LAG]))

    def _step(self, stamp):
        if self._next == _CHUNK:
            self._new_chunk()
        if self._lag is not None:
            if stamp >= self._lag.border:
                self._lag.cross(stamp, self._x, self._k, self._par)
            self._lag.add(np.array([stamp]), self._sample.copy()[None], (), None)
        i = self._next
        if not self._kernel.step_imu(self._x, self._k, self._par, stamp, self._sample,
                                     self._floats[i], self._ints[i]):
            return self._chunk[:0]
        self._next = i + 1
        return self._chunk[i:i + 1]

    def _new_chunk(self):
        # Rows are handed out as slices of a chunk: one allocation for many samples.
        self._chunk = np.zeros(_CHUNK, ORIENTATION_DTYPE)
        self._floats, self._ints = _views(self._chunk)
        self._next = 0

    def _wait_imu(self, stamp):
        last = self._last_imu()
        if not st.is_imu_sample(self._sample) or (last is not None and stamp <= last):
            self._k[st.IMU_REJECTED] += 1
            return self._chunk[:0]
        self._waiting.append((stamp, self._sample.copy()))
        self._waiting_imus += 1
        first = next(s for s, v in self._waiting if len(v) == 6)
        if stamp - first < self.params.alignment_duration * 1e9:
            return self._chunk[:0]
        return self._start()

    def _run_smoothed(self, imu, mag_stamps, mags):
        if self._alignment is not None or self._waiting:
            raise EstimationError("mode 'smoothed' needs the whole recording in one run(); "
                                  "reset() first, or use mode 'causal'")
        samples = np.hstack([imu.gyr, imu.acc])
        good = st.are_imu_samples(samples)
        if not good.any():
            return self._chunk[:0]
        origin = imu.stamp[np.argmax(good)]
        end = origin + int(self.params.alignment_duration * 1e9)
        first = good & (imu.stamp <= end)
        first_mag = mag_stamps <= end
        first_mag[first_mag] = [st.is_mag_sample(mag) for mag in mags[first_mag]]
        self._align(imu.stamp[first], samples[first], mag_stamps[first_mag], mags[first_mag])
        rows = np.zeros(len(imu), ORIENTATION_DTYPE)
        after = mag_stamps >= origin
        written = smooth(self._x, self._k, self._par, imu.stamp, samples, mag_stamps[after],
                         mags[after], *_views(rows))
        return rows[:written]

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
        p, par = self.params, self._par
        usable = usable_mags(mag, par[st.P_MAG_RANGE:st.P_MAG_RANGE + 3])
        usable &= mag_stamps >= stamps[0]    # how the sensor turned before, nobody knows
        mag_stamps, mag = mag_stamps[usable], mag[usable]
        calibrated = ((mag - par[st.P_IRON_OFFSET:st.P_IRON_OFFSET + 3])
                      @ par[st.P_IRON_MATRIX:st.P_IRON_MATRIX + 9].reshape(3, 3).T)
        self._alignment = align(
            stamps, samples[:, :3], samples[:, 3:], mag_stamps, calibrated,
            declination=par[st.P_DECLINATION], yaw_offset=math.radians(p.yaw_offset_deg),
            gyr_density=p.gyro_noise_density, gyr_bias_sd=p.gyro_bias_sd,
            acc_bias_sd=p.acc_bias_sd, mag_sd=p.mag_noise_sd,
            gyr_limits=limits_of(samples[:, :3], par))
        if not self._alignment.has_heading and self._yaw:
            turn = self._yaw - quat_to_rpy(self._alignment.quat_world_imu)[2]
            self._alignment = replace(self._alignment, quat_world_imu=np.array(
                quat_multiply(quat_exp((0.0, 0.0, turn)), self._alignment.quat_world_imu)))
        self._x[st.LAG] = 0.0 if p.mag_delay is None else p.mag_delay - self._par[st.P_GYR_DELAY]
        self._kernel.initialise(self._x, self._k, par, self._alignment)
        self._k[st.ALIGN_UNTIL] = stamps[-1]

    def _run_kernel(self, stamps, samples, mag_stamps, mags):
        if self._lag is None:
            return self._run_window(stamps, samples, mag_stamps, mags)
        parts = []
        i = j = 0
        while i < len(stamps) or j < len(mag_stamps):
            if i < len(stamps) and stamps[i] >= self._lag.border:
                self._lag.cross(int(stamps[i]), self._x, self._k, self._par)
            beyond = np.flatnonzero(stamps[i:] >= self._lag.border)
            end = i + int(beyond[0]) if len(beyond) else len(stamps)
            # A magnetometer sample comes before the Imu sample of its own stamp.
            end_mag = (np.searchsorted(mag_stamps, stamps[end], side="right")
                       if end < len(stamps) else len(mag_stamps))
            end_mag = max(end_mag, j)
            window = (stamps[i:end], samples[i:end], mag_stamps[j:end_mag], mags[j:end_mag])
            parts.append(self._run_window(*window))
            self._lag.add(*window)
            i, j = end, end_mag
        return np.concatenate([self._chunk[:0], *parts])

    def _run_window(self, stamps, samples, mag_stamps, mags):
        rows = np.zeros(len(stamps), ORIENTATION_DTYPE)
        written = self._kernel.run_loop(self._x, self._k, self._par, stamps, samples,
                                        mag_stamps, mags, *_views(rows))
        return rows[:written]

    def _pack(self, p):
        par = np.zeros(self._kernel.P_SIZE)
        par[st.P_GYR_DELAY] = p.gyro_delay or 0.0
        par[st.P_DELAY_SD] = p.gyro_delay_sd if p.gyro_delay is None else 0.0
        par[st.P_DECLINATION] = math.radians(p.declination_deg or 0.0)
        par[st.P_MAX_LAG] = p.max_mag_lag
        par[st.P_MAX_GAP] = p.max_gap
        par[st.P_GYR_DENSITY] = p.gyro_noise_density
        par[st.P_ACC_DENSITY] = p.acc_noise_density
        par[st.P_ACC_BIAS_SD] = p.acc_bias_sd
        par[st.P_MAG_SD] = p.mag_noise_sd
        par[st.P_RELIABILITY] = p.mag_reliability
        par[st.P_GAP_RATE_SD] = p.gap_rate_sd
        par[st.P_BIAS_WALK] = p.gyro_bias_walk
        par[st.P_AXES_SD] = p.axes_sd
        par[st.P_RANGE:st.P_RANGE + 3] = _axes(p.gyro_range, np.nan)
        par[st.P_MAG_RANGE:st.P_MAG_RANGE + 3] = _axes(p.mag_range, np.nan)
        par[st.P_FRAME:st.P_FRAME + 4] = _WORLD_FRAMES[p.world_frame]
        par[st.P_IRON_OFFSET:st.P_IRON_OFFSET + 3] = p.mag_offset
        par[st.P_IRON_MATRIX:st.P_IRON_MATRIX + 9] = p.mag_matrix
        self._kernel.pack(par, p)
        return par


def _views(rows):
    """Float and integer (n, ROW_WORDS) views of contiguous rows."""
    return (rows.view(np.float64).reshape(-1, st.ROW_WORDS),
            rows.view(np.int64).reshape(-1, st.ROW_WORDS))
