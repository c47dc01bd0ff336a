"""Rates beyond the gyroscope's range, recovered from a whole recording, for who integrates them.

Winkler 2025 (appendix B) recovers them sample by sample from two differences of the field. The
error-state filter has them as states and solves a burst as a whole, with a covariance.
"""

import numpy as np

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.orientation.estimator import OrientationEstimator
from imu_fusion.estimation.orientation.gyro_limit import ranges_of
from imu_fusion.estimation.orientation.params import OrientationParams, kernel_parameters
from imu_fusion.estimation.orientation.rows import SATURATED_AXES_SHIFT
from imu_fusion.samples.logs import ImuLog, MagLog
from imu_fusion.sensors.saturation import BAND


def recover(imu: ImuLog, mag: MagLog | None, params: OrientationParams) -> ImuLog:
    """The log with recovered rates and their standard deviation ``gyr_sd``.

    The errors of a burst go together: n samples turn the body by n times the error of one, so that
    white noise which does as much has sqrt(n) times its standard deviation. Over a long burst the
    field holds the attitude: no more samples go together than turn the body by what its attitudes
    at two instants are unsure.

    While one axis is clipped, the others err, too: a calibration that mixes axes was applied to
    what had been clipped. That error stands still in the sensor, so that it goes together for as
    long as the body takes for half a turn.

    Args:
        imu, mag: the whole recording. params: of method fusion; mode and range are set here.

    Raises:
        EstimationError: no magnetometer, which is what shows the rates.
    """
    if mag is None or not len(mag):
        raise EstimationError("rates beyond the gyroscope's range are recovered from the "
                              "magnetometer, and there is none: leave recover_rates false")
    limits = (ranges_of(imu.gyr, kernel_parameters(params)) if params.sensor.gyro_range is None
              else np.broadcast_to(params.sensor.gyro_range, 3))
    # Behind a calibration what was clipped is no longer flat.
    at_limit = tuple(float(v) for v in np.where(np.isfinite(limits), (1.0 - BAND) * limits, 1e6))
    estimator = OrientationEstimator(params.replace(
        **{"mode": "smoothed", "sensor.gyro_range": at_limit}))
    rows = np.concatenate([estimator.run(imu, mag), estimator.finish()])
    missing = (rows["flags"][:, None] >> (SATURATED_AXES_SHIFT + np.arange(3))) & 1 == 1
    sd = np.where(missing, _in_bursts(rows, missing),
                  _beside_bursts(rows, missing, at_limit, params.sensor.gyro_scale_sd))
    return ImuLog(rows["stamp"], rows["gyr"], rows["acc"], imu.frame_id, sd)


def _step(rows):
    """Usual step, s."""
    return float(np.median(np.diff(rows["stamp"]))) * 1e-9


def _in_bursts(rows, missing):
    """(n, 3) rad/s, of rates that were recovered."""
    single = np.sqrt(rows["cov_gyr"].diagonal(0, 1, 2))
    attitude = np.sqrt(2.0 * rows["cov_attitude"].diagonal(0, 1, 2))
    together = np.maximum(attitude / np.maximum(single * _step(rows), 1e-12), 1.0)
    return single * np.sqrt(np.minimum(together, _run_lengths(missing)))


def _beside_bursts(rows, missing, limits, mixing):
    """(n, 3) rad/s, of rates that were measured while another axis was clipped; 0 where none was.

    limits: (3,) rad/s. mixing: standard deviation of the calibration's off-diagonal entries.
    """
    beyond = np.where(missing, np.abs(rows["gyr"]) - np.array(limits), 0.0)
    beyond = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)[:, None]
    rate = np.linalg.norm(rows["gyr"], axis=1)[:, None]
    half_turn = np.pi / np.maximum(rate * _step(rows), 1e-12)
    run = _run_lengths(missing.any(axis=1)[:, None])
    return mixing * beyond * np.sqrt(np.maximum(np.minimum(half_turn, run), 1.0)) * np.ones(3)


def _run_lengths(mask):
    """(n, k): length of the run of True that an element is in, 0 where False."""
    lengths = np.zeros(mask.shape)
    for column, out in zip(mask.T, lengths.T):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], column.astype(int), [0]])))
        for begin, end in edges.reshape(-1, 2):
            out[begin:end] = end - begin
    return lengths
