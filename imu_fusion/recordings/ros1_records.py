"""Records of ROS 1 bags (http://wiki.ros.org/Bags/Format/2.0): where they begin and end.

Each is a header of name=value pairs and data, both with their lengths ahead of them. No length is
believed that leads out of the file or the chunk: so the next record is found where one is damaged.
"""

import re
import struct
from collections.abc import Iterator

from imu_fusion.recordings.storage import Bytes, Memory

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG, INDEX, CHUNK, INFO, CONNECTION = (bytes([op]) for op in range(2, 8))
COMPRESSIONS = ("none", "lz4", "bz2")
Header = dict[str, bytes]

_LONGEST = 1 << 20         # bytes that a header takes at most: definitions are in the data
_WINDOW = 1 << 20
_BEFORE = 64               # bytes from the begin of a record to a mark in its header, at most
# In the headers of a chunk and of a message. Of the latter, with its three fields in any order, the
# mark is so many bytes behind the begin of the record.
_MARKS = re.compile(rb"compression=|\x04\0\0\0op=\x02")
_TO_OP = (4, 17, 21, 34)
_PLACES = 100_000          # that are looked at in one file: marks may be there on purpose
_PLACES_IN_CHUNK = 1000


def header_at(file: Bytes, position: int) -> tuple[Header, int, int] | None:
    """(header, begin and end of the data) of the record at ``position``, None if there is none. Of
    one that is cut off the data ends beyond the file."""
    head = file.read(position, 4)
    if position < 0 or len(head) < 4:
        return None
    (length,) = struct.unpack("<I", head)
    if not 0 < length <= _LONGEST or position + 8 + length > file.size:
        return None
    header = fields(file.read(position + 4, length))
    if not header or not MESSAGE <= header.get("op", b"") <= CONNECTION:
        return None
    (size,) = struct.unpack("<I", file.read(position + 4 + length, 4))
    begin = position + 8 + length
    return header, begin, begin + size


def record_at(file: Bytes, position: int) -> tuple[Header, int, int] | None:
    """The same of a record that is there as a whole."""
    found = header_at(file, position)
    return None if found is None or found[2] > file.size else found


def records(data: bytes) -> Iterator[tuple[Header, memoryview]]:
    """(header, data) of the records of a chunk; what is none comes with an empty header."""
    file, view, position = Memory(data), memoryview(data), 0
    search = Search(file, _PLACES_IN_CHUNK)
    while position < len(data):
        found = record_at(file, position)
        if found is not None and found[0]["op"] in (MESSAGE, CONNECTION):
            header, begin, end = found
            yield header, view[begin:end]
            position = end
            continue
        following = search.after(position + 1)
        yield {}, view[position:following]
        position = following


class Search:
    """For the next record of a file where none follows, at no more than so many ``places``."""

    def __init__(self, file: Bytes, places: int = _PLACES) -> None:
        self._file, self._places = file, places

    def after(self, start: int) -> int:
        """Position of the first chunk, or message that another record or the end of the file
        follows, at or after ``start``; the end of the file without one."""
        file = self._file
        while start < file.size and self._places > 0:
            data = file.read(start, _WINDOW)
            for mark in _MARKS.finditer(data):
                at = start + mark.start()
                steps = _TO_OP if mark[0].endswith(b"\x02") else range(12, _BEFORE)
                for position in (at - step for step in steps if at - step >= start):
                    if self._is_record(position):
                        return position
                self._places -= 1
                if self._places <= 0:
                    break
            start += max(len(data) - _BEFORE, 1)
        return file.size

    def _is_record(self, position: int) -> bool:
        found = record_at(self._file, position)
        if found is None:
            return False
        header, begin, end = found
        if header["op"] == CHUNK:
            return is_chunk(header, end - begin)
        return header["op"] == MESSAGE and (
            end == self._file.size or record_at(self._file, end) is not None)


def is_chunk(header: Header, size: int) -> bool:
    """Whether a header can be that of a chunk with ``size`` bytes."""
    unpacked = integer(header.get("size"))
    packing = compression(header)
    return unpacked is not None and packing in COMPRESSIONS and (
        packing != "none" or unpacked == size)


def compression(header: Header) -> str:
    """How a chunk is packed."""
    return header.get("compression", b"").decode("ascii", "replace")


def fields(data: bytes) -> Header | None:
    """The name=value pairs of a header, None if it is none."""
    found, position = {}, 0
    while position < len(data):
        if position + 4 > len(data):
            return None
        (length,) = struct.unpack_from("<I", data, position)
        position += 4 + length
        if position > len(data):
            return None
        name, sign, value = data[position - length:position].partition(b"=")
        if not sign:
            return None
        found[name.decode("ascii", "replace")] = value
    return found


def integer(value: bytes | None) -> int | None:
    """A number of four bytes."""
    return int.from_bytes(value, "little") if value is not None and len(value) == 4 else None


def time(value: bytes | None) -> int | None:
    """A time in ns."""
    if value is None or len(value) != 8:
        return None
    sec, nsec = struct.unpack("<II", value)
    return sec * 10**9 + nsec
