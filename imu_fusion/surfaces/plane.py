"""An inclined plane (Winkler et al. 2025, the slope of the avalanche track)."""

from dataclasses import dataclass

import numpy as np

from imu_fusion.errors import LayoutError
from imu_fusion.surfaces.constraint import Surface, height_constraint, split_sigma


@dataclass(frozen=True)
class Plane(Surface):
    """Plane through the origin, falling by ``slope_deg`` towards ``aspect_deg`` (clockwise
    from north)."""

    slope_deg: float = 0.0
    aspect_deg: float = 0.0
    sigma: float = 0.1

    def __post_init__(self):
        if not 0.0 <= self.slope_deg < 90.0:
            raise LayoutError(f"plane: slope_deg {self.slope_deg} is not in 0 to 90")

    def constraints(self):
        aspect = np.radians(self.aspect_deg)
        fall = np.tan(np.radians(self.slope_deg))
        de, dn = -fall * np.sin(aspect), -fall * np.cos(aspect)

        def elevation(east, north):
            return de * east + dn * north, np.full_like(east, de), np.full_like(east, dn)

        sigma = split_sigma(self.sigma, ["plane"])["plane"]
        return (height_constraint("plane", "always", sigma, elevation),)
