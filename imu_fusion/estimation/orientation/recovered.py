"""Rates beyond the gyroscope's range, recovered from a whole recording, for who integrates them.

Winkler 2025 (appendix B) recovers them sample by sample from two differences of the field. The
error-state filter has them as states and solves a burst as a whole, with a covariance.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.orientation.estimator import OrientationEstimator
from imu_fusion.estimation.orientation.gyro_limit import ranges_of
from imu_fusion.estimation.orientation.params import OrientationParams, kernel_parameters
from imu_fusion.samples.flat_tops import BAND
from imu_fusion.samples.logs import ImuLog, MagLog
from imu_fusion.sensors.unmixing import unmix

_WILD = 1.1    # limits: nothing that was clipped lies beyond, whatever a calibration mixes
_LATE = 2e-3   # s: less is what the estimate of a lag errs by


class Recovered(NamedTuple):
    """``imu`` with recovered rates and their standard deviation ``gyr_sd``; ``mag``, earlier by
    ``mag_lag`` s, where it was that much later than the rates (0: not, or by little)."""

    imu: ImuLog
    mag: MagLog
    mag_lag: float


def recover(imu: ImuLog, mag: MagLog | None, params: OrientationParams) -> Recovered:
    """Recover rates that were clipped, with their standard deviations.

    The errors of a burst go together for as long as the spin remembers its acceleration: n samples
    turn the body by n times the error of one, so that white noise which does as much has sqrt(n)
    times its standard deviation. But meanwhile the field holds the attitude: they turn the body by
    no more than its attitudes at two instants are unsure.

    While one axis is clipped, the others err, too: a calibration that mixes axes was applied to
    what had been clipped. Where the tops tell how it mixes (:mod:`imu_fusion.sensors.unmixing`),
    what was missing is mixed in once it is recovered, and all is recovered again. What is left of
    misalignment stands still in the sensor: it goes together for as long as the body takes for
    half a turn.

    Args:
        imu, mag: the whole recording. params: of method fusion; mode and range are set here.

    Raises:
        EstimationError: no magnetometer, which is what shows the rates.
    """
    if mag is None or not len(mag):
        raise EstimationError("rates beyond the gyroscope's range are recovered from the "
                              "magnetometer, and there is none: leave recover_rates false")
    imu = imu[np.isfinite(imu.gyr).all(axis=1)]
    limits = (ranges_of(imu.gyr, kernel_parameters(params)) if params.sensor.gyro_range is None
              else np.broadcast_to(params.sensor.gyro_range, 3))
    tops = unmix(imu.gyr, limits, BAND)
    mixing = tops.matrix - np.eye(3)
    rows, used, lag = _fused(imu, mag, imu.gyr, tops.clipped, limits, params)
    if tops.known.any():
        beyond = np.where(tops.clipped[used], rows["gyr"] - tops.seen[used], 0.0)
        mixed = imu.gyr.copy()
        mixed[used] += beyond @ mixing.T
        rows, used, lag = _fused(imu, mag, mixed, tops.clipped, limits, params)
    missing = tops.clipped[used]
    recovered = np.where(missing, _in_bursts(rows, missing, params.fusion.angular_acc_time), 0.0)
    mixed_in = recovered @ np.abs(mixing).T
    sd = np.hypot(np.where(missing, recovered, mixed_in),
                  _misaligned(rows, params.sensor.gyro_scale_sd))
    lag = lag if abs(lag) > _LATE else 0.0
    return Recovered(ImuLog(rows["stamp"], rows["gyr"], rows["acc"], imu.frame_id, sd),
                     replace(mag, stamp=mag.stamp - np.int64(round(lag * 1e9))), lag)


def _fused(imu, mag, gyr, clipped, limits, params):
    """Rows of the smoothed filter of rates (n, 3) that are ``clipped`` (n, 3), the indices of the
    samples that they are of, and s by which the magnetometer was later."""
    # Flat tops that nothing else reaches, but for wild values: that is how the filter knows them.
    size = np.abs(gyr)
    top = 1.011 * np.where(size < _WILD * limits, size, 0.0).max(axis=0, initial=0.0) + 1e-3
    flat = np.where(clipped, np.copysign(top, gyr), gyr)
    estimator = OrientationEstimator(params.replace(
        **{"mode": "smoothed", "sensor.gyro_range": tuple(float(v) for v in top)}))
    rows = np.concatenate([estimator.run(ImuLog(imu.stamp, flat, imu.acc), mag),
                           estimator.finish()])
    return rows, np.searchsorted(imu.stamp, rows["stamp"]), float(
        estimator.summary().get("mag_delay", 0.0))


def _step(rows):
    """Usual step, s."""
    return float(np.median(np.diff(rows["stamp"]))) * 1e-9


def _in_bursts(rows, missing, time):
    """(n, 3) rad/s, of rates that were recovered; ``time`` s, for which their errors last."""
    single = np.sqrt(rows["cov_gyr"].diagonal(0, 1, 2))
    attitude = np.sqrt(2.0 * rows["cov_attitude"].diagonal(0, 1, 2))
    step = _step(rows)
    together = np.sqrt(np.minimum(max(time / step, 1.0), np.maximum(_run_lengths(missing), 1.0)))
    return np.minimum(single * together, attitude / (step * together))


def _misaligned(rows, misalignment):
    """(n, 3) rad/s: what ``misalignment``, a standard deviation of off-diagonal entries of its
    matrix, adds to the rates of a gyroscope that turns. In half a turn it adds up to 2 / pi of
    what it would without turning."""
    gyr = rows["gyr"]
    square = np.sum(gyr ** 2, axis=1)[:, None]
    half_turn = np.pi / np.maximum(np.sqrt(square) * _step(rows), 1e-12)
    together = np.clip(half_turn, 1.0, len(rows))
    return 2.0 / np.pi * misalignment * np.sqrt((square - gyr ** 2) * together)


def _run_lengths(mask):
    """(n, k): length of the run of True that an element is in, 0 where False."""
    lengths = np.zeros(mask.shape)
    for column, out in zip(mask.T, lengths.T):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], column.astype(int), [0]])))
        for begin, end in edges.reshape(-1, 2):
            out[begin:end] = end - begin
    return lengths
