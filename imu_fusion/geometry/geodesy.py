"""Local east-north-up coordinates of geodetic positions.

A :class:`LocalFrame` is a Cartesian frame touching WGS84 at its origin: exact
at any distance (pymap3d), unlike the series of Fang et al. (2020), eq. 27-29,
which err by 0.1 m at 1 km.
"""

from dataclasses import dataclass

import numpy as np
import pymap3d
from numpy.typing import ArrayLike

from imu_fusion.errors import SampleError


@dataclass(frozen=True)
class LocalFrame:
    """East-north-up frame with its origin at WGS84 latitude, longitude (degrees) and
    ellipsoidal height (m)."""

    latitude_deg: float
    longitude_deg: float
    height: float

    def __post_init__(self) -> None:
        if not (abs(self.latitude_deg) <= 90.0 and abs(self.longitude_deg) <= 360.0
                and np.isfinite(self.height)):
            raise SampleError(
                f"origin of the local frame: latitude {self.latitude_deg}, longitude "
                f"{self.longitude_deg} (degrees), height {self.height} m is not a place")

    def to_enu(self, latitude_deg: ArrayLike, longitude_deg: ArrayLike,
               height: ArrayLike) -> np.ndarray:
        """East, north, up (..., 3) m of geodetic positions (...)."""
        return np.stack(pymap3d.geodetic2enu(
            latitude_deg, longitude_deg, height,
            self.latitude_deg, self.longitude_deg, self.height), axis=-1)

    def to_geodetic(self, position_world: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Latitude_deg, longitude_deg, height (...) of east-north-up positions (..., 3) m."""
        p = np.asarray(position_world)
        return pymap3d.enu2geodetic(p[..., 0], p[..., 1], p[..., 2],
                                    self.latitude_deg, self.longitude_deg, self.height)


def hill_axes(azimuth_deg: float) -> np.ndarray:
    """Rotation R_hill_world (3, 3) from east-north-up to a hill frame: x horizontal along
    the azimuth (clockwise from north), z down, y to the right (Fang 2020, eq. 31, fig. 2)."""
    a = np.radians(azimuth_deg)
    return np.array([[np.sin(a), np.cos(a), 0.0],
                     [np.cos(a), -np.sin(a), 0.0],
                     [0.0, 0.0, -1.0]])
