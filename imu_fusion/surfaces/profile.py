"""Curves z(x) of a hill's long section: x horizontal forward, z down, metres."""

import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.errors import LayoutError
from imu_fusion.surfaces.values import number

# What rounding may leave at a joint of analytic curves some 100 m in size.
_HEIGHT_TOLERANCE = 1e-6  # m
_SLOPE_TOLERANCE_DEG = 1e-4
_RADIUS_TOLERANCE = 1e-6  # of the radius; of a straight piece: 1 / m

#: x (any shape) -> z, dz/dx, d2z/dx2.
Curve = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Line:
    """Through (x0, z0) with a constant slope dz/dx."""

    x0: float
    z0: float
    slope: float

    def __call__(self, x):
        return self.z0 + self.slope * (x - self.x0), np.full_like(x, self.slope), np.zeros_like(x)


@dataclass(frozen=True)
class Arc:
    """Lower arc of a circle (concave upwards) that has the slope angle ``angle`` at (x0, z0)."""

    x0: float
    z0: float
    angle: float
    radius: float

    def at_angle(self, angle: float) -> tuple[float, float]:
        """The point (x, z) where the slope angle is ``angle``."""
        return (self.x0 + self.radius * (np.sin(self.angle) - np.sin(angle)),
                self.z0 - self.radius * (np.cos(self.angle) - np.cos(angle)))

    def __call__(self, x):
        u = x - self.x0 - self.radius * np.sin(self.angle)
        root = np.sqrt(self.radius ** 2 - u * u)
        return (self.z0 - self.radius * np.cos(self.angle) + root, -u / root,
                -self.radius ** 2 / root ** 3)


@dataclass(frozen=True)
class Polynomial:
    """Ascending coefficients in x - x0."""

    x0: float
    coefficients: tuple[float, ...]

    def __call__(self, x):
        p = np.polynomial.Polynomial(self.coefficients)
        return p(x - self.x0), p.deriv(1)(x - self.x0), p.deriv(2)(x - self.x0)


@dataclass(frozen=True)
class TiltedCubic:
    """``eta = c xi^3``: xi from (x0, z0) down a slope ``angle``, eta perpendicular, upwards."""

    x0: float
    z0: float
    angle: float
    c: float

    def __call__(self, x):
        s, k = np.sin(self.angle), np.cos(self.angle)
        # Cardano; x grows monotonically with xi, so there is one real root.
        p = k / (3.0 * self.c * s)
        q = (x - self.x0) / (2.0 * self.c * s)
        root = np.sqrt(q * q + p ** 3)
        xi = np.cbrt(root + q) - np.cbrt(root - q)
        slope_xi = 3.0 * self.c * xi * xi
        dx = k + slope_xi * s
        return (self.z0 + xi * s - self.c * xi ** 3 * k, (s - slope_xi * k) / dx,
                -6.0 * self.c * xi / dx ** 3)


@dataclass(frozen=True)
class TiltedParabola:
    """``eta = c xi^2`` in axes turned by ``tilt`` (z up, counter-clockwise), placed so that
    the point ``xi_start`` lies at (x0, z0)."""

    x0: float
    z0: float
    tilt: float
    c: float
    xi_start: float

    def offset(self, xi: Any) -> tuple[Any, Any]:
        """Horizontal and upward coordinates of the point xi, from the vertex."""
        s, k = np.sin(self.tilt), np.cos(self.tilt)
        return xi * k - self.c * xi * xi * s, xi * s + self.c * xi * xi * k

    def __call__(self, x):
        s, k = np.sin(self.tilt), np.cos(self.tilt)
        x_start, up_start = self.offset(self.xi_start)
        along = x - self.x0 + x_start
        xi = 2.0 * along / (k + np.sqrt(k * k - 4.0 * self.c * s * along))
        dx = k - 2.0 * self.c * xi * s
        up = self.offset(xi)[1]
        return (self.z0 - (up - up_start), -(s + 2.0 * self.c * xi * k) / dx,
                -2.0 * self.c / dx ** 3)


class Profile:
    """A curve in pieces: ``pieces[i]`` holds between ``knots[i - 1]`` and ``knots[i]``."""

    def __init__(self, knots: Sequence[float], pieces: Sequence[Curve]):
        self.knots = np.asarray(knots, dtype=float)
        self.pieces = tuple(pieces)
        if len(self.pieces) != len(self.knots) + 1 or np.any(np.diff(self.knots) <= 0):
            raise LayoutError(f"profile: joints must increase, are {self.knots.round(3).tolist()}")

    def __call__(self, x):
        """z, dz/dx and d2z/dx2 at x (any shape): (3, ...)."""
        x = np.asarray(x, dtype=float)
        piece = np.searchsorted(self.knots, x)
        result = np.empty((3, *x.shape))
        for i in np.unique(piece):
            here = piece == i
            result[:, here] = self.pieces[i](x[here])
        return result

    def check_joints(self, names: Sequence[str],
                     radii: Mapping[str, tuple[float | None, float | None]]) -> None:
        """Refuse a joint at which height or slope jumps or a radius is not the stated one.

        Args:
            names: of the joints, one per knot.
            radii: name -> (radius before, radius after), m; inf for straight, None for
                not stated.

        Raises:
            LayoutError: naming the joint and the two figures.
        """
        for i, (name, x) in enumerate(zip(names, self.knots)):
            sides = [np.ravel(piece(np.array([x]))) for piece in self.pieces[i:i + 2]]
            heights = [z for z, _, _ in sides]
            slopes = [np.degrees(np.arctan(slope)) for _, slope, _ in sides]
            # "not <=" refuses NaN as well.
            if not abs(heights[1] - heights[0]) <= _HEIGHT_TOLERANCE:
                raise LayoutError(f"joint {name} (x = {x:.3f} m): height z is {heights[0]:.6f} m "
                                  f"before and {heights[1]:.6f} m after it")
            if not abs(slopes[1] - slopes[0]) <= _SLOPE_TOLERANCE_DEG:
                raise LayoutError(f"joint {name} (x = {x:.3f} m): slope is {slopes[0]:.5f} deg "
                                  f"before and {slopes[1]:.5f} deg after it")
            for side, radius, (_, slope, second) in zip(
                    ("before", "after"), radii.get(name, (None, None)), sides):
                if radius is None:
                    continue
                curvature = -second / (1.0 + slope ** 2) ** 1.5  # concave upwards counts positive
                error = abs(curvature - 1.0 / radius) * (radius if np.isfinite(radius) else 1.0)
                if not error <= _RADIUS_TOLERANCE:
                    raise LayoutError(f"joint {name} (x = {x:.3f} m): curvature {side} it is "
                                      f"{curvature:.8f} 1/m, the stated radius is {radius:g} m")

    def arc_length(self, x0: float, x1: float) -> float:
        """Signed length of the curve from x0 to x1, m."""
        joints = self.knots[(self.knots > min(x0, x1)) & (self.knots < max(x0, x1))]
        return scipy.integrate.quad(
            lambda x: float(np.hypot(1.0, self(x)[1])), x0, x1,
            points=joints if len(joints) else None, limit=200)[0]


def table_points(points: Any, where: str) -> np.ndarray:
    """Surveyed points as an array (n, 2) of increasing x.

    Args:
        points: list of [x, z], m.
        where: name of the list, for messages.

    Raises:
        LayoutError: fewer than two points, no pairs, x not increasing, values not finite.
    """
    if not isinstance(points, (list, tuple, np.ndarray)) or len(points) < 2:
        raise LayoutError(f"key '{where}': expected a list of at least two [x, z]")
    table = np.empty((len(points), 2))
    for i, point in enumerate(points):
        if not isinstance(point, (list, tuple, np.ndarray)) or len(point) != 2:
            raise LayoutError(f"key '{where}', point {i + 1}: expected [x, z], is "
                              f"{reprlib.repr(point)}")
        table[i] = [number(value, f"{where}, point {i + 1}, {axis}", "m")
                    for axis, value in zip("xz", point)]
    back = np.flatnonzero(np.diff(table[:, 0]) <= 0)
    if len(back):
        i = back[0] + 1
        raise LayoutError(f"key '{where}': x must increase, point {i + 1} has {table[i, 0]:g} m "
                          f"after {table[i - 1, 0]:g} m")
    return table


def table_profile(points: Any, where: str) -> Profile:
    """Profile through surveyed points (n, 2) of increasing x: monotone cubics (PCHIP), whose
    slope is continuous and does not overshoot; straight beyond both ends.

    Raises:
        LayoutError: see :func:`table_points`.
    """
    points = table_points(points, where)
    curve = scipy.interpolate.PchipInterpolator(points[:, 0], points[:, 1])
    slope, curvature = curve.derivative(1), curve.derivative(2)
    (x0, z0), (x1, z1) = points[0], points[-1]
    return Profile([x0, x1], [Line(x0, z0, float(slope(x0))),
                              lambda x: (curve(x), slope(x), curvature(x)),
                              Line(x1, z1, float(slope(x1)))])
