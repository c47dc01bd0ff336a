"""Transforms as tf2 takes them: one tf2_msgs/TFMessage with one TransformStamped each."""

from functools import lru_cache

import numpy as np

from imu_fusion.messages.layouts import alike
from imu_fusion.messages.typestore import TYPES

TF_TYPE = "tf2_msgs/msg/TFMessage"
TF_TOPIC = "/tf"
"""Absolute: tf2 has one tree for all namespaces."""


def transform_messages(stamp: np.ndarray, parent: str, child: str, translation: np.ndarray,
                       quat: np.ndarray) -> list[bytes]:
    """CDR bytes of n TFMessages from the frame ``child`` to ``parent``.

    Args:
        stamp: (n,) int64 ns. parent, child: frame ids.
        translation: (n, 3) m of the child's origin in the parent; quat: (n, 4) xyzw,
            v_parent = R v_child.
    """
    template = _template(parent, child)
    record = np.dtype({"names": ["translation", "quat"], "formats": [("<f8", 3), ("<f8", 4)],
                       "offsets": [len(template) - 56, len(template) - 32],
                       "itemsize": len(template)})
    behind_count = 8    # encapsulation and the number of transforms
    return alike(template, record, behind_count, stamp, {"translation": translation, "quat": quat})


@lru_cache(maxsize=64)
def _template(parent, child):
    """A TFMessage of zeros."""
    types = TYPES.types
    header = types["std_msgs/msg/Header"](
        stamp=types["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id=parent)
    nowhere = types["geometry_msgs/msg/Transform"](
        translation=types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0),
        rotation=types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0))
    return bytes(TYPES.serialize_cdr(types[TF_TYPE](transforms=[
        types["geometry_msgs/msg/TransformStamped"](
            header=header, child_frame_id=child, transform=nowhere)]), TF_TYPE))
