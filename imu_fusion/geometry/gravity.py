"""Normal gravity of WGS84, closed form; gravity and Earth rotation in a local frame."""

import numpy as np

from imu_fusion.kernels import njit

# WGS84 (NIMA TR8350.2, 3rd edition, tables 3.1, 3.3 and 3.4).
_A = 6378137.0
_F = 1.0 / 298.257223563
_E2 = _F * (2.0 - _F)
_GAMMA_EQUATOR = 9.7803253359
_K = 0.00193185265241
_M = 0.00344978650684

_EARTH_RATE = 7.292115e-5  # rad/s, ibid. table 3.1

#: Mean radius of the ellipsoid, m.
MEAN_RADIUS = 6371008.8


def normal_gravity(latitude_deg: float, height: float) -> float:
    """Magnitude of normal gravity in m/s^2, positive.

    Somigliana's formula on the ellipsoid (TR8350.2, eq. 4-1), continued to the
    ellipsoidal height by the second-order series (eq. 4-3), good to 1e-6 m/s^2 below
    20 km. Real gravity differs by up to some 1e-3 m/s^2 (anomalies).

    Args:
        latitude_deg: geodetic latitude, degrees.
        height: ellipsoidal height, m.
    """
    s2 = np.sin(np.radians(latitude_deg)) ** 2
    surface = _GAMMA_EQUATOR * (1.0 + _K * s2) / np.sqrt(1.0 - _E2 * s2)
    h = height / _A
    return surface * (1.0 - 2.0 * (1.0 + _F + _M - 2.0 * _F * s2) * h + 3.0 * h * h)


def earth_rate_world(latitude_deg: float) -> np.ndarray:
    """Rotation of the Earth (3,) in rad/s, east-north-up."""
    latitude = np.radians(latitude_deg)
    return _EARTH_RATE * np.array([0.0, np.cos(latitude), np.sin(latitude)])


@njit
def gravity_world(position_world: np.ndarray, gravity: float) -> np.ndarray:
    """Gravity vector (3,) m/s^2, east-north-up, at a position near the origin.

    The tangent frame is flat and the Earth is not: 1 km away the plumb line has turned by
    0.16 mrad. First order in distance over Earth radius: good to 1e-6 of g within 10 km.

    Args:
        position_world: (3,) m.
        gravity: magnitude at the origin, m/s^2.
    """
    g = np.empty(3)
    g[0] = -gravity * position_world[0] / MEAN_RADIUS
    g[1] = -gravity * position_world[1] / MEAN_RADIUS
    g[2] = -gravity * (1.0 - 2.0 * position_world[2] / MEAN_RADIUS)
    return g
