"""What the formats of recordings have in common: files read within bounds, messages in order.

A :class:`Storage` is one file. It reads what is there, steps over what is damaged, and says once
what is lost; no length that a file claims is believed before it is compared with the bytes that
are there and with :func:`largest_chunk`.
"""

import heapq
import os
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple, Protocol

import lz4.frame
import zstandard

from imu_fusion.errors import BagError

LIMIT_VARIABLE = "IMU_FUSION_MAX_CHUNK_MB"
_LIMIT_MB = 256
_WINDOW = 1 << 20    # bytes of a file that are read at once

Row = tuple[int, str, bytes]
"""Log time in int ns, topic, CDR bytes of a message."""


@dataclass
class StoredTopic:
    """One topic of one file: ``definition`` is (text, RIHS01 hash) as far as the file tells."""

    name: str
    msgtype: str
    count: int = 0
    qos_profiles: list[dict] = field(default_factory=list)
    definition: tuple[str, str] | None = None


class DamageError(Exception):
    """A part of a file is not what it should be; the rest may be."""


class Storage:
    """One file of a recording.

    Attributes:
        topics: name to StoredTopic. times: (first, last) log time, None without messages.
        left_out: channels that are no topics of ROS 2, in words.
        lose, mention: called, while opening and while reading, with what is lost, and with what
            is wrong but costs no message.
    """

    def __init__(self, path: Path, lose: Callable[[str], object],
                 mention: Callable[[str], object]) -> None:
        self.path = path
        self.lose, self.mention = lose, mention
        self.topics: dict[str, StoredTopic] = {}
        self.times: tuple[int, int] | None = None
        self.left_out: list[str] = []

    def messages(self, topics: Collection[str], start: int | None,
                 stop: int | None) -> Iterator[Row]:
        """Yield the messages of topics in order of log time, start inclusive, stop exclusive."""
        raise NotImplementedError

    def close(self) -> None:
        """Release the file."""


class Bytes(Protocol):
    """``size`` bytes of which parts can be read."""

    size: int

    def read(self, position: int, size: int) -> bytes:
        """The ``size`` bytes at ``position``; fewer where they end."""
        ...


class Memory:
    """Bytes that are in memory."""

    def __init__(self, data: bytes) -> None:
        self._data, self.size = data, len(data)

    def read(self, position: int, size: int) -> bytes:
        """The ``size`` bytes at ``position``; fewer where they end."""
        return self._data[position:position + size]


class Window:
    """A file read through a window, so that neighbouring small reads cost one."""

    def __init__(self, path: Path) -> None:
        self._file = open(path, "rb")  # noqa: SIM115, closed by close
        self.size = os.fstat(self._file.fileno()).st_size
        self._start, self._data = 0, b""

    def read(self, position: int, size: int) -> bytes:
        """The ``size`` bytes at ``position``; fewer where the file ends."""
        size = max(min(size, self.size - position), 0)
        offset = position - self._start
        if not 0 <= offset <= len(self._data) - size:
            if size >= _WINDOW:
                return os.pread(self._file.fileno(), size, position)
            self._start, offset = position, 0
            self._data = os.pread(self._file.fileno(), _WINDOW, position)
        return self._data[offset:offset + size]

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class FileStorage(Storage):
    """A Storage that is read through a :class:`Window`, which is closed if it cannot be opened."""

    def __init__(self, path: Path, lose: Callable[[str], object],
                 mention: Callable[[str], object]) -> None:
        super().__init__(path, lose, mention)
        self._file = Window(path)
        try:
            self._open()
        except BaseException:
            self._file.close()
            raise

    def _open(self) -> None:
        """Find what the file holds."""
        raise NotImplementedError

    def close(self) -> None:
        self._file.close()


def largest_chunk() -> int:
    """Bytes that a chunk, or a message, may take when unpacked."""
    text = os.environ.get(LIMIT_VARIABLE, "")
    try:
        return round(float(text or _LIMIT_MB) * 1e6)
    except (ValueError, OverflowError):
        raise BagError(f"environment variable {LIMIT_VARIABLE}: '{text}' is not a number of MB"
                       ) from None


def unpack(data: bytes, compression: str, size: int) -> bytes:
    """The ``size`` bytes that a chunk unpacks to.

    Raises:
        DamageError: they are more or less, or more than largest_chunk().
    """
    if size > largest_chunk():
        raise DamageError(f"it would unpack to {size / 1e6:.0f} MB, more than the bound of "
                          f"{largest_chunk() / 1e6:.0f} MB: raise it by --max-chunk-mb, or by "
                          f"{LIMIT_VARIABLE} in the environment, if that is right")
    try:
        if compression == "zstd":
            with zstandard.ZstdDecompressor().stream_reader(data) as stream:
                found = stream.read(size + 1)
        elif compression == "lz4":
            found = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        elif compression in ("", "none"):
            found = data
        else:
            raise DamageError(f"its compression '{compression[:20]}' is not known")
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError, MemoryError) as error:
        raise DamageError(f"it cannot be unpacked ({error})") from None
    if len(found) != size:
        raise DamageError(f"it unpacks to another size than the {size} bytes stated")
    return found


def span(first: int | None, last: int | None) -> str:
    """A stretch of log times in words."""
    def moment(stamp):
        text = f"{stamp // 10**9}.{stamp % 10**9:09d}"
        try:
            return f"{text} ({datetime.fromtimestamp(stamp // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC)"
        except (ValueError, OverflowError, OSError):
            return text

    if first is None and last is None:
        return "log times unknown"
    if first is None:
        return f"log times before {moment(last)}"
    if last is None:
        return f"log times after {moment(first)}"
    return f"log times {moment(first)} to {moment(last)}"


class Part(NamedTuple):
    """Messages that come no earlier than ``start``: ``rows`` makes an iterator in their order,
    which keeps ``size`` bytes in memory."""

    start: int
    size: int
    rows: Callable[[], Iterator[Row]]


def in_order(parts: Iterable[Part]) -> Iterator[Row]:
    """The rows of all parts in order of log time; each part is opened when its turn comes.

    Parts that overlap are open together as long as they take no more than twice largest_chunk().
    """
    waiting = sorted(enumerate(parts), key=lambda pair: (pair[1].start, pair[0]), reverse=True)
    bound, taken = 2 * largest_chunk(), 0
    heap: list[tuple[int, int, Row, Iterator[Row], int]] = []
    while waiting or heap:
        if waiting and (not heap or (waiting[-1][1].start <= heap[0][0]
                                     and taken + waiting[-1][1].size <= bound)):
            number, part = waiting.pop()
            rows = part.rows()
            row = next(rows, None)
            if row is not None:
                heapq.heappush(heap, (row[0], number, row, rows, part.size))
                taken += part.size
            continue
        _, number, row, rows, size = heap[0]
        yield row
        following = next(rows, None)
        if following is None:
            heapq.heappop(heap)
            taken -= size
        else:
            heapq.heapreplace(heap, (following[0], number, following, rows, size))
