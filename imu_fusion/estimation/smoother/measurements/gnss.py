"""What fixes and velocities of a receiver have in common: stamps, covariances, an antenna."""

import numpy as np

from imu_fusion.errors import SampleError
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.state import GYR_BIAS, slow
from imu_fusion.kernels import njit
from imu_fusion.samples.logs import FixLog, VelocityLog

# Stamps are predicted from the line so far, which a single stamp may move by this share of its
# deviation: jitter averages over some ten stamps, and a drift of the rate is followed.
_FOLLOW = 0.1
# Steps over which the period is taken, so that jitter of a part of a period hardly counts.
_LAG = 10


def roots(given: np.ndarray, default_sd: tuple[float, ...], params: SmootherParams, what: str
          ) -> np.ndarray:
    """Lower roots (m, 3, 3) of covariances: of the default where they are all zeros or not to be
    taken.

    Args:
        given: (m, 3, 3). default_sd: (3,). what: of the readings, for the message.

    Raises:
        SampleError: a covariance that is not positive definite.
    """
    cov = given.copy()
    # The paper's method has covariances of its own.
    believed = params.gnss.covariances and params.method != "extended_rts"
    unknown = ~np.any(cov, axis=(1, 2)) | (not believed)
    cov[unknown] = np.diag(np.square(default_sd))
    try:
        return np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        raise SampleError(f"a covariance of {what} is not positive definite (gnss.covariances: "
                          "false takes those of the parameters instead)") from None


def even_stamps(stamp: np.ndarray) -> np.ndarray:
    """Stamps on a straight line through those of readings taken at an even rate.

    A logger stamps a fix when it arrives; the receiver takes it at its own even epochs.

    Args:
        stamp: (m,) ns, ascending; epochs may be missing.

    Returns:
        (m,) ns. The mean lateness stays: it is the constant delay of the receiver.

    Raises:
        SampleError: a stamp lies half a period or more off the line.
    """
    if len(stamp) < 3:
        return stamp
    seconds = (stamp - stamp[0]) * 1e-9
    # A mean of the shorter half of the steps would be biased; jitter cancels over many steps.
    lag = min(_LAG, len(stamp) - 1)
    period = float(np.median(seconds[lag:] - seconds[:-lag])) / lag
    epoch = np.empty(len(stamp))
    count, line = 0, 0.0
    for i, late in enumerate(seconds):
        count += max(1, round((late - line) / period)) if i else 0
        # The line follows slowly, since a single stamp jitters.
        expected = late if not i else line + (count - epoch[i - 1]) * period
        line = expected + _FOLLOW * (late - expected)
        epoch[i] = count
    slope, start = np.polyfit(epoch, seconds, 1)
    even = start + slope * epoch
    off = float(np.abs(even - seconds).max())
    if off >= 0.5 * slope:
        raise SampleError(f"GNSS stamps lie up to {off:.2f} s off even steps of {slope:.3f} s: "
                          "they are not taken at an even rate (gnss.even_stamps: false)")
    return stamp[0] + np.round(even * 1e9).astype(np.int64)


def spaced(stamp: np.ndarray, interval: float) -> np.ndarray:
    """Mask (m,) of readings that follow the last one taken by at least ``interval`` s.

    stamp: (m,) ns, ascending. The first reading is taken.
    """
    step = round(interval * 1e9)
    keep = np.zeros(len(stamp), bool)
    i = 0
    while i < len(stamp):
        keep[i] = True
        i = max(i + 1, int(np.searchsorted(stamp, stamp[i] + step)))
    return keep


def chosen(log: FixLog | VelocityLog, params: SmootherParams) -> tuple:
    """Those readings of a log that are to be used, and their stamps (m,) ns."""
    stamp = even_stamps(log.stamp) if params.gnss.even_stamps else log.stamp
    keep = spaced(stamp, params.gnss.min_interval)
    return log[keep], stamp[keep]


@njit
def vector(v):
    """An array (3,) as a tuple."""
    return v[0], v[1], v[2]


@njit
def put_gyr_scale(x, rate, blocks, h):
    """Columns of the gyroscope's scale in h (3, n), while those of its bias hold what the rate
    alone does: the scale enters the rate with the other sign, times the reading."""
    if blocks.gyr_scale >= 0:
        for j in range(3):
            # The reading that gave the rate, but for the Earth's (7e-5 rad/s).
            gyr = (rate[j] + slow(x, GYR_BIAS + j)) / (1.0 + slow(x, blocks.gyr_scale + j))
            for i in range(3):
                h[i, blocks.gyr_scale + j] = -gyr * h[i, GYR_BIAS + j]
