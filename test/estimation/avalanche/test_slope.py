"""The slope frame, twists, the field, and motion between rests."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.errors import EstimationError, LayoutError
from imu_fusion.estimation.avalanche.field_check import check_field
from imu_fusion.estimation.avalanche.slope import fall_line, rotation_vectors, slope_axes, turns
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.logs import ImuLog
from imu_fusion.samples.motion_span import find_motion
from imu_fusion.surfaces.plane import Plane

ORIGIN = LocalFrame(46.7486, 9.9451, 2600.0)


def test_axes_of_a_plane():
    """32 deg to the north-east: down there, along the contour line to the left, out of the snow."""
    plane = Plane(ORIGIN, slope_deg=32.0, aspect_deg=45.0)
    q = slope_axes(fall_line(plane, np.array([3.0, -1.0, 7.0]), 120.0))
    assert q.T @ q == pytest.approx(np.eye(3), abs=1e-12)
    cosine, sine, half = np.cos(np.radians(32.0)), np.sin(np.radians(32.0)), np.sqrt(0.5)
    assert q[:, 0] == pytest.approx([cosine * half, cosine * half, -sine])
    assert q[:, 1] == pytest.approx([-half, half, 0.0])
    assert q[:, 2] == pytest.approx([sine * half, sine * half, cosine])


def test_no_slope_is_refused():
    with pytest.raises(LayoutError, match="level"):
        fall_line(Plane(ORIGIN, slope_deg=0.0), np.zeros(3), 120.0)


def test_four_twists_are_not_lost():
    """A rotation vector that is wrapped knows at most half a turn."""
    time = np.linspace(0.0, 3.2, 481)
    axis = np.array([0.6, 0.0, 0.8])
    angle = 8 * np.pi * (time / 3.2) ** 2
    tilt = Rotation.from_rotvec([0.2, -0.4, 0.1])
    quat = (Rotation.from_rotvec(angle[:, None] * axis) * tilt).as_quat()
    assert rotation_vectors(quat) == pytest.approx(angle[:, None] * axis, abs=1e-9)
    rate = np.gradient(angle, time)[:, None] * axis
    assert turns(time, rate)[-1] == pytest.approx(4.0 * axis, rel=1e-3)


def test_the_field_check_is_blind_about_the_field():
    """A rotation by 13.7 deg about it goes unseen; one about any other axis does not."""
    rng = np.random.default_rng(1)
    field = 48e-6 * np.array([0.0, np.cos(1.1), -np.sin(1.1)])
    true = Rotation.random(500, random_state=rng)
    mag = true.inv().apply(field) + 2e-7 * rng.standard_normal((500, 3))
    growing = np.linspace(0.0, np.radians(13.7), 500)[:, None]

    def check(axis):
        return check_field((Rotation.from_rotvec(growing * axis) * true).as_quat(), mag)

    good = check_field(true.as_quat(), mag)
    blind = check(field / np.linalg.norm(field))
    assert np.degrees(1.1) == pytest.approx(good.inclination_deg, abs=0.05)
    assert blind.inclination_sd_deg == pytest.approx(good.inclination_sd_deg, rel=0.1)
    assert blind.declination_sd_deg == pytest.approx(good.declination_sd_deg, rel=0.1)
    assert check(np.array([1.0, 0.0, 0.0])).inclination_sd_deg > 10 * good.inclination_sd_deg
    assert good.norm == pytest.approx(48e-6, rel=1e-3) and good.norm_sd < 3e-7


def motion_between_rests(seed=0):
    """Carried to the slope, put down, 5 s of rest, an avalanche of 8 s, rest, dug out."""
    rng = np.random.default_rng(seed)
    n = 30 * 150
    gyr = 0.0105 * rng.standard_normal((n, 3)) + [0.02, -0.01, 0.005]
    acc = 0.34 * rng.standard_normal((n, 3)) + [0.0, 0.0, 9.8]
    for begin, end, rate, force in ((0, 4, 1.0, 4.0), (9, 17, 5.0, 30.0), (25, 28, 2.0, 8.0)):
        part = slice(begin * 150, end * 150)
        count = (end - begin) * 150
        gyr[part] += rate * np.sin(0.11 * np.arange(count))[:, None]
        acc[part] += force * np.sin(0.13 * np.arange(count))[:, None] * [1.0, -1.0, 1.0]
    return ImuLog(np.arange(n) * 10**9 // 150, gyr, acc)


@pytest.mark.parametrize("seed", range(5))
def test_the_avalanche_is_the_most_violent_motion(seed):
    found = find_motion(motion_between_rests(seed))
    assert abs(found.start / 150.0 - 9.0) < 0.03
    assert abs(found.stop / 150.0 - 17.0) < 0.2
    assert found.rest_start / 150.0 > 4.0
    assert found.gyr_bias == pytest.approx([0.02, -0.01, 0.005], abs=3e-3)


def test_without_rest_or_motion_there_is_no_start():
    log = motion_between_rests()
    with pytest.raises(EstimationError, match="no rest"):
        find_motion(log[10 * 150:16 * 150])
    with pytest.raises(EstimationError, match="nothing but rest"):
        find_motion(log[5 * 150:8 * 150])
