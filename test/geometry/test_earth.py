"""Geodesy, gravity and magnetic field against official values and independent formulas."""

from importlib.resources import files
from math import factorial

import numpy as np
import pytest
from scipy.special import lpmv

from imu_fusion.errors import ImuFusionError
from imu_fusion.geometry.geodesy import LocalFrame, hill_axes
from imu_fusion.geometry.gravity import earth_rate_world, gravity_world, normal_gravity
from imu_fusion.geometry.magnetic_field import decimal_year, declination, magnetic_field_world


def _ecef(latitude_deg, longitude_deg, height):
    """Textbook geodetic -> ECEF, independent of pymap3d."""
    a, f = 6378137.0, 1 / 298.257223563
    e2 = f * (2 - f)
    lat, lon = np.radians(latitude_deg), np.radians(longitude_deg)
    n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    return np.array([(n + height) * np.cos(lat) * np.cos(lon),
                     (n + height) * np.cos(lat) * np.sin(lon),
                     (n * (1 - e2) + height) * np.sin(lat)])


@pytest.mark.parametrize("lat, lon", [(47.4, 10.3), (-33.9, 151.2), (0.0, 179.9999)])
def test_local_frame_is_a_rigid_motion_of_ecef(lat, lon):
    frame = LocalFrame(lat, lon, 900.0)
    there = (lat + 0.01, lon + 0.02, 950.0)
    enu = frame.to_enu(*there)
    chord = np.linalg.norm(_ecef(*there) - _ecef(lat, lon, 900.0))
    assert abs(np.linalg.norm(enu) - chord) < 1e-6
    assert enu[0] > 0 and enu[1] > 0
    back = frame.to_geodetic(enu)
    assert abs(back[0] - there[0]) < 1e-11
    assert abs((back[1] - there[1] + 180.0) % 360.0 - 180.0) < 1e-11
    assert abs(back[2] - there[2]) < 1e-5


def test_axes_point_east_north_up():
    frame = LocalFrame(47.0, 10.0, 0.0)
    # A meridian arc of 1e-5 deg is 1.11 m, a parallel's is cos(lat) times as long.
    assert np.allclose(frame.to_enu(47.00001, 10.0, 0.0), [0, 1.1117, 0], atol=1e-3)
    assert np.allclose(frame.to_enu(47.0, 10.00001, 0.0), [0.7605, 0, 0], atol=1e-3)
    assert np.allclose(frame.to_enu(47.0, 10.0, 7.0), [0, 0, 7.0], atol=1e-8)


def test_hill_axes_follow_the_azimuth():
    r = hill_axes(90.0)  # a hill that looks east
    assert np.allclose(r @ [1, 0, 0], [1, 0, 0], atol=1e-15)   # east is forward
    assert np.allclose(r @ [0, 1, 0], [0, -1, 0], atol=1e-15)  # north is left
    assert np.allclose(r @ [0, 0, 1], [0, 0, -1], atol=1e-15)  # up is -z
    assert np.isclose(np.linalg.det(hill_axes(312.6)), 1.0)


def test_bad_origin_is_refused():
    with pytest.raises(ImuFusionError, match="latitude 95"):
        LocalFrame(95.0, 0.0, 0.0)


def test_gravity_at_equator_pole_and_the_hill_of_the_paper():
    # TR8350.2: 9.7803253359 at the equator, 9.8321849378 at the poles.
    assert abs(normal_gravity(0.0, 0.0) - 9.7803253359) < 1e-10
    assert abs(normal_gravity(90.0, 0.0) - 9.8321849378) < 1e-8
    # Fang 2020, section 4.1: 9.8053 (EGM96, about 900 m); the anomaly is some 1e-3.
    assert abs(normal_gravity(47.4, 950.0) - 9.8053) < 1e-3
    # Free-air gradient, 3.086e-6 /s^2.
    gradient = (normal_gravity(45.0, 100.0) - normal_gravity(45.0, 0.0)) / 100.0
    assert abs(gradient + 3.086e-6) < 2e-8


# Official WMM2025 test values: year, height km, lat, lon, X, Y, Z (nT, one decimal).
WMM2025 = [
    (2025.0, 0, 80, 0, 6521.6, 145.9, 54791.5),
    (2025.0, 0, 0, 120, 39677.8, -109.6, -10580.2),
    (2025.0, 0, -80, 240, 6117.5, 15751.9, -52022.5),
    (2025.0, 100, 80, 0, 6216.0, 92.4, 52598.8),
    (2025.0, 100, 0, 120, 37688.6, -96.2, -10152.1),
    (2025.0, 100, -80, 240, 5907.6, 14780.3, -49540.7),
]


@pytest.mark.parametrize("year, km, lat, lon, x, y, z", WMM2025)
def test_world_magnetic_model_official_values(year, km, lat, lon, x, y, z):
    field = magnetic_field_world(lat, lon, km * 1e3, year)
    # The official table is printed to 0.1 nT: half a digit and rounding.
    assert np.abs(field * 1e9 - [y, x, -z]).max() <= 0.051
    assert np.isclose(declination(lat, lon, km * 1e3, year), np.arctan2(y, x), atol=2e-5)


def _potential(ecef_km, year, coefficients):
    """Scalar potential (nT km) of the coefficients (n, m, g, h, dg, dh) at epoch 2025, from its
    definition with scipy's Legendre functions: shares no formula with pygeomag."""
    r = np.linalg.norm(ecef_km)
    sine, longitude = ecef_km[2] / r, np.arctan2(ecef_km[1], ecef_km[0])
    total = 0.0
    for n, m, g, h, dg, dh in coefficients:
        n, m, since = int(n), int(m), year - 2025.0
        # Schmidt's semi-normalisation; scipy has the Condon-Shortley phase, geomagnetism not.
        scale = (-1.0) ** m * np.sqrt((2.0 if m else 1.0) * factorial(n - m) / factorial(n + m))
        total += (6371.2 * (6371.2 / r) ** (n + 1) * scale * lpmv(m, n, sine)
                  * ((g + since * dg) * np.cos(m * longitude)
                     + (h + since * dh) * np.sin(m * longitude)))
    return total


@pytest.mark.parametrize("year, km, lat, lon", [
    (2025.0, 0.0, 80.0, 0.0), (2027.5, 0.9, 47.4, 10.3), (2029.9, 100.0, -80.0, 240.0),
    (2026.3, 2.0, -33.9, 151.2), (2028.0, 0.0, 0.0, 120.0)])
def test_world_magnetic_model_is_the_gradient_of_its_potential(year, km, lat, lon):
    """To 0.01 nT, finer than the official table is printed."""
    file = files("pygeomag") / "wmm" / "WMM_2025.COF"
    lines = [line.split() for line in file.read_text().splitlines()]
    coefficients = np.array([line for line in lines if len(line) == 6], dtype=float)
    assert len(coefficients) == 90
    place = _ecef(lat, lon, 1e3 * km) / 1e3
    step = 1.0   # km: the error of fourth order is (12 / 6371)^4 of the field, 1e-6 nT
    gradient = np.empty(3)
    for i, axis in enumerate(np.eye(3)):
        v = [_potential(place + k * step * axis, year, coefficients) for k in (-2, -1, 1, 2)]
        gradient[i] = (v[0] - 8.0 * v[1] + 8.0 * v[2] - v[3]) / (12.0 * step)
    phi, lam = np.radians([lat, lon])
    east = [-np.sin(lam), np.cos(lam), 0.0]
    north = [-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)]
    up = [np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)]
    expected = -np.array([east, north, up]) @ gradient
    field = magnetic_field_world(lat, lon, 1e3 * km, year) * 1e9
    assert np.abs(field - expected).max() < 0.01


def test_decimal_year_and_unknown_dates():
    assert decimal_year(0) == 1970.0
    assert abs(decimal_year(1_751_457_600 * 10**9) - 2025.5) < 1e-6  # 2025-07-02T12:00Z
    with pytest.raises(ImuFusionError, match="Unix time"):
        magnetic_field_world(47.0, 10.0, 0.0, decimal_year(0))


def test_plumb_line_turns_with_the_place():
    # Up at a place 5 km east: the ellipsoid normal there, in the axes of the origin.
    frame = LocalFrame(47.4, 10.3, 900.0)
    there = frame.to_geodetic(np.array([5000.0, 0.0, 0.0]))
    up = frame.to_enu(there[0], there[1], there[2] + 1.0) - [5000.0, 0.0, 0.0]
    g = gravity_world(np.array([5000.0, 0.0, 0.0]), 9.8)
    # The local radii of curvature differ from the mean radius by up to 0.7 %.
    assert np.allclose(-g / np.linalg.norm(g), up, atol=0.01 * 5000 / 6.37e6)
    higher = gravity_world(np.array([0.0, 0.0, 100.0]), 9.8)
    assert abs((higher[2] + 9.8) / 100.0 - 3.08e-6) < 2e-8  # free-air gradient


def test_earth_turns_east():
    # One turn per sidereal day of 86164.1 s; at the equator the axis points north.
    assert np.allclose(earth_rate_world(0.0) * 86164.1, [0, 2 * np.pi, 0], atol=1e-4)
    assert earth_rate_world(-90.0)[2] < 0
