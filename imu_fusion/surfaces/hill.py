"""A ski-jumping hill in the world: profiles of in-run and landing side, origin, azimuth."""

from dataclasses import dataclass

import numpy as np

from imu_fusion.geometry.geodesy import hill_axes
from imu_fusion.surfaces.constraint import DEFAULT_SIGMA, Constraint, Surface, split_sigma
from imu_fusion.surfaces.profile import Profile
from imu_fusion.surfaces.values import number

PARTS = ("in_run", "in_run_lateral", "landing")


@dataclass(frozen=True)
class Hill(Surface):
    """Origin at the edge of the take-off table; ``azimuth_deg`` is the direction of x,
    clockwise from north. ``k_point`` is (x of K, distance w): jump lengths are w plus the
    length of the landing profile from K.

    Raises:
        LayoutError: an azimuth or sigma that is out of bounds or not finite.
    """

    azimuth_deg: float
    in_run: Profile
    landing: Profile
    k_point: tuple[float, float]
    sigma: float | dict = DEFAULT_SIGMA

    def __post_init__(self) -> None:
        number(self.azimuth_deg, "azimuth_deg", "deg", -360.0, 360.0)
        split_sigma(self.sigma, PARTS)

    @property
    def axes(self) -> np.ndarray:
        """R_hill_world (3, 3)."""
        return hill_axes(self.azimuth_deg)

    def to_hill(self, vector_world: np.ndarray) -> np.ndarray:
        """Positions or vectors (..., 3) in the hill frame: x forward, y right, z down."""
        return np.asarray(vector_world) @ self.axes.T

    def to_world(self, vector_hill: np.ndarray) -> np.ndarray:
        """The inverse of :meth:`to_hill`."""
        return np.asarray(vector_hill) @ self.axes

    def jump_length(self, x: float) -> float:
        """Length of a jump that lands at x (scalar, m), along the profile as the markers lie."""
        x_k, w = self.k_point
        return w + self.landing.arc_length(x_k, float(x))

    def _vertical(self, profile):
        axes = self.axes

        def evaluate(position_world):
            x_hill, _, z_hill = (position_world @ axes.T).T
            z, slope, _ = profile(x_hill)
            # Height above the profile, Fang (32) and (34) with the sign turned upwards.
            return z - z_hill, slope[:, None] * axes[0] - axes[2]
        return evaluate

    def _lateral(self, position_world):
        axis = self.axes[1]
        return position_world @ axis, np.broadcast_to(axis, position_world.shape)

    def constraints(self) -> tuple[Constraint, ...]:
        sigma = split_sigma(self.sigma, PARTS)
        return (Constraint("in_run", "in_run", sigma["in_run"], True,
                           self._vertical(self.in_run)),
                Constraint("in_run_lateral", "in_run", sigma["in_run_lateral"], False,
                           self._lateral),
                Constraint("landing", "landing", sigma["landing"], True,
                           self._vertical(self.landing)))
