"""The slope frame, and rotation as seen in it: Winkler 2025, eqs. (22)-(24)."""

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.errors import LayoutError
from imu_fusion.surfaces.constraint import Surface


def slope_axes(secant: np.ndarray) -> np.ndarray:
    """Q_s of eq. (22): columns longitudinal, lateral, transverse, in world axes.

    The lateral axis is horizontal. As printed, ``e_z0 x e_x`` is shorter than one by the cosine of
    the inclination; here it has length one.

    Args:
        secant: (3,) down the slope, any length.
    """
    x = np.asarray(secant, dtype=float) / np.linalg.norm(secant)
    y = np.cross([0.0, 0.0, 1.0], x)
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


def fall_line(surface: Surface, position: np.ndarray, distance: float) -> np.ndarray:
    """The slope secant (3,) m of section 4.2.1: from the surface at a position to where the fall
    line there meets it again in a horizontal distance.

    Args:
        surface: with one height. position: (3,) m, in its frame. distance: m.

    Raises:
        LayoutError: a surface without a height, level ground, a place where it ends.
    """
    heights = [c for c in surface.constraints() if c.height]
    if len(heights) != 1:
        raise LayoutError(f"a slope frame needs a surface with one height; this one has "
                          f"{len(heights)}")
    place = np.asarray(position, dtype=float)
    above, gradient = heights[0].evaluate(place[None])
    down = gradient[0] * [1.0, 1.0, 0.0]
    steep = np.linalg.norm(down)
    if not steep > 1e-6:
        raise LayoutError("the surface is level at the start: there is no fall line")
    end = place + distance * down / steep
    above_end = heights[0].evaluate(end[None])[0]
    secant = end - place
    secant[2] = above[0] - above_end[0]
    if not np.isfinite(secant).all():
        raise LayoutError(f"the surface ends within {distance:g} m of the start")
    return secant


def rotation_vectors(quat: np.ndarray) -> np.ndarray:
    """Rotation vectors (n, 3) rad of ``R_n R_0^T``, eq. (23), in the axes of the attitudes.

    Continuous: of all vectors of a rotation, which differ by whole turns about its axis, the one
    nearest to that before.

    Args:
        quat: (n, 4) world from sensor.
    """
    attitude = scipy.spatial.transform.Rotation.from_quat(quat)
    vectors = (attitude * attitude[0].inv()).as_rotvec()
    for n in range(1, len(vectors)):
        size = np.linalg.norm(vectors[n])
        if size > 1e-9:
            axis = vectors[n] / size
            turns = np.round((vectors[n - 1] @ axis - size) / (2.0 * np.pi))
            vectors[n] += 2.0 * np.pi * turns * axis
        else:
            # A whole number of turns about an axis that only the one before tells.
            before = np.linalg.norm(vectors[n - 1])
            turns = np.round(before / (2.0 * np.pi))
            vectors[n] = 2.0 * np.pi * turns * vectors[n - 1] / max(before, 1e-9)
    return vectors


def turns(time: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Turns (n, 3) about each axis since the first sample: integrals of rates (n, 3) rad/s."""
    return scipy.integrate.cumulative_trapezoid(
        rate, time, axis=0, initial=0.0) / (2.0 * np.pi)
