"""Orientation errors: hand-worked rotations, an independent oracle, honest covariances."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from imu_fusion.errors import SampleError
from imu_fusion.evaluation.orientation_error import (
    GAUSSIAN_SHARES,
    moving_at,
    orientation_errors,
    quaternions_at,
    shares_within,
    split_angles,
    statistics,
)
from imu_fusion.samples.logs import PoseLog

DEG = np.pi / 180


def pose_log(stamp, rotation):
    quat = rotation.as_quat() if isinstance(rotation, Rotation) else rotation
    return PoseLog(stamp=np.asarray(stamp, np.int64), quat_world_imu=quat,
                   position_world=np.zeros((len(stamp), 3)))


def test_pure_heading_and_pure_inclination_are_told_apart():
    error = Rotation.from_rotvec([[0, 0, 10 * DEG], [0, 0, -10 * DEG], [3 * DEG, 4 * DEG, 0]])
    total, heading, inclination = split_angles(error.as_quat())
    # 3-4-5: a horizontal axis with components 3 and 4 degrees turns by 5.
    np.testing.assert_allclose(total / DEG, [10, 10, 5], atol=1e-12)
    np.testing.assert_allclose(heading / DEG, [10, 10, 0], atol=1e-12)
    np.testing.assert_allclose(inclination / DEG, [0, 0, 5], atol=1e-12)


def test_angles_are_those_that_broad_prints_and_keep_their_digits():
    rng = np.random.default_rng(1)
    quat = Rotation.random(200, random_state=rng).as_quat()
    quat[::2] *= -1  # the same rotations
    total, heading, inclination = split_angles(quat)
    x, y, z, w = quat.T
    # atol: acos of a number near 1 loses half of the digits of float64.
    np.testing.assert_allclose(total, 2 * np.arccos(np.clip(np.abs(w), 0, 1)), atol=1e-7)
    np.testing.assert_allclose(heading, 2 * np.arctan(np.abs(z / w)), atol=1e-7)
    np.testing.assert_allclose(
        inclination, 2 * np.arccos(np.clip(np.sqrt(w * w + z * z), 0, 1)), atol=1e-7)
    tiny = Rotation.from_rotvec([[1e-9, 0, 0]]).as_quat()
    assert split_angles(tiny)[0][0] == pytest.approx(1e-9, rel=1e-9)


def test_the_error_is_taken_in_the_world_frame():
    """An estimate turned about the vertical has a heading error however the body lies."""
    rng = np.random.default_rng(2)
    truth = Rotation.random(50, random_state=rng)
    estimate = Rotation.from_rotvec([0, 0, 2 * DEG]) * truth
    stamp = np.arange(50) * 10
    errors = orientation_errors(stamp, estimate.as_quat(), pose_log(stamp, truth))
    np.testing.assert_allclose(errors.heading, 2 * DEG, atol=1e-12)
    np.testing.assert_allclose(errors.inclination, 0, atol=1e-12)
    np.testing.assert_allclose(errors.rotation_world, [[0, 0, 2 * DEG]] * 50, atol=1e-12)


def test_stated_covariance_is_judged_in_the_world_frame():
    """Errors drawn from an uneven local covariance are found within 1, 2, 3 sigma as often
    as a Gaussian says, with NEES 3; a covariance in the wrong frame would not do that."""
    rng = np.random.default_rng(3)
    n = 20000
    truth = Rotation.random(n, random_state=rng)
    sd = np.array([0.1, 0.5, 2.0]) * DEG
    local = rng.normal(size=(n, 3)) * sd
    estimate = truth * Rotation.from_rotvec(local).inv()  # q_true = q_est * Exp(dtheta)
    stamp = np.arange(n)
    cov = np.broadcast_to(np.diag(sd ** 2), (n, 3, 3))
    errors = orientation_errors(stamp, estimate.as_quat(), pose_log(stamp, truth), cov)
    shares = shares_within(errors)
    for name in ("tilt", "heading"):
        # Four standard deviations of a share of 20000 draws are below 0.014.
        np.testing.assert_allclose(shares[name], GAUSSIAN_SHARES, atol=0.014)
    # NEES is chi-square of 3: its mean over n has the standard deviation sqrt(6 / n) = 0.017.
    assert np.mean(errors.nees) == pytest.approx(3, abs=0.07)


def test_unknown_covariances_give_no_standard_deviation():
    cov = np.zeros((4, 3, 3))
    cov[1] = np.nan
    cov[2, 0, 0] = -1
    cov[3] = np.eye(3) * 4
    quat = np.tile([0.0, 0, 0, 1], (4, 1))
    errors = orientation_errors(np.arange(4), quat, pose_log(np.arange(4), quat), cov)
    assert np.isnan(errors.sd_world[:3]).all()
    np.testing.assert_allclose(errors.sd_world[3], 2)
    assert np.isnan(shares_within(orientation_errors(
        np.arange(4), quat, pose_log(np.arange(4), quat)))["tilt"]).all()


def test_reference_is_interpolated_like_slerp_and_gaps_are_not_bridged():
    rng = np.random.default_rng(4)
    ref_stamp = np.arange(20, dtype=np.int64) * 1000
    rotation = Rotation.random(20, random_state=rng)
    stamp = np.sort(rng.integers(0, 19000, 200))
    found = quaternions_at(stamp, ref_stamp, rotation.as_quat())
    expected = Slerp(ref_stamp, rotation)(stamp)
    difference = (Rotation.from_quat(found) * expected.inv()).magnitude()
    assert difference.max() < 1e-12

    keep = np.r_[0:5, 9:20]  # a gap from 4000 to 9000
    found = quaternions_at(stamp, ref_stamp[keep], rotation.as_quat()[keep])
    absent = (stamp > 4000) & (stamp < 9000)
    np.testing.assert_array_equal(np.isnan(found).any(axis=1), absent)
    outside = quaternions_at([-1, 19000, 19001], ref_stamp, rotation.as_quat())
    np.testing.assert_array_equal(np.isnan(outside).any(axis=1), [True, False, True])
    with_nan = rotation.as_quat()
    with_nan[5:9] = np.nan
    np.testing.assert_array_equal(quaternions_at(stamp, ref_stamp, with_nan), found)


def test_statistics_count_only_what_is_masked_and_referenced():
    angle = np.array([3.0, 4.0, 100.0, np.nan]) * DEG
    quat = np.array([Rotation.from_rotvec([a, 0, 0]).as_quat() if np.isfinite(a)
                     else [np.nan] * 4 for a in angle])
    reference = pose_log(np.arange(4), np.tile([0.0, 0, 0, 1], (4, 1)))
    errors = orientation_errors(np.arange(4), quat, reference)
    total, heading, inclination = statistics(errors, np.array([True, True, False, True]))
    assert (total.count, heading.count) == (2, 2)
    # sqrt((9 + 16) / 2)
    assert total.rmse_deg == pytest.approx(3.5355339, abs=1e-6)
    assert inclination.maximum_deg == pytest.approx(4)
    assert heading.rmse_deg == pytest.approx(0, abs=1e-9)
    assert statistics(errors, np.zeros(4, bool))[0].count == 0


def test_movement_mask_holds_each_value_until_the_next():
    moving = moving_at([0, 9, 10, 15, 20, 99], [10, 20], [True, False])
    np.testing.assert_array_equal(moving, [False, False, True, True, False, False])


def test_bad_input_is_refused():
    quat = np.tile([0.0, 0, 0, 1], (3, 1))
    with pytest.raises(SampleError, match="increase"):
        orientation_errors(np.arange(3), quat, pose_log([0, 2, 2], quat))
    with pytest.raises(SampleError, match="shape"):
        orientation_errors(np.arange(4), quat, pose_log([0, 1, 2], quat))
