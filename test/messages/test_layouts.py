"""Our CDR against the CDR of rosbags' message types, in both directions."""

import numpy as np
import pytest

from imu_fusion.errors import MessageError
from imu_fusion.messages.layouts import FIX, IMU, LAYOUTS, ODOMETRY
from imu_fusion.messages.typestore import TYPES

STAMP = 1_700_000_123_456_789_012


def numbers(layout, seed=0):
    values = np.random.default_rng(seed).normal(size=layout.size)
    if layout is FIX:
        values[[0, 1, -1]] = (-1, 5, 3)
    return values


def flat(message, skip=("header", "child_frame_id")):
    """All numbers of a rosbags message, depth first, as the definition orders them."""
    result = []
    for name, value in vars(message).items():
        if name.startswith("__") or name in skip or name.isupper():
            continue
        if hasattr(value, "__msgtype__"):
            result += flat(value)
        else:
            result += list(np.atleast_1d(value))
    return result


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=lambda layout: layout.msgtype)
@pytest.mark.parametrize("frame_id", ["", "a", "ab", "abc", "imu_link", "ü/π"])
def test_agrees_with_rosbags_in_both_directions(layout, frame_id):
    values = numbers(layout)
    child = "base" if layout is ODOMETRY else ""
    ours = layout.encode(STAMP, frame_id, values, child)
    message = TYPES.deserialize_cdr(ours, layout.msgtype)
    assert message.header.frame_id == frame_id
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_123, 456_789_012)
    assert flat(message) == list(values)
    for little in (True, False):
        theirs = bytes(TYPES.serialize_cdr(message, layout.msgtype, little_endian=little))
        stamp, frame, decoded = layout.decode(theirs)
        assert (stamp, frame) == (STAMP, frame_id)
        assert np.array_equal(decoded, values)


def test_negative_stamps_keep_their_nanoseconds():
    assert IMU.decode(IMU.encode(-1, "x", np.zeros(37)))[0] == -1


@pytest.mark.parametrize("length", [0, 3, 4, 15, 16, 40, 200])
def test_short_messages_are_refused(length):
    cdr = IMU.encode(STAMP, "imu_link", np.zeros(37))
    with pytest.raises(MessageError, match="sensor_msgs/msg/Imu"):
        IMU.decode(cdr[:length])


def test_foreign_encapsulation_and_wild_lengths_are_refused():
    cdr = bytearray(IMU.encode(STAMP, "imu_link", np.zeros(37)))
    parameter_list = bytes([0, 3, 0, 0]) + bytes(cdr[4:])
    with pytest.raises(MessageError):
        IMU.decode(parameter_list)
    cdr[12:16] = b"\xff\xff\xff\x7f"
    with pytest.raises(MessageError):
        IMU.decode(bytes(cdr))


def test_field_slices_name_the_right_numbers():
    values = numbers(IMU)
    message = TYPES.deserialize_cdr(IMU.encode(STAMP, "x", values), IMU.msgtype)
    force = message.linear_acceleration
    assert list(values[IMU["linear_acceleration"]]) == [force.x, force.y, force.z]
    assert list(values[IMU["angular_velocity_covariance"]]) == list(
        message.angular_velocity_covariance)
