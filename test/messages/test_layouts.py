"""Our CDR against the CDR of rosbags' message types, in both directions."""

import numpy as np
import pytest

from imu_fusion.errors import MessageError
from imu_fusion.messages.layouts import FIX, IMU, ODOMETRY
from imu_fusion.messages.typestore import TYPES
from test.layouts import LAYOUTS

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


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=lambda layout: layout.msgtype)
@pytest.mark.parametrize("n", [0, 1, 3, 4, 50])
def test_a_block_is_encoded_as_its_messages_one_by_one(layout, n):
    stamp = STAMP + np.arange(n, dtype=np.int64) * 333_333_333
    stamp[n // 2:] -= 2 * STAMP    # negative ones, too
    values = np.array([numbers(layout, seed) for seed in range(n)]).reshape(n, layout.size)
    child = "base" if layout is ODOMETRY else ""
    assert layout.encode_block(stamp, "imu_link", values, child) == [
        layout.encode(int(s), "imu_link", v, child) for s, v in zip(stamp, values)]


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=lambda layout: layout.msgtype)
@pytest.mark.parametrize("seed", range(5))
def test_a_block_is_decoded_as_its_messages_one_by_one(layout, seed):
    """Frames of all kinds, both byte orders, broken messages, memoryviews, in any order."""
    rng = np.random.default_rng(seed)
    messages = []
    for i in range(200):
        frame = rng.choice(["imu_link", "imu_lonk", "base", "ü/π", ""], p=[.6, .1, .1, .1, .1])
        cdr = layout.encode(STAMP + i, str(frame), numbers(layout, i),
                            "b" if layout is ODOMETRY else "")
        if rng.random() < 0.2:
            message = TYPES.deserialize_cdr(cdr, layout.msgtype)
            cdr = bytes(TYPES.serialize_cdr(message, layout.msgtype, little_endian=False))
        fate = rng.random()
        if fate < 0.05:
            cdr = cdr[:rng.integers(len(cdr))]
        elif fate < 0.1:
            cdr = cdr[:8] + b"\xff\xff\xff\xff" + cdr[12:]
        elif fate < 0.15:
            cdr = cdr[:12] + b"\x00\x00\x00\x00" + cdr[16:]
        elif fate < 0.2:
            cdr = cdr + b"\x00" * 3
        messages.append(memoryview(cdr) if rng.random() < 0.3 else cdr)
    block = layout.decode_block(messages)
    expected, refused = [], {}
    for i, cdr in enumerate(messages):
        try:
            expected.append(layout.decode(cdr))
        except MessageError as error:
            refused[i] = str(error)
    assert 10 < len(refused) < 60 and block.refused == refused
    stamp, frames, values = zip(*expected)
    assert block.stamp.tolist() == list(stamp) and block.frame_ids == list(frames)
    assert np.array_equal(block.values, values)


def test_a_message_that_cannot_be_decoded_is_refused_where_all_are_needed():
    good = IMU.encode(STAMP, "x", np.zeros(37))
    with pytest.raises(MessageError, match="too few"):
        IMU.decode_many([good] * 10 + [good[:100]])
