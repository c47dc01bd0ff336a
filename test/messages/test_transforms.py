"""Transforms against the CDR of rosbags' message types."""

import numpy as np
import pytest

from imu_fusion.messages.transforms import TF_TYPE, transform_messages
from imu_fusion.messages.typestore import TYPES


@pytest.mark.parametrize("parent, child", [("map", "base_link"), ("world", "ü"), ("odom", "imu")])
def test_agrees_with_rosbags(parent, child):
    rng = np.random.default_rng(1)
    stamp = np.array([1_700_000_123_456_789_012, -1, 5])
    place, quat = rng.normal(size=(3, 3)), rng.normal(size=(3, 4))
    for i, cdr in enumerate(transform_messages(stamp, parent, child, place, quat)):
        message = TYPES.deserialize_cdr(cdr, TF_TYPE)
        (one,) = message.transforms
        assert (one.header.frame_id, one.child_frame_id) == (parent, child)
        assert one.header.stamp.sec * 10 ** 9 + one.header.stamp.nanosec == stamp[i]
        move, turn = one.transform.translation, one.transform.rotation
        assert [move.x, move.y, move.z] == place[i].tolist()
        assert [turn.x, turn.y, turn.z, turn.w] == quat[i].tolist()
        assert bytes(TYPES.serialize_cdr(message, TF_TYPE)) == cdr
