"""What the smoother asks of a surface: rows ``0 = residual(position) + noise``."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from imu_fusion.errors import LayoutError
from imu_fusion.geometry.geodesy import LocalFrame

#: Parts of a motion during which a constraint may hold. ``always`` needs no event;
#: ``in_run`` ends with the take-off, ``landing`` begins with the touch-down.
PHASES = ("always", "in_run", "landing")


@dataclass(frozen=True)
class Constraint:
    """A soft constraint on the position.

    ``evaluate(position_world)`` takes (n, 3) m in the surface's own east-north-up frame
    and returns the residual (n,) m, NaN where it does not apply, and its gradient (n, 3).
    A residual that is a ``height`` is positive above the surface, and the body's height
    above the ground is taken from it.
    """

    name: str
    phase: str
    sigma: float
    height: bool
    evaluate: Callable

    def __post_init__(self):
        if self.phase not in PHASES:
            raise LayoutError(f"constraint {self.name}: phase {self.phase!r}, known {PHASES}")
        if not self.sigma > 0:
            raise LayoutError(f"constraint {self.name}: sigma must be positive, is {self.sigma} m")


@dataclass(frozen=True)
class Surface:
    """Base of the surfaces: an ``origin``, whose east-north-up frame is the surface's."""

    origin: LocalFrame

    def constraints(self):
        """A tuple of :class:`Constraint`."""
        raise NotImplementedError


def split_sigma(sigma, parts):
    """Standard deviation of each part, from one number for all or a mapping.

    Raises:
        LayoutError: an unknown part.
    """
    if not isinstance(sigma, dict):
        return {part: float(sigma) for part in parts}
    unknown = set(sigma) - set(parts)
    if unknown:
        raise LayoutError(f"sigma names {sorted(unknown)}; this surface has {list(parts)}")
    return {part: float(sigma.get(part, 0.1)) for part in parts}


def height_constraint(name, phase, sigma, elevation):
    """Constraint of the height above ``elevation(east, north) -> z, dz/de, dz/dn``."""
    def evaluate(position_world):
        z, de, dn = elevation(position_world[:, 0], position_world[:, 1])
        gradient = np.stack([-de, -dn, np.ones_like(z)], axis=1)
        return position_world[:, 2] - z, gradient
    return Constraint(name, phase, sigma, True, evaluate)
