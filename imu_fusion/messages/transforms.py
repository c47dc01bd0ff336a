"""Transforms as tf2 takes them: one tf2_msgs/TFMessage with one TransformStamped each."""

import numpy as np

from imu_fusion.messages.layouts import NANOSECONDS
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
    types = TYPES.types
    header = types["std_msgs/msg/Header"](
        stamp=types["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id=parent)
    nowhere = types["geometry_msgs/msg/Transform"](
        translation=types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0),
        rotation=types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0))
    template = bytes(TYPES.serialize_cdr(types[TF_TYPE](transforms=[
        types["geometry_msgs/msg/TransformStamped"](
            header=header, child_frame_id=child, transform=nowhere)]), TF_TYPE))
    size = len(template)
    # Behind encapsulation and the number of transforms, and at the end.
    record = np.dtype({"names": ["sec", "nanosec", "transform"],
                       "formats": ["<i4", "<u4", ("<f8", (7,))],
                       "offsets": [8, 12, size - 56], "itemsize": size})
    rows = np.tile(np.frombuffer(template, np.uint8), (len(stamp), 1))
    out = rows.view(record)[:, 0]
    out["sec"], out["nanosec"] = np.divmod(stamp, NANOSECONDS)
    out["transform"][:, :3], out["transform"][:, 3:] = translation, quat
    data = rows.tobytes()
    return [data[i:i + size] for i in range(0, len(data), size)]
