"""All measurements of the smoother: the one place that lists them."""

from typing import Any

import numpy as np

from imu_fusion.estimation.smoother.measurements import (
    gnss_fix,
    gnss_moved_fix,
    gnss_velocity,
    magnetometer,
    rest,
)
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.records import READING
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.kernels import njit

#: Kinds of readings are indices into this.
MEASUREMENTS = (gnss_fix.MEASUREMENT, gnss_velocity.MEASUREMENT, magnetometer.MEASUREMENT,
                gnss_moved_fix.MEASUREMENT, rest.MEASUREMENT)
FIX, VELOCITY, MAG, MOVED_FIX, REST = range(len(MEASUREMENTS))

#: Name -> kind.
KINDS = {m.name: kind for kind, m in enumerate(MEASUREMENTS)}

#: Names of the states that are delays of stamps.
DELAYS = tuple(dict.fromkeys(name for m in MEASUREMENTS for name in m.delays))


@njit
def predict(kind, x, tau, step, model, rows):
    """What a reading of a kind should be (3,), and its derivative (3, n).

    Compiled code can hold no cheap list of functions, so this is one.

    Args:
        kind: index of MEASUREMENTS. x: state (n + 1,) of the sample. tau: s after it.
        step, model: records of STEP (the interval behind the sample) and MODEL.
        rows: record of ROWS, ``h`` zero; the result is in ``predicted`` and ``h``.
    """
    if kind == FIX:
        gnss_fix.predict(x, tau, step, model, rows)
    elif kind == VELOCITY:
        gnss_velocity.predict(x, tau, step, model, rows)
    elif kind == MAG:
        magnetometer.predict(x, tau, step, model, rows)
    elif kind == MOVED_FIX:
        gnss_moved_fix.predict(x, tau, step, model, rows)
    elif kind == REST:
        rest.predict(x, tau, step, model, rows)


def prepare_readings(logs: dict[str, Any], frame: LocalFrame, params: SmootherParams
                     ) -> np.ndarray:
    """Readings (m,) of records.READING that are fit for use, of all measurements in turn.

    Args:
        logs: by the name of the measurement, what it prepares; None: no such sensor.

    Raises:
        SampleError: covariances or stamps that cannot be.
    """
    parts = [np.empty(0, READING)]
    for kind, measurement in enumerate(MEASUREMENTS):
        log = logs.get(measurement.name)
        if log is not None:
            parts.append(measurement.prepare(log, frame, params).records(kind))
    return np.concatenate(parts)
