"""CDR bytes of a sensor_msgs/PointCloud2 of vectors at points, without ROS."""

import struct
from functools import lru_cache

import numpy as np

from imu_fusion.messages.layouts import NANOSECONDS

POINT_CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
_FLOAT32 = 7  # sensor_msgs/PointField.FLOAT32


def _pad(data, size):
    return data + b"\0" * (-len(data) % size)


def _string(text):
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data


@lru_cache(maxsize=64)
def _description(frame_id, names, count):
    """The bytes between the stamp and the data, which begin 8 bytes after the encapsulation."""
    # Eight bytes of stamp keep the alignment of what follows.
    body = _pad(_string(frame_id), 4) + struct.pack("<III", 1, count, len(names))
    for k, name in enumerate(names):
        body = _pad(body, 4) + _string(name)
        body = _pad(body, 4) + struct.pack("<IB", 4 * k, _FLOAT32)
        body = _pad(body, 4) + struct.pack("<I", 1)
    body += struct.pack("<?", False)
    step = 4 * len(names)
    return _pad(body, 4) + struct.pack("<III", step, step * count, step * count)


def cloud_message(stamp: int, frame_id: str, names: tuple[str, ...],
                  points: np.ndarray) -> bytes:
    """CDR bytes of an unordered PointCloud2 of float32 fields.

    Args:
        stamp: int nanoseconds.
        names: tuple of field names.
        points: (p, len(names)).
    """
    sec, nanosec = divmod(int(stamp), NANOSECONDS)
    data = np.asarray(points, dtype="<f4")
    return (b"\x00\x01\x00\x00" + struct.pack("<iI", sec, nanosec)
            + _description(frame_id, tuple(names), len(data)) + data.tobytes()
            + struct.pack("<?", True))
