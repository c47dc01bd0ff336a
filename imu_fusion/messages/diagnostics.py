"""A diagnostic_msgs/DiagnosticArray with one status: stamped words and values."""

from collections.abc import Mapping
from typing import cast

from rosbags.typesys.stores.ros2_jazzy import builtin_interfaces__msg__Time as Time
from rosbags.typesys.stores.ros2_jazzy import (
    diagnostic_msgs__msg__DiagnosticArray as DiagnosticArray,
)
from rosbags.typesys.stores.ros2_jazzy import (
    diagnostic_msgs__msg__DiagnosticStatus as DiagnosticStatus,
)
from rosbags.typesys.stores.ros2_jazzy import diagnostic_msgs__msg__KeyValue as KeyValue
from rosbags.typesys.stores.ros2_jazzy import std_msgs__msg__Header as Header

from imu_fusion.errors import MessageError
from imu_fusion.messages.layouts import NANOSECONDS
from imu_fusion.messages.typestore import TYPES

DIAGNOSTICS_TYPE = "diagnostic_msgs/msg/DiagnosticArray"


def diagnostics_message(stamp: int, frame_id: str, name: str, words: str,
                        values: Mapping[str, str], worries: bool = False,
                        hardware_id: str = "") -> bytes:
    """CDR bytes.

    Args:
        stamp: int ns. frame_id, name, words, hardware_id: str. values: dict of str to str.
        worries: whether the level is WARN, else OK.
    """
    status = DiagnosticStatus(
        level=int(worries), name=name, message=words, hardware_id=hardware_id,
        values=[KeyValue(key=key, value=value) for key, value in values.items()])
    header = Header(stamp=Time(*divmod(int(stamp), NANOSECONDS)), frame_id=frame_id)
    return bytes(TYPES.serialize_cdr(DiagnosticArray(header=header, status=[status]),
                                     DIAGNOSTICS_TYPE))


def diagnostics_value(cdr: bytes, name: str) -> tuple[int, dict[str, str]]:
    """(stamp int ns, dict of str to str) of the status of that name, {} without one.

    Raises:
        MessageError: the bytes are no DiagnosticArray.
    """
    try:
        message = cast(DiagnosticArray, TYPES.deserialize_cdr(cdr, DIAGNOSTICS_TYPE))
    except Exception as error:  # the library raises whatever the bytes lead it to
        raise MessageError(f"{DIAGNOSTICS_TYPE}: {len(cdr)} bytes that cannot be read ({error})"
                           ) from None
    stamp = message.header.stamp
    return (stamp.sec * NANOSECONDS + stamp.nanosec,
            {v.key: v.value for s in message.status if s.name == name for v in s.values})
