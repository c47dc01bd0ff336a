"""CDR bytes of a sensor_msgs/PointCloud2 of vectors at points, without ROS."""

import struct
from functools import lru_cache

import numpy as np

from imu_fusion.messages.layouts import LITTLE, alike, padded, string

POINT_CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
_FLOAT32 = 7  # sensor_msgs/PointField.FLOAT32


@lru_cache(maxsize=64)
def _description(frame_id, names, count):
    """The bytes between the stamp and the data, which begin 8 bytes after the encapsulation."""
    # Eight bytes of stamp keep the alignment of what follows.
    body = padded(string(frame_id), 4) + struct.pack("<III", 1, count, len(names))
    for k, name in enumerate(names):
        body = padded(body, 4) + string(name)
        body = padded(body, 4) + struct.pack("<IB", 4 * k, _FLOAT32)
        body = padded(body, 4) + struct.pack("<I", 1)
    body += struct.pack("<?", False)
    step = 4 * len(names)
    return padded(body, 4) + struct.pack("<III", step, step * count, step * count)


def cloud_messages(stamp: np.ndarray, frame_id: str, names: tuple[str, ...],
                   points: np.ndarray) -> list[bytes]:
    """CDR bytes of n unordered PointCloud2 of float32 fields.

    Args:
        stamp: (n,) int64 nanoseconds.
        names: tuple of field names.
        points: (n, p, len(names)).
    """
    head = LITTLE + bytes(8) + _description(frame_id, names, points.shape[1])
    size = 4 * points.shape[1] * points.shape[2]
    record = np.dtype({"names": ["points"], "formats": [("<f4", points.shape[1:])],
                       "offsets": [len(head)], "itemsize": len(head) + size + 1})
    is_dense = b"\x01"
    return alike(head + bytes(size) + is_dense, record, len(LITTLE), stamp, {"points": points})
