"""A hill from surveyed points (x, z): what a survey in the right frame must look like."""

from typing import Any

import numpy as np

from imu_fusion.errors import LayoutError
from imu_fusion.surfaces.fis_hill import W_BY_CHORD
from imu_fusion.surfaces.profile import Profile, table_points, table_profile
from imu_fusion.surfaces.values import number

EDGE_TOLERANCE = 0.1  # m, of the table edge: the origin is measured there
RISE_TOLERANCE = 0.5  # m: snow and survey are not perfectly smooth
STEEPEST_DEG = 60.0  # as for certificates; real hills stay below 40
W_TOLERANCE = 0.03  # of w: older norms measured it otherwise


def table_hill(in_run: Any, landing: Any, n: Any = None, w: Any = None
               ) -> tuple[Profile, Profile, tuple[float, float]]:
    """Profiles of in-run and landing side, and (n, w) of the K point; without one, (0, 0):
    lengths count along the profile from the foot of the table.

    Args:
        in_run, landing: lists of [x, z], m, in the hill frame: origin at the table edge,
            x forward and increasing, z down.
        n, w: horizontal distance (m) of the K point and its distance w (m); both or none.

    Raises:
        LayoutError: tables that are not of a hill in that frame, a K point off the table.
    """
    in_run, landing = table_points(in_run, "in_run"), table_points(landing, "landing")
    _check_slopes(in_run, "in_run")
    _check_slopes(landing, "landing")
    x, z = in_run[-1]
    if np.hypot(x, z) > EDGE_TOLERANCE:
        raise LayoutError(f"key 'in_run': the last point must be the table edge, the origin "
                          f"[0, 0] of both tables, but is [{x:g}, {z:g}]")
    above = in_run[:, 1] > EDGE_TOLERANCE
    _refuse_sign(in_run, above, "in_run", "above the edge, z is negative there")
    _check_falls(in_run, "in_run")
    if landing[-1, 0] <= 0:
        raise LayoutError(f"key 'landing': it must reach beyond the table edge, but ends at x = "
                          f"{landing[-1, 0]:g} m; x grows forwards")
    above = (landing[:, 0] >= 0) & (landing[:, 1] < -EDGE_TOLERANCE)
    _refuse_sign(landing, above, "landing", "below the edge, z is positive there")
    # Out-runs may end in a counter-slope: beyond the lowest point rising is legitimate.
    _check_falls(landing[:np.argmax(landing[:, 1]) + 1], "landing")
    profiles = table_profile(in_run, "in_run"), table_profile(landing, "landing")
    return *profiles, _k_point(landing, profiles[1], n, w)


def _k_point(landing, profile, n, w):
    if n is None and w is None:
        return 0.0, 0.0
    if n is None or w is None:
        given, missing = ("n", "w") if w is None else ("w", "n")
        raise LayoutError(f"key '{given}' is given without '{missing}': the K point needs its "
                          "horizontal distance n and its distance w, or leave out both")
    n, w = number(n, "n", "m", low=1.0), number(w, "w", "m", low=1.0)
    if not landing[0, 0] <= n <= landing[-1, 0]:
        raise LayoutError(f"key 'n': {n:g} m lies beyond the landing table, x = "
                          f"{landing[0, 0]:g} to {landing[-1, 0]:g} m")
    h = float(profile(n)[0])
    chord_w = W_BY_CHORD * np.hypot(n, h)
    if abs(chord_w - w) > W_TOLERANCE * w:
        raise LayoutError(f"keys 'n' and 'w': at n = {n:g} m the landing table lies {h:.2f} m "
                          f"below the edge, so w = {chord_w:.1f} m ({W_BY_CHORD} of the chord), "
                          f"but {w:g} m are stated")
    return n, w


def _refuse_sign(points, wrong, name, where):
    if wrong.any():
        i = int(np.argmax(wrong))
        raise LayoutError(f"key '{name}': z points down, so {where}; point {i + 1} is "
                          f"[{points[i, 0]:g}, {points[i, 1]:g}]")


def _check_slopes(points, name):
    slope = np.degrees(np.arctan2(*np.diff(points, axis=0).T[::-1]))
    i = int(np.argmax(np.abs(slope)))
    if abs(slope[i]) > STEEPEST_DEG:
        raise LayoutError(f"key '{name}': {slope[i]:.0f} deg between the points {i + 1} and "
                          f"{i + 2}, hills stay within {STEEPEST_DEG:g} deg: a wrong unit or a "
                          "misread point")


def _check_falls(points, name):
    """Refuse a slope that does not fall (z grows downwards) or rises on its way."""
    z = points[:, 1]
    if z[-1] <= z[0]:
        raise LayoutError(f"key '{name}': it must fall forwards, but z (down) goes from {z[0]:g} "
                          f"to {z[-1]:g} m")
    rise = np.maximum.accumulate(z) - z
    i = int(np.argmax(rise))
    if rise[i] > RISE_TOLERANCE:
        raise LayoutError(f"key '{name}': it rises by {rise[i]:.2f} m on its way down, at point "
                          f"{i + 1}, [{points[i, 0]:g}, {z[i]:g}]")
