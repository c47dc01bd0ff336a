"""Which samples of a magnetometer are at the end of its range, apart from an orientation."""

import numpy as np

from imu_fusion.estimation.orientation.mag_rejection import are_saturated, new_limit
from imu_fusion.estimation.orientation.params import OrientationParams, kernel_parameters


class MagScreen:
    """Takes the samples of one magnetometer, block by block, and learns its range if that is not
    given: see :mod:`imu_fusion.estimation.orientation.mag_rejection`."""

    def __init__(self, params: OrientationParams) -> None:
        self._par = kernel_parameters(params)
        self._found = new_limit(self._par)

    def saturated(self, mag: np.ndarray) -> np.ndarray:
        """Mask (m,) of samples (m, 3) tesla, as the sensor reports them, in order of arrival."""
        return np.asarray(are_saturated(self._found, self._par, np.ascontiguousarray(mag)))

    @property
    def limit(self) -> np.ndarray:
        """(3,) tesla from which on a value is at its limit: given, found so far, or inf."""
        found = self._found[0]
        return np.asarray(found["limit"] * (1.0 - found["tolerance"]))
