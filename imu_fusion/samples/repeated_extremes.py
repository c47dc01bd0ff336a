"""The range of a sensor that is left for single samples: blows, which end before a flat top is one.

A converter gives its largest value for all that lies beyond. Where the largest values of an axis
are equal far more often than those just below let expect, that is the end of the range.
"""

import numpy as np

from imu_fusion.samples.equal_runs import equal_runs
from imu_fusion.samples.flat_tops import LIMIT_TOLERANCE

_FEWEST = 3          # equal extremes
_BELOW = 0.1         # of the largest value: what is just below
_BEYOND_CHANCE = 20.0   # times as often as the values below let expect
_COARSEST = 1e-3     # of the largest value: a step that is one of the converter
_ALIKE = 0.01        # of a limit: by how much those of the axes of one sensor differ


def range_shown(values: np.ndarray, floor: float) -> np.ndarray:
    """Ranges (3,) of the axes of a sensor, infinite where nothing shows one. An axis that reaches
    the range of another one and does not pass it has the same.

    Args:
        values: (n, 3). floor: no sensor has a smaller range.
    """
    size = np.abs(values[equal_runs(values)[0]])
    limits = np.array([_shown(column, floor) for column in size.T])
    largest = size.max(axis=0, initial=0.0)
    if np.isfinite(limits).any():
        shared = limits[np.isfinite(limits)].min()
        alike = np.isinf(limits) & (np.abs(largest / shared - 1.0) < _ALIKE)
        limits[alike] = largest[alike]
    return limits


def _shown(size, floor):
    """Of one axis, sizes (n,)."""
    largest = size.max(initial=0.0)
    near = np.sort(size[size > (1.0 - _BELOW) * largest])
    if largest <= floor or len(near) < _FEWEST:
        return np.inf
    # The two ends of a range differ by a step of the converter.
    steps = np.diff(near)
    step = 1.5 * float(steps[steps > 1e-9 * largest].min(initial=0.0))
    quantum = max(LIMIT_TOLERANCE * largest, min(step, _COARSEST * largest))
    at = np.count_nonzero(near >= largest - quantum)
    by_chance = (len(near) - at + 1) * quantum / (_BELOW * largest)
    return float(largest) if at >= _FEWEST and at - 1 > _BEYOND_CHANCE * by_chance else np.inf
