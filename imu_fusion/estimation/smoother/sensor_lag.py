"""Whether the magnetometer is of another time than the gyroscope, from what is left of its samples.

A sample that is late by d is that of d s before: it leaves -d times its own rate of change. Which
of the two sensors it is that is late, forces and the receiver tell.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from imu_fusion.samples.logs import ImuLog, MagLog, seconds

_LARGEST = 6.0     # standard deviations, to which what is left is cut: outliers are no lag
_LATE = 0.02       # s: less is a matter of filters
_SURE = 5.0       # standard deviations: iron leaves what no noise does
_FEWEST = 100      # samples


def field_lag(stamp: np.ndarray, predicted: np.ndarray, residual: np.ndarray, known: bool = False
              ) -> float:
    """Seconds by which a magnetometer is later than the attitudes; 0: not told, or little.

    Args:
        stamp: (m,) ns. predicted: (m, 3) of its samples, in standard deviations.
        residual: (m, 3), likewise. known: whether there is a lag, of which this is the rest.
    """
    if len(stamp) < _FEWEST or np.any(np.diff(stamp) <= 0):
        return 0.0
    change = np.gradient(predicted, seconds(stamp, stamp[0]), axis=0)
    sd = 1.0 / np.sqrt(max(float(np.sum(change ** 2)), 1e-9))
    left = np.clip(residual, -_LARGEST, _LARGEST)
    lag = -float(np.sum(left * change)) * sd ** 2
    return lag if abs(lag) > (sd if known else max(_LATE, _SURE * sd)) else 0.0


def in_time(imu: ImuLog, mag: MagLog | None, late: Mapping[str, float]
            ) -> tuple[ImuLog, MagLog | None]:
    """Logs with rates ("gyr") and magnetometer samples ("mag") that are earlier by so many s."""
    if late.get("gyr"):
        at = seconds(imu.stamp, imu.stamp[0])
        imu = replace(imu, gyr=np.column_stack([np.interp(at + late["gyr"], at, c)
                                                for c in imu.gyr.T]))
    if late.get("mag") and mag is not None:
        mag = replace(mag, stamp=mag.stamp - np.int64(round(late["mag"] * 1e9)))
    return imu, mag
