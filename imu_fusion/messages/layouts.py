"""CDR bytes of the messages that carry samples and estimates, without ROS.

A :class:`Layout` describes a message that is a ``std_msgs/Header`` followed by numbers. Messages
whose strings are alike have their numbers at the same places: one record of numpy reads or writes
one or thousands of them. Live nodes and batch use the same code, so that both write the same bytes.

Only plain CDR (little or big endian) occurs in ROS 2 bags and on the wire of the default
middleware; anything else is refused.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from imu_fusion.errors import MessageError

NANOSECONDS = 1_000_000_000
LITTLE = b"\x00\x01\x00\x00"
"""The encapsulation of plain CDR, little endian."""

_STAMP = struct.Struct("<iI")
_STAMP_AT, _STRINGS = 4, 12    # where they begin
_KNOWN = 64      # shapes and templates that are kept: strings come from outside


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


@dataclass(frozen=True, eq=False)
class _Shape:
    """Where the numbers are in messages of one size, byte order and strings."""

    size: int
    order: bytes      # the two bytes that tell it
    strings: bytes
    end: int          # of the strings
    frame_id: str
    stamp: struct.Struct
    record: np.dtype

    def fits(self, cdr: bytes) -> bool:
        """Whether a message is one of these."""
        return (len(cdr) == self.size and cdr[_STRINGS:self.end] == self.strings
                and cdr[:2] == self.order)


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
        self._slices: dict[str, slice] = {}
        position = len(before)
        for name, count in doubles.items():
            self._slices[name] = slice(position, position + count)
            position += count
        self.size = position + len(after)
        # Fields of a record, their codes and shapes, and the columns of the values that they are.
        self._fields: list[tuple[str, str, tuple, int | slice]] = [
            *((f"before{k}", code, (), k) for k, code in enumerate(before)),
            ("doubles", "d", (position - len(before),), slice(len(before), position)),
            *((f"after{k}", code, (), position + k) for k, code in enumerate(after))]
        self._latest: _Shape | None = None
        self._shapes: list[_Shape] = []
        self._templates: dict[tuple[str, str], tuple[bytes, np.dtype]] = {}

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
        stamp, frame_ids, values = self.decode_many([cdr])
        return int(stamp[0]), frame_ids[0], values[0]

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
        """
        stamp: list[int] = []
        frame_ids: list[str] = []
        refused: dict[int, str] = {}
        alike: dict[_Shape, tuple[list[int], list[bytes]]] = {}
        for i, cdr in enumerate(messages):
            try:
                shape = self._latest
                if shape is None or not shape.fits(cdr):
                    shape = self._latest = self._shape(bytes(cdr))
                sec, nanosec = shape.stamp.unpack_from(cdr, _STAMP_AT)
                if nanosec >= NANOSECONDS:
                    raise MessageError(f"{self.msgtype}: a stamp with {nanosec} ns")
            except MessageError as error:
                refused[i] = str(error)
                continue
            places, chosen = alike.setdefault(shape, ([], []))
            places.append(len(stamp))
            chosen.append(cdr)
            stamp.append(sec * NANOSECONDS + nanosec)
            frame_ids.append(shape.frame_id)
        values = np.empty((len(stamp), self.size))
        for shape, (places, chosen) in alike.items():
            rows = np.frombuffer(b"".join(chosen), shape.record)
            here = slice(None) if len(alike) == 1 else places
            for name, _, _, column in self._fields:
                values[here, column] = rows[name]
        return Decoded(np.array(stamp, np.int64), frame_ids, values, refused)

    def encode(self, stamp: int, frame_id: str, values: Sequence[float] | np.ndarray,
               child_frame_id: str = "") -> bytes:
        """The CDR bytes of one message (little endian, padding zero).

        Args:
            stamp: int nanoseconds.
            frame_id: str.
            values: sequence of ``size`` numbers, in the order of :meth:`decode`.
        """
        return self.encode_block(np.array([stamp], np.int64), frame_id,
                                 np.asarray(values, dtype=float)[None], child_frame_id)[0]

    def encode_block(self, stamp: np.ndarray, frame_id: str, values: np.ndarray,
                     child_frame_id: str = "") -> list[bytes]:
        """:meth:`encode` of n messages: stamp (n,) int64, values (n, size). Returns a list of
        bytes."""
        key = (frame_id, child_frame_id)
        template, record = self._templates.get(key) or self._template(*key)
        return alike(template, record, _STAMP_AT, stamp,
                     {name: values[:, column] for name, _, _, column in self._fields})

    def _template(self, frame_id: str, child_frame_id: str) -> tuple[bytes, np.dtype]:
        """A message of zeros, and where its numbers are."""
        strings = string(frame_id)
        if self.child:
            strings = padded(strings, 4) + string(child_frame_id)
        begin = LITTLE + bytes(_STRINGS - 4) + strings
        record = self._record("<", len(begin))
        made = begin.ljust(record.itemsize, b"\0"), record
        if len(self._templates) < _KNOWN:
            self._templates[frame_id, child_frame_id] = made
        return made

    def _shape(self, cdr: bytes) -> _Shape:
        """The shape of a message, or MessageError."""
        for shape in self._shapes:
            if shape.fits(cdr):
                return shape
        if len(cdr) < 16 or cdr[0] != 0 or cdr[1] not in (0, 1):
            raise MessageError(f"{self.msgtype}: {len(cdr)} bytes that do not start as plain CDR")
        order = "<" if cdr[1] == 1 else ">"
        end = first = 16 + struct.unpack_from(order + "I", cdr, _STRINGS)[0]
        if end == 16 or end > len(cdr):
            raise MessageError(f"{self.msgtype}: a frame id of {end - 16} bytes in a message of "
                               f"{len(cdr)} bytes")
        if self.child and _aligned(end, 4) + 4 <= len(cdr):
            start = _aligned(end, 4)
            end = start + 4 + struct.unpack_from(order + "I", cdr, start)[0]
        shape = _Shape(len(cdr), cdr[:2], cdr[_STRINGS:end], end,
                       cdr[16:first - 1].decode("utf-8", "replace"), struct.Struct(order + "iI"),
                       self._record(order, end, len(cdr)))
        if len(self._shapes) < _KNOWN:
            self._shapes.append(shape)
        return shape

    def _record(self, order: str, end: int, size: int | None = None) -> np.dtype:
        """The structured dtype of a message whose strings end at ``end``, of ``size`` bytes (None:
        as many as it needs)."""
        fields: dict[str, tuple[np.dtype, int]] = {}
        for name, code, shape, _ in self._fields:
            kind = np.dtype((order + np.dtype(code).str[1:], shape))
            end = _aligned(end, struct.calcsize(code))
            fields[name] = kind, end
            end += kind.itemsize
        if size is not None and end > size:
            raise MessageError(f"{self.msgtype}: {size} bytes are too few, {end} are needed")
        return np.dtype({"names": list(fields), "formats": [f for f, _ in fields.values()],
                         "offsets": [o for _, o in fields.values()], "itemsize": size or end})


def _aligned(position, size):
    """Alignment counts from behind the encapsulation."""
    return 4 - (4 - position) // size * size


def alike(template: bytes, record: np.dtype, stamp_at: int, stamp: np.ndarray,
          columns: Mapping[str, np.ndarray]) -> list[bytes]:
    """CDR bytes of n messages that differ in stamp and numbers.

    Args:
        template: one of them, little endian.
        record: structured dtype as long, with the fields of ``columns``, which are of n elements.
        stamp_at: place of the stamp; stamp: (n,) int64 ns.
    """
    room, size = bytearray(template * len(stamp)), len(template)
    for i, nanoseconds in enumerate(stamp.tolist()):
        _STAMP.pack_into(room, i * size + stamp_at, *divmod(nanoseconds, NANOSECONDS))
    rows = np.frombuffer(room, record)
    for name, values in columns.items():
        rows[name] = values
    data = bytes(room)
    return [data[i:i + size] for i in range(0, len(data), size)]


def padded(data: bytes, size: int) -> bytes:
    """Zeros up to the next multiple of ``size``."""
    return data + b"\0" * (-len(data) % size)


def string(text: str) -> bytes:
    """A string as it stands in CDR: its length, then UTF-8 with a zero at its end."""
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
