"""Samples and estimates through messages and back."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.errors import TopicError
from imu_fusion.estimation.orientation.rows import ORIENTATION_DTYPE
from imu_fusion.messages import convert
from imu_fusion.messages.layouts import FIX, IMU, POSE, TWIST
from imu_fusion.messages.typestore import TYPES

STAMP = 1_700_000_123_456_789_012


def test_orientation_covariance_is_about_world_axes_in_the_message():
    """A sensor with x up (pitch -90 deg) that is unsure about its own x is unsure of yaw."""
    rows = np.zeros(1, ORIENTATION_DTYPE)
    row = rows[0]
    row["stamp"] = STAMP
    row["quat_world_imu"] = Rotation.from_euler("y", -90, degrees=True).as_quat()
    row["cov_attitude"] = np.diag([4.0, 1.0, 1.0])
    row["gyr"], row["acc"] = (1, 2, 3), (4, 5, 6)
    (cdr,) = convert.orientation_messages(rows, "ball", np.array([True]))
    message = TYPES.deserialize_cdr(cdr, IMU.msgtype)
    np.testing.assert_allclose(message.orientation_covariance.reshape(3, 3),
                               np.diag([1.0, 1.0, 4.0]), atol=1e-15)
    assert (message.angular_velocity.y, message.linear_acceleration.z) == (2.0, 6.0)
    log = convert.attitude_log([cdr])
    np.testing.assert_allclose(log.cov_attitude[0], row["cov_attitude"], atol=1e-15)
    assert log.stamp[0] == STAMP and log.frame_id == "ball"


def test_raw_imu_says_that_orientation_is_absent():
    cdr = convert.imu_message(STAMP, "imu_link", [1, 2, 3], None)
    message = TYPES.deserialize_cdr(cdr, IMU.msgtype)
    assert message.orientation_covariance[0] == -1.0
    assert message.linear_acceleration_covariance[0] == -1.0
    assert message.angular_velocity_covariance[0] == 0.0
    log = convert.SAMPLE_TYPES[IMU.msgtype].read([cdr])
    assert np.isnan(log.acc).all() and list(log.gyr[0]) == [1, 2, 3]
    with pytest.raises(TopicError, match="raw data"):
        convert.attitude_log([cdr])


def test_fix_round_trip_with_and_without_covariance():
    cov = np.diag([1.0, 2.0, 3.0])
    messages = [convert.fix_message(STAMP, "gnss", 47.4, 10.3, 900.0, cov, status=2),
                convert.fix_message(STAMP + 1, "gnss", -33.0, -70.0, 500.0, None, status=-1)]
    assert TYPES.deserialize_cdr(messages[0], FIX.msgtype).position_covariance_type == 3
    assert TYPES.deserialize_cdr(messages[1], FIX.msgtype).position_covariance_type == 0
    log = convert.SAMPLE_TYPES[FIX.msgtype].read(messages)
    assert list(log.latitude_deg) == [47.4, -33.0] and list(log.longitude_deg) == [10.3, -70.0]
    assert list(log.height) == [900.0, 500.0] and list(log.status) == [2, -1]
    assert np.array_equal(log.cov_enu[0], cov) and not log.cov_enu[1].any()
    # What a driver leaves in a covariance that it calls unknown is not taken.
    unknown = TYPES.deserialize_cdr(messages[0], FIX.msgtype)
    unknown.position_covariance_type = 0
    again = bytes(TYPES.serialize_cdr(unknown, FIX.msgtype))
    assert not convert.SAMPLE_TYPES[FIX.msgtype].read([again]).cov_enu.any()


def test_velocity_round_trip():
    cov = np.arange(9.0).reshape(3, 3)
    cdr = convert.velocity_message(STAMP, "world", [1, 2, 3], cov)
    log = convert.SAMPLE_TYPES[TWIST.msgtype].read([cdr])
    assert list(log.vel_world[0]) == [1, 2, 3] and np.array_equal(log.cov_world[0], cov)
    message = TYPES.deserialize_cdr(cdr, TWIST.msgtype)
    assert message.twist.covariance[21] == -1.0  # no angular velocity in it


def test_pose_round_trip():
    quat = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_quat()
    message = convert.pose_message(STAMP, "world", quat, (4, 5, 6))
    log = convert.SAMPLE_TYPES[POSE.msgtype].read([message])
    assert np.array_equal(log.quat_world_imu[0], quat) and list(log.position_world[0]) == [4, 5, 6]


def test_bool_is_what_rosbags_writes():
    kind = TYPES.types["std_msgs/msg/Bool"]
    for value in (True, False):
        assert convert.bool_message(value) == bytes(
            TYPES.serialize_cdr(kind(data=value), "std_msgs/msg/Bool"))


def test_orientation_rows_give_roll_pitch_yaw():
    rows = np.zeros(1, ORIENTATION_DTYPE)
    rows["quat_world_imu"] = Rotation.from_euler("ZYX", [0.3, -0.2, 0.1]).as_quat()
    message = TYPES.deserialize_cdr(convert.rpy_messages(rows, "x")[0],
                                    "geometry_msgs/msg/Vector3Stamped")
    np.testing.assert_allclose([message.vector.x, message.vector.y, message.vector.z],
                               [0.1, -0.2, 0.3], atol=1e-15)
