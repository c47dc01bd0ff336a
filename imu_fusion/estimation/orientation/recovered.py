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
_HARDER = (3.0, 10.0)   # times fusion.angular_acc_sd, that all is recovered with again
_APART = 1.0   # rad in a burst, by which two of these differ: turns too many or too few


class Recovered(NamedTuple):
    """``imu`` with recovered rates and their standard deviation ``gyr_sd``; ``mag``, earlier by
    ``mag_lag`` s, where it was that much later than the rates (0: not, or by little); ``lost``,
    stamps (ns) of bursts whose rates hang on how hard blows are said to be."""

    imu: ImuLog
    mag: MagLog
    mag_lag: float
    lost: tuple[int, ...]


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

    The field is blind to a turn about it, and a blow that changes the spin faster than
    ``fusion.angular_acc_sd`` says is explained by turns that never were. So all is recovered with
    three times as much, too: what is taken must not hang on that. Where it still does with ten
    times as much, rates are as unsure as these differ.

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
    rows, used, lag = _unmixed(imu, mag, tops, limits, params)
    missing, apart = tops.clipped[used], np.zeros_like(rows["gyr"])
    bursts = _bursts(missing.any(axis=1))
    lost: list[slice] = []
    for harder in _HARDER if bursts else ():
        other = _unmixed(imu, mag, tops, limits, params.replace(
            **{"fusion.angular_acc_sd": harder * params.fusion.angular_acc_sd}))
        apart = other[0]["gyr"] - rows["gyr"]
        lost = [burst for burst in bursts if _turn(apart[burst]) * _step(rows) > _APART]
        if not lost:
            break
        if harder < _HARDER[-1]:
            rows, used, lag = other
    recovered = np.where(missing, _in_bursts(rows, missing, params.fusion.angular_acc_time), 0.0)
    mixed_in = recovered @ np.abs(mixing).T
    sd = np.hypot(np.where(missing, recovered, mixed_in),
                  _misaligned(rows, params.sensor.gyro_scale_sd))
    lag = lag if abs(lag) > _LATE else 0.0
    for burst in lost:
        sd[burst] = np.maximum(sd[burst], np.abs(apart[burst]))
    return Recovered(ImuLog(rows["stamp"], rows["gyr"], rows["acc"], imu.frame_id, sd),
                     replace(mag, stamp=mag.stamp - np.int64(round(lag * 1e9))), lag,
                     tuple(int(rows["stamp"][burst.start]) for burst in lost))


def _turn(rates):
    """The largest sum of rates (n, 3) up to any of them."""
    return float(np.linalg.norm(np.cumsum(rates, axis=0), axis=1).max())


def _unmixed(imu, mag, tops, limits, params):
    """:func:`_fused` of rates into which what was missing of others is mixed."""
    rows, used, lag = _fused(imu, mag, imu.gyr, tops.clipped, limits, params)
    if not tops.known.any():
        return rows, used, lag
    mixed = imu.gyr.copy()
    mixed[used] += np.where(tops.clipped[used], rows["gyr"] - tops.seen[used], 0.0) @ (
        tops.matrix - np.eye(3)).T
    return _fused(imu, mag, mixed, tops.clipped, limits, params)


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
        for run in _bursts(column):
            out[run] = run.stop - run.start
    return lengths


def _bursts(mask):
    """Slices of the runs of True in a mask (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [slice(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]
