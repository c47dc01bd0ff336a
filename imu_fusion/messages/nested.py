"""Messages inside of messages: a driver's own type that holds a sensor_msgs/Imu, say.

The definition in the recording tells where in the bytes the field is; nothing is made code of.
"""

import re
import struct
from collections.abc import Callable
from typing import NamedTuple

from imu_fusion.errors import MessageError
from imu_fusion.messages.convert import SAMPLE_TYPES
from imu_fusion.messages.layouts import NANOSECONDS, Layout

_PRIMITIVES = {"bool": "?", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h",
               "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q",
               "float32": "f", "float64": "d"}
_TYPES = {msgtype.replace("/msg/", "/"): kind.layout for msgtype, kind in SAMPLE_TYPES.items()}
_FIELD = re.compile(r"(string|wstring|[\w/]+)(?:<=\d+)?(\[(?:<=)?(\d*)\])?\s+(\w+)\s*(=?)")
_HEADER = "std_msgs/Header"
_DEEPEST = 16


class _Field(NamedTuple):
    """One field: ``times`` None: a single value; -1: a sequence; else an array."""

    kind: str
    name: str
    times: int | None


Definitions = dict[str, list[_Field]]


class Nested(NamedTuple):
    """A field of messages: the type of message that it is, and what takes it out of CDR bytes
    (MessageError if they do not fit)."""

    msgtype: str
    extract: Callable[[bytes], bytes]


def nested(msgtype: str, definition: str, path: str) -> Nested | None:
    """What is at a field of a message.

    Args:
        msgtype: such as vendor_msgs/msg/Data. definition: ros2msg text with its dependencies.
        path: names of fields, joined by dots.

    Returns:
        None if there is no such field, or it is none of the messages that carry samples.
    """
    definitions = _parse(msgtype, definition)
    kind, names = msgtype.replace("/msg/", "/"), path.split(".")
    for name in names:
        found = [f for f in definitions.get(kind, ()) if f.name == name and f.times is None]
        if not found:
            return None
        kind = found[0].kind
    layout = _TYPES.get(kind)
    if layout is None or kind not in definitions:
        return None
    start = msgtype.replace("/msg/", "/")
    return Nested(layout.msgtype, lambda cdr: _extract(cdr, definitions, start, names, layout))


def _parse(msgtype: str, text: str) -> Definitions:
    """Fields of a type and of those that it holds, by name without '/msg/'."""
    found: Definitions = {}
    name = msgtype.replace("/msg/", "/")
    for k, part in enumerate(re.split(r"^={3,}\s*$", text, flags=re.MULTILINE)):
        lines = [line.partition("#")[0].strip() for line in part.splitlines()]
        lines = [line for line in lines if line]
        if k:
            if not lines or not lines[0].startswith("MSG:"):
                continue
            name = lines.pop(0)[4:].strip().replace("/msg/", "/")
        fields = found.setdefault(name, [])
        for line in lines:
            match = _FIELD.match(line)
            if match and not match[5]:    # else a constant
                count = None if match[2] is None else int(match[3]) if match[3] else -1
                if match[2] is not None and "<=" in match[2]:
                    count = -1
                fields.append(_Field(_full(match[1], name), match[4], count))
    return found


def _full(kind: str, holder: str) -> str:
    if kind in _PRIMITIVES or kind in ("string", "wstring"):
        return kind
    if kind == "Header":
        return _HEADER
    return kind.replace("/msg/", "/") if "/" in kind else f"{holder.partition('/')[0]}/{kind}"


class _Cursor:
    """A place in CDR bytes; alignment counts from behind the encapsulation."""

    def __init__(self, cdr: bytes, definitions: Definitions) -> None:
        if len(cdr) < 4 or cdr[0] != 0 or cdr[1] not in (0, 1):
            raise MessageError(f"{len(cdr)} bytes that do not start as plain CDR")
        self._cdr, self._definitions = cdr, definitions
        self._order = "<" if cdr[1] == 1 else ">"
        self._at = 4
        self._left = len(cdr) + 1000    # fields: a definition may ask for any number of empty ones

    def numbers(self, kind: str, count: int) -> tuple:
        """The next values of a primitive type."""
        code = _PRIMITIVES[kind]
        size = struct.calcsize(code)
        self._at = 4 + -(-(self._at - 4) // size) * size
        if count * size > len(self._cdr) - self._at:
            raise MessageError(f"{count} values of {kind} are more than is left")
        values = struct.unpack_from(f"{self._order}{count}{code}", self._cdr, self._at)
        self._at += count * size
        return values

    def text(self) -> str:
        """The next string."""
        length, = self.numbers("uint32", 1)
        data = bytes(self._cdr[self._at:self._at + length])
        if len(data) < length:
            raise MessageError(f"a string of {length} bytes is longer than what is left")
        self._at += length
        return data.rstrip(b"\0").decode("utf-8", "replace")

    def values(self, field: _Field, depth: int = 0) -> list:
        """All numbers and texts of a field, in order."""
        self._left -= 1
        if depth > _DEEPEST or self._left < 0:
            raise MessageError("its definition is nested too deep, or without end")
        count = 1 if field.times is None else field.times
        if count < 0:
            count, = self.numbers("uint32", 1)
        if field.kind in _PRIMITIVES:
            return list(self.numbers(field.kind, count)) if count else []
        if count > len(self._cdr):
            raise MessageError(f"{count} values of {field.kind} are more than is left")
        if field.kind in ("string", "wstring"):
            return [self.text() for _ in range(count)]
        if field.kind not in self._definitions:
            raise MessageError(f"the definition of {field.kind} is not in the recording")
        return [value for _ in range(count) for inner in self._definitions[field.kind]
                for value in self.values(inner, depth + 1)]


def _extract(cdr: bytes, definitions: Definitions, kind: str, path: list[str],
             layout: Layout) -> bytes:
    cursor, header = _Cursor(cdr, definitions), None
    try:
        for name in path:
            for field in definitions[kind]:
                if field.name == name:
                    kind = field.kind
                    break
                values = cursor.values(field)
                if field.kind == _HEADER and header is None:
                    header = values
        sec, nanosec, frame, *numbers = cursor.values(_Field(kind, "", None))
    except (struct.error, ValueError) as error:
        if isinstance(error, MessageError):
            raise
        raise MessageError(f"{layout.msgtype} at {'.'.join(path)}: {error}") from None
    if header is not None and sec == 0 and nanosec == 0:
        sec, nanosec, frame = header    # left unset inside
    if len(numbers) != layout.size or not 0 <= nanosec < NANOSECONDS:
        raise MessageError(f"{layout.msgtype} at {'.'.join(path)}: {len(numbers)} numbers")
    return layout.encode(sec * NANOSECONDS + nanosec, frame, numbers)
