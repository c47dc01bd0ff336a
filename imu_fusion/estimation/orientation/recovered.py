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
    white noise which does as much has sqrt(n) times its standard deviation.

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
    sd = np.sqrt(rows["cov_gyr"].diagonal(0, 1, 2)) * np.sqrt(_run_lengths(missing))
    return ImuLog(rows["stamp"], rows["gyr"], rows["acc"], imu.frame_id, sd)


def _run_lengths(mask):
    """(n, k): length of the run of True that an element is in, 0 where False."""
    lengths = np.zeros(mask.shape)
    for column, out in zip(mask.T, lengths.T):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], column.astype(int), [0]])))
        for begin, end in edges.reshape(-1, 2):
            out[begin:end] = end - begin
    return lengths
