"""Which samples of a magnetometer are at the end of its range, apart from an orientation."""

import numpy as np

from imu_fusion.estimation.orientation.mag_rejection import TOLERANCE, are_saturated
from imu_fusion.estimation.orientation.params import OrientationParams, kernel_parameters
from imu_fusion.estimation.orientation.state import MAG_LIMIT


class MagScreen:
    """Takes the samples of one magnetometer, block by block, and learns its range if that is not
    given: see :mod:`imu_fusion.estimation.orientation.mag_rejection`."""

    def __init__(self, params: OrientationParams) -> None:
        self._par = kernel_parameters(params)
        self._found = np.zeros(1, MAG_LIMIT)

    def saturated(self, mag: np.ndarray) -> np.ndarray:
        """Mask (m,) of samples (m, 3) tesla, as the sensor reports them, in order of arrival."""
        return np.asarray(are_saturated(self._found, self._par, np.ascontiguousarray(mag)))

    @property
    def limit(self) -> np.ndarray:
        """(3,) tesla from which on a value is at its limit: given, found so far, or inf."""
        given, found = self._par["sensor"]["mag_range"][0], self._found[0]
        slack = np.minimum(1.5 * found["step"], TOLERANCE * found["limit"])
        return np.where(np.isnan(given),
                        np.where(found["limit"] > 0.0, found["limit"] - slack, np.inf), given)
