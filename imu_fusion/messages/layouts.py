"""CDR bytes of the messages that carry samples and estimates, without ROS.

A :class:`Layout` describes a message that is a ``std_msgs/Header`` followed by
numbers. Decoding such bytes costs about a microsecond; live nodes and batch use
the same code, so that both write the same bytes.

Only plain CDR (little or big endian) occurs in ROS 2 bags and on the wire of
the default middleware; anything else is refused.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_fusion.errors import MessageError

NANOSECONDS = 1_000_000_000
_LITTLE = b"\x00\x01\x00\x00"


_FEW = 8              # messages that are decoded or encoded faster one by one
_FRAMES_AT_ONCE = 8   # different frame ids of one length that are looked for


@dataclass(frozen=True)
class Decoded:
    """Messages of one type, in the order given, without those that could not be decoded.

    ``stamp`` (n,) int64 ns, ``frame_ids`` list of n, ``values`` (n, size) as Layout.decode has
    them; ``refused`` maps the places of the others in the list given to the reason.
    """

    stamp: np.ndarray
    frame_ids: list
    values: np.ndarray
    refused: dict


class Layout:
    """One message type: a header, numbers before, doubles, numbers after.

    Args:
        msgtype: ROS name, such as ``sensor_msgs/msg/Imu``.
        before, after: struct codes of the numbers around the doubles.
        child: whether a second string follows the frame id (``child_frame_id``).
        doubles: field names and their numbers of doubles, in order.

    ``layout["field"]`` is the slice of a field in the flat values, which hold
    the numbers before, the doubles and the numbers after, all as float64.
    """

    def __init__(self, msgtype: str, before: str = "", after: str = "", child: bool = False,
                 **doubles: int):
        self.msgtype = msgtype
        self.child = child
        self._before, self._after = before, after
        self._count = sum(doubles.values())
        self._slices: dict[str, slice] = {}
        position = len(before)
        for name, count in doubles.items():
            self._slices[name] = slice(position, position + count)
            position += count
        self.size = position + len(after)
        self._prefixes: dict[tuple[str, str], bytes] = {}
        self._records: dict[tuple[str, int, int], np.dtype] = {}
        self._rest = {order: struct.Struct(f"{order}{self._count}d{after}") for order in "<>"}

    def __getitem__(self, field: str) -> slice:
        return self._slices[field]

    def decode(self, cdr: bytes) -> tuple[int, str, np.ndarray]:
        """Decode one message.

        Args:
            cdr: bytes with the four bytes of the encapsulation.

        Returns:
            (stamp int nanoseconds, frame id str, values (size,) float64)

        Raises:
            MessageError: the bytes are not one message of this type.
        """
        try:
            order = self._order(cdr)
            sec, nanosec, length = struct.unpack_from(order + "iII", cdr, 4)
            end = 16 + length
            if length < 1 or end > len(cdr) or nanosec >= NANOSECONDS:
                raise MessageError(f"{self.msgtype}: header with a frame id of {length} bytes and "
                                   f"{nanosec} ns in a message of {len(cdr)} bytes")
            frame_id = bytes(cdr[16:end - 1]).decode("utf-8", "replace")
            end = self._end_of_strings(order, cdr)
            values: tuple = ()
            for code in self._before:
                size = struct.calcsize(code)
                end = 4 + _align(end - 4, size)
                values += struct.unpack_from(order + code, cdr, end)
                end += size
            values += self._rest[order].unpack_from(cdr, 4 + _align(end - 4, 8))
        except (struct.error, IndexError) as error:
            raise MessageError(f"{self.msgtype}: {len(cdr)} bytes are too few ({error})") from None
        return sec * NANOSECONDS + nanosec, frame_id, np.array(values, dtype=np.float64)

    def decode_many(self, messages: Sequence[bytes]
                    ) -> tuple[np.ndarray, list[str], np.ndarray]:
        """Decode a list of messages at once.

        Returns:
            (stamps (n,) int64, frame ids list of str, values (n, size) float64)

        Raises:
            MessageError: one of them is not one message of this type.
        """
        block = self.decode_block(messages)
        if block.refused:
            raise MessageError(next(iter(block.refused.values())))
        return block.stamp, block.frame_ids, block.values

    def decode_block(self, messages: Sequence[bytes]) -> Decoded:
        """Decode what can be decoded: messages alike in one operation of numpy.

        Args:
            messages: sequence of bytes-like objects.

        Returns:
            Decoded, each number equal to that of :meth:`decode`.
        """
        n = len(messages)
        block = Decoded(np.zeros(n, np.int64), [""] * n, np.zeros((n, self.size)), {})
        alike: dict[tuple[int, bytes, bytes], list[int]] = {}
        for i, cdr in enumerate(messages):
            alike.setdefault((len(cdr), bytes(cdr[:4]), bytes(cdr[12:16])), []).append(i)
        for indices in alike.values():
            rest = np.array(indices)
            for _ in range(_FRAMES_AT_ONCE):
                if len(rest) < _FEW:
                    break
                rest = self._decode_alike(messages, rest, block)
            for i in rest.tolist():
                try:
                    block.stamp[i], block.frame_ids[i], block.values[i] = self.decode(messages[i])
                except MessageError as error:
                    block.refused[i] = str(error)
        if block.refused:
            keep = [i for i in range(n) if i not in block.refused]
            block = Decoded(block.stamp[keep], [block.frame_ids[i] for i in keep],
                            block.values[keep], dict(sorted(block.refused.items())))
        return block

    def _decode_alike(self, messages: Sequence[bytes], indices: np.ndarray,
                      block: Decoded) -> np.ndarray:
        """Decode the messages whose strings are those of the first; return the other indices."""
        first = messages[indices[0]]
        try:
            _, frame_id, _ = self.decode(first)
        except MessageError as error:
            block.refused[int(indices[0])] = str(error)
            return indices[1:]
        size = len(first)
        rows = np.frombuffer(b"".join([messages[i] for i in indices]), np.uint8).reshape(-1, size)
        order = self._order(first)
        end = self._end_of_strings(order, first)
        same = (rows[:, 12:end] == rows[0, 12:end]).all(axis=1)
        record = self._record(order, end, size)
        chosen = rows[same].view(record)[:, 0]
        here = indices[same]
        wild = chosen["nanosec"] >= NANOSECONDS
        for i in here[wild].tolist():
            try:
                self.decode(messages[i])
            except MessageError as error:
                block.refused[i] = str(error)
        block.stamp[here] = chosen["sec"].astype(np.int64) * NANOSECONDS + chosen["nanosec"]
        for i in here.tolist():
            block.frame_ids[i] = frame_id
        for k in range(len(self._before)):
            block.values[here, k] = chosen[f"before{k}"]
        last = len(self._before) + self._count
        block.values[here, len(self._before):last] = chosen["doubles"]
        for k in range(len(self._after)):
            block.values[here, last + k] = chosen[f"after{k}"]
        return indices[~same]

    def encode_block(self, stamp: np.ndarray, frame_id: str, values: np.ndarray,
                     child_frame_id: str = "") -> list[bytes]:
        """:meth:`encode` of n messages: stamp (n,) int64, values (n, size). Returns a list of
        bytes."""
        n = len(stamp)
        if n < _FEW:
            return [self.encode(s, frame_id, v, child_frame_id)
                    for s, v in zip(stamp.tolist(), values)]
        template = self.encode(0, frame_id, np.zeros(self.size), child_frame_id)
        size = len(template)
        record = self._record("<", self._end_of_strings("<", template), size)
        rows = np.tile(np.frombuffer(template, np.uint8), (n, 1))
        out = rows.view(record)[:, 0]
        out["sec"], out["nanosec"] = np.divmod(stamp, NANOSECONDS)
        for k in range(len(self._before)):
            out[f"before{k}"] = values[:, k]
        last = len(self._before) + self._count
        out["doubles"] = values[:, len(self._before):last]
        for k in range(len(self._after)):
            out[f"after{k}"] = values[:, last + k]
        data = rows.tobytes()
        return [data[i:i + size] for i in range(0, n * size, size)]

    def encode(self, stamp: int, frame_id: str, values: Sequence[float] | np.ndarray,
               child_frame_id: str = "") -> bytes:
        """The CDR bytes of one message (little endian, padding zero).

        Args:
            stamp: int nanoseconds.
            frame_id: str.
            values: sequence of ``size`` numbers, in the order of :meth:`decode`.
        """
        key = (frame_id, child_frame_id)
        prefix = self._prefixes.get(key)
        if prefix is None:
            prefix = _string(frame_id)
            if self.child:
                prefix = _pad(prefix, 4) + _string(child_frame_id)
            if len(self._prefixes) < 64:  # frame ids come from outside
                self._prefixes[key] = prefix
        sec, nanosec = divmod(int(stamp), NANOSECONDS)
        body = struct.pack("<iI", sec, nanosec) + prefix
        for code, value in zip(self._before, values):
            body = _pad(body, struct.calcsize(code)) + struct.pack("<" + code, int(value))
        first = len(self._before)
        last = first + self._count
        body = _pad(body, 8) + np.asarray(values[first:last], dtype="<f8").tobytes()
        for code, value in zip(self._after, values[last:]):
            body = _pad(body, struct.calcsize(code)) + struct.pack("<" + code, int(value))
        return _LITTLE + body

    def _end_of_strings(self, order: str, cdr: bytes) -> int:
        """Where the numbers may begin."""
        end = 16 + struct.unpack_from(order + "I", cdr, 12)[0]
        if self.child:
            start = 4 + _align(end - 4, 4)
            end = start + 4 + struct.unpack_from(order + "I", cdr, start)[0]
        return end

    def _record(self, order: str, end: int, size: int) -> np.dtype:
        """The structured dtype of a message of ``size`` bytes whose strings end at ``end``."""
        record = self._records.get((order, end, size))
        if record is not None:
            return record
        fields: dict[str, tuple[Any, int]] = {
            "sec": (order + "i4", 4), "nanosec": (order + "u4", 8)}
        for part, codes in (("before", self._before), ("doubles", ""), ("after", self._after)):
            if part == "doubles":
                end = 4 + _align(end - 4, 8)
                fields[part] = ((order + "f8", (self._count,)), end)
                end += 8 * self._count
            for k, code in enumerate(codes):
                width = struct.calcsize(code)
                end = 4 + _align(end - 4, width)
                fields[f"{part}{k}"] = (order + np.dtype(code).str[1:], end)
                end += width
        record = np.dtype({"names": list(fields), "formats": [f for f, _ in fields.values()],
                           "offsets": [o for _, o in fields.values()], "itemsize": size})
        if len(self._records) < 64:  # lengths come from outside
            self._records[order, end, size] = record
        return record

    def _order(self, cdr):
        if len(cdr) < 16 or cdr[0] != 0 or cdr[1] not in (0, 1):
            raise MessageError(f"{self.msgtype}: {len(cdr)} bytes that do not start as plain CDR")
        return "<" if cdr[1] == 1 else ">"


def _align(position, size):
    return -(-position // size) * size


def _pad(data, size):
    return data + b"\0" * (_align(len(data), size) - len(data))


def _string(text):
    data = text.encode("utf-8") + b"\0"
    return struct.pack("<I", len(data)) + data


IMU = Layout("sensor_msgs/msg/Imu", orientation=4, orientation_covariance=9,
             angular_velocity=3, angular_velocity_covariance=9,
             linear_acceleration=3, linear_acceleration_covariance=9)
MAG = Layout("sensor_msgs/msg/MagneticField", magnetic_field=3, magnetic_field_covariance=9)
# status, service; then latitude, longitude, altitude and the covariance; then its type
FIX = Layout("sensor_msgs/msg/NavSatFix", before="bH", after="B", latitude=1, longitude=1,
             altitude=1, position_covariance=9)
TWIST = Layout("geometry_msgs/msg/TwistWithCovarianceStamped", linear=3, angular=3, covariance=36)
POSE = Layout("geometry_msgs/msg/PoseStamped", position=3, orientation=4)
POSE_COVARIANCE = Layout("geometry_msgs/msg/PoseWithCovarianceStamped", position=3, orientation=4,
                         covariance=36)
ACCEL = Layout("geometry_msgs/msg/AccelWithCovarianceStamped", linear=3, angular=3, covariance=36)
VECTOR3 = Layout("geometry_msgs/msg/Vector3Stamped", vector=3)
ODOMETRY = Layout("nav_msgs/msg/Odometry", child=True, position=3, orientation=4,
                  pose_covariance=36, linear=3, angular=3, twist_covariance=36)

# No headers, no layouts: see convert.bool_message and string_message.
BOOL_TYPE, STRING_TYPE = "std_msgs/msg/Bool", "std_msgs/msg/String"
