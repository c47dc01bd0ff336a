"""Records of MCAP files (https://mcap.dev/spec): where they begin and end, what definitions say.

No length is believed that does not add up: so the next record is found where one is damaged.
"""

import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from imu_fusion.recordings.storage import Bytes, DamageError, Memory

MAGIC = b"\x89MCAP0\r\n"
NONE = 0                   # no opcode
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX, DATA_END = 2, 3, 4, 5, 6, 7, 15
_LAST = 15                 # opcode of the specification
_PRIVATE = 128             # and beyond: of others, may be stepped over
# Least and greatest length of each record; the lengths inside of it must add up besides.
_LENGTHS = {1: (8, 1 << 20), 2: (20, 20), 3: (14, 1 << 26), 4: (16, 1 << 26), 5: (22, 1 << 62),
            6: (40, 1 << 62), 7: (6, 1 << 40), 8: (64, 1 << 30), 9: (36, 1 << 62),
            10: (44, 1 << 30), 11: (42, 1 << 30), 12: (8, 1 << 30), 13: (20, 1 << 30),
            14: (17, 17), 15: (4, 4)}
_IN_CHUNK = (SCHEMA, CHANNEL, MESSAGE)
HEAD = struct.Struct("<BQ")
CHUNK_HEAD = struct.Struct("<QQQII")
MESSAGE_HEAD = struct.Struct("<HIQQ")
_AGREE = 3                 # records in a row that are not there by chance
_PLACES = 1_000_000        # that are looked at in one file: they may be there on purpose
_PLACES_IN_CHUNK = 10_000
SEARCH = 1 << 20           # bytes that are looked through at once


class Channel(NamedTuple):
    """Definition of a channel; ``schema`` is the number of its schema."""

    schema: int
    topic: str
    encoding: str
    metadata: dict[str, str]


class Schema(NamedTuple):
    """Definition of a message type."""

    name: str
    encoding: str
    data: bytes


def end_of(file: Bytes, position: int) -> int | None:
    """Where the record at ``position`` ends, None if there is none."""
    head = file.read(position, HEAD.size)
    if len(head) < HEAD.size:
        return None
    opcode, length = HEAD.unpack(head)
    if opcode == 0 or _LAST < opcode < _PRIVATE:
        return None
    end = position + HEAD.size + length
    low, high = _LENGTHS.get(opcode, (0, 1 << 40))
    if not low <= length <= high or end > file.size:
        return None
    return end if _adds_up(file, opcode, position + HEAD.size, length) else None


def _adds_up(file: Bytes, opcode: int, position: int, length: int) -> bool:
    """Whether the lengths inside of a record make its own."""
    if opcode == CHUNK:
        head = file.read(position, 72)
        (text,) = struct.unpack_from("<I", head, 28)
        if text > 32:
            return False
        (records,) = struct.unpack_from("<Q", head, 32 + text)
        return length == 40 + text + records
    if opcode == INDEX:
        (entries,) = struct.unpack("<I", file.read(position + 2, 4))
        return length == 6 + entries and entries % 16 == 0
    if opcode in (SCHEMA, CHANNEL):
        try:
            content = file.read(position, length)
            (_schema if opcode == SCHEMA else _channel)(content)
        except DamageError:
            return False
    return True


def is_followed(file: Bytes, position: int, end: int) -> bool:
    """Whether a message outside of chunks, which nothing else vouches for, ends where another
    record begins, or the file does."""
    if file.read(position, 1)[0] != MESSAGE or end == file.size:
        return True
    if end_of(file, end) is not None:
        return True
    head = file.read(end, HEAD.size)
    if len(head) < HEAD.size:
        return 0 < head[0] <= _LAST
    opcode, length = HEAD.unpack(head)
    return (0 < opcode <= _LAST and length < 1 << 32
            and end + HEAD.size + length > file.size)   # the cut end of a file


class Search:
    """For the next record of a file where none follows, at no more than so many ``places``."""

    def __init__(self, file: Bytes, places: int = _PLACES) -> None:
        self._file, self._places = file, places

    def after(self, start: int) -> int:
        """Position of the first record at or after ``start``, the size of the file without one."""
        while start < self._file.size - HEAD.size and self._places > 0:
            bytes_ = np.frombuffer(self._file.read(start, SEARCH), np.uint8)
            count = len(bytes_) - HEAD.size + 1
            opcode = bytes_[:count]
            length = np.lib.stride_tricks.sliding_window_view(bytes_[1:], 8)[:count]
            # The length fits into a file: its upper bytes are zero.
            places = np.flatnonzero((opcode > 0) & (opcode <= _LAST)
                                    & (length[:, 5:] == 0).all(axis=1))
            for place in places[:self._places].tolist():
                self._places -= 1
                if _is_record(self._file, start + place):
                    return start + place
            start += count
        return self._file.size


def _is_record(file: Bytes, position: int) -> bool:
    """Whether enough records follow from ``position`` on not to be chance."""
    opcode = file.read(position, 1)[0]
    for _ in range(_AGREE):
        end = end_of(file, position)
        if end is None:
            return False
        if opcode == CHUNK or end == file.size:
            return True
        position = end
        if file.size - position == len(MAGIC):
            return file.read(position, 8) == MAGIC
    return True


def records(data: bytes) -> Iterator[tuple[int, memoryview]]:
    """(opcode, content) of the records of a chunk, as far as they are what may be in one: a chunk
    of zeros is no million of records. What is none comes with the opcode NONE."""
    view, position = memoryview(data), 0
    search = Search(Memory(data), _PLACES_IN_CHUNK)
    while position < len(data):
        opcode, length = (HEAD.unpack_from(data, position) if position + HEAD.size <= len(data)
                          else (NONE, 0))
        content = position + HEAD.size
        if opcode in _IN_CHUNK and _LENGTHS[opcode][0] <= length <= len(data) - content:
            yield opcode, view[content:content + length]
            position = content + length
            continue
        following = search.after(position + 1)
        yield NONE, view[position:following]
        position = following


def define(opcode: int, content: bytes | memoryview, channels: dict[int, Channel],
           schemas: dict[int, Schema]) -> None:
    """Put the definition in a record (SCHEMA or CHANNEL) under its number, if that has none yet;
    DamageError, if its lengths do not add up."""
    if opcode == SCHEMA:
        number, schema = _schema(content)
        schemas.setdefault(number, schema)
    else:
        number, channel = _channel(content)
        channels.setdefault(number, channel)


def _schema(content: bytes | memoryview) -> tuple[int, Schema]:
    reader = _Strings(content, 2)
    schema = Schema(reader.text(), reader.text(), reader.take())
    reader.end()
    return struct.unpack_from("<H", content)[0], schema


def _channel(content: bytes | memoryview) -> tuple[int, Channel]:
    reader = _Strings(content, 4)
    topic, encoding = reader.text(), reader.text()
    entries = _Strings(reader.take(), 0)
    metadata = {}
    while entries.left():
        key = entries.text()
        metadata[key] = entries.text()
    reader.end()
    number, schema = struct.unpack_from("<HH", content)
    return number, Channel(schema, topic, encoding, metadata)


class _Strings:
    """Bytes with their length ahead of them, one after the other."""

    def __init__(self, data: bytes | memoryview, position: int) -> None:
        self._data, self._position = bytes(data), position

    def left(self) -> bool:
        return self._position < len(self._data)

    def take(self) -> bytes:
        start = self._position + 4
        if start > len(self._data):
            raise DamageError("a length is missing")
        (length,) = struct.unpack_from("<I", self._data, self._position)
        self._position = start + length
        if self._position > len(self._data):
            raise DamageError("a length is beyond the record")
        return self._data[start:self._position]

    def text(self) -> str:
        return self.take().decode("utf-8", "replace")

    def end(self) -> None:
        if self.left():
            raise DamageError("lengths do not add up")
