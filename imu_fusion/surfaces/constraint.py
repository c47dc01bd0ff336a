"""What the smoother asks of a surface: rows ``0 = residual(position) + noise``."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_fusion.errors import LayoutError
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.surfaces.values import number

#: Parts of a motion during which a constraint may hold. ``always`` needs no event;
#: ``in_run`` ends with the take-off, ``landing`` begins with the touch-down.
PHASES = ("always", "in_run", "landing")

#: Standard deviation of a surface, m, where none is given (Fang 2020).
DEFAULT_SIGMA = 0.1


@dataclass(frozen=True)
class Constraint:
    """A soft constraint on the position.

    ``evaluate(position_world)`` takes (n, 3) m in the surface's own east-north-up frame
    and returns the residual (n,) m, NaN where it does not apply, and its gradient (n, 3).
    A residual that is a ``height`` is positive above the surface, and the body's height
    above the ground is taken from it. ``rough``: within what a position is unsure by, the surface
    may be anything but plane.
    """

    name: str
    phase: str
    sigma: float
    height: bool
    evaluate: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    rough: bool = False

    def __post_init__(self) -> None:
        if self.phase not in PHASES:
            raise LayoutError(f"constraint {self.name}: phase {self.phase!r}, known {PHASES}")
        if not 0 < self.sigma < np.inf:
            raise LayoutError(f"constraint {self.name}: sigma must be positive and finite, is "
                              f"{self.sigma} m")


@dataclass(frozen=True)
class Surface:
    """Base of the surfaces: an ``origin``, whose east-north-up frame is the surface's."""

    origin: LocalFrame

    def constraints(self) -> tuple[Constraint, ...]:
        """A tuple of :class:`Constraint`."""
        raise NotImplementedError


def split_sigma(sigma: Any, parts: Sequence[str]) -> dict[str, float]:
    """Standard deviation (m) of each part, from one number for all or a mapping of some of
    them; the others have :data:`DEFAULT_SIGMA`.

    Raises:
        LayoutError: an unknown part; no number, not finite, not positive.
    """
    if not isinstance(sigma, dict):
        return dict.fromkeys(parts, _positive(sigma, "sigma"))
    unknown = [repr(part) for part in sigma if part not in parts]
    if unknown:
        raise LayoutError(f"key 'sigma' names {', '.join(unknown)}; this surface has the parts "
                          + ", ".join(parts))
    return {part: _positive(sigma.get(part, DEFAULT_SIGMA), f"sigma.{part}") for part in parts}


def _positive(sigma, name):
    sigma = number(sigma, name, "m")
    if sigma <= 0:
        raise LayoutError(f"key '{name}': {sigma:g} m is not positive; it is a standard deviation")
    return sigma


def height_constraint(name: str, phase: str, sigma: float, elevation: Callable) -> Constraint:
    """Constraint of the height above ``elevation(east, north) -> z, dz/de, dz/dn``."""
    def evaluate(position_world):
        z, de, dn = elevation(position_world[:, 0], position_world[:, 1])
        gradient = np.stack([-de, -dn, np.ones_like(z)], axis=1)
        return position_world[:, 2] - z, gradient
    return Constraint(name, phase, sigma, True, evaluate)
