"""An inclined plane (Winkler et al. 2025, the slope of the avalanche track)."""

from dataclasses import dataclass

import numpy as np

from imu_fusion.errors import LayoutError
from imu_fusion.surfaces.constraint import (
    DEFAULT_SIGMA,
    Constraint,
    Surface,
    height_constraint,
    split_sigma,
)
from imu_fusion.surfaces.values import number

PARTS = ("plane",)


@dataclass(frozen=True)
class Plane(Surface):
    """Plane through the origin, falling by ``slope_deg`` (0 to below 90) towards
    ``aspect_deg`` (clockwise from north).

    Raises:
        LayoutError: a value that is out of bounds or not finite.
    """

    slope_deg: float = 0.0
    aspect_deg: float = 0.0
    sigma: float | dict = DEFAULT_SIGMA

    def __post_init__(self) -> None:
        if number(self.slope_deg, "slope_deg", "deg", 0.0, 90.0) == 90.0:
            raise LayoutError("key 'slope_deg': a plane of 90 deg has no height above it")
        number(self.aspect_deg, "aspect_deg", "deg", -360.0, 360.0)
        split_sigma(self.sigma, PARTS)

    def constraints(self) -> tuple[Constraint, ...]:
        aspect = np.radians(self.aspect_deg)
        fall = np.tan(np.radians(self.slope_deg))
        de, dn = -fall * np.sin(aspect), -fall * np.cos(aspect)

        def elevation(east, north):
            return de * east + dn * north, np.full_like(east, de), np.full_like(east, dn)

        sigma = split_sigma(self.sigma, PARTS)["plane"]
        return (height_constraint("plane", "always", sigma, elevation),)
