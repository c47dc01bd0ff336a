"""What all formats share: a :class:`Source` makes samples of bytes.

However the bytes are cut, the samples are the same: what is not complete waits for the rest,
within a bound. So a driver that takes a stream in pieces and a conversion of the file that the
device wrote of the same session give equal samples.
"""

import re
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from imu_fusion.errors import SampleError
from imu_fusion.samples.logs import Log

IMU_TOPIC, MAG_TOPIC, FIX_TOPIC = "imu/data_raw", "imu/mag", "fix"
VELOCITY_TOPIC, REFERENCE_TOPIC, ARRAY_TOPIC = "fix_velocity", "reference/pose", "accelerometers/"

STANDARD_GRAVITY = 9.80665
NO_FIX, FIXED = -1, 0    # sensor_msgs/NavSatStatus
#: Stamps of devices that count from when they were switched on begin here.
EPOCH = 1_600_000_000_000_000_000
#: Share of the rows of a table; where more are broken it is not the rows that are wrong.
BROKEN = 0.15
LONGEST_LINE = 1 << 16   # bytes
LARGEST_WHOLE = 1 << 30  # bytes of a format that can only be read as a whole
# Python's own numbers would also be 1_0 and digits of other scripts.
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_PLAIN = re.compile(r"[-+.0-9eE]*")
_NOT_FINITE = ("nan", "inf", "-inf", "+inf")


class Block(NamedTuple):
    """Samples of one topic, in the order in which the device sent them: ``topic`` is relative,
    ``log`` of the kind that belongs to its message, ``clock`` names the clock of its stamps where a
    device has several."""

    topic: str
    log: Log
    clock: str = ""


class Source:
    """Bytes of one device, or of its export, to samples.

    Args:
        strict: whether what cannot be read is an error, as in a file, or left out and counted,
            as in a stream.

    ``lost`` counts, in words, what was left out; ``remarks`` are texts about what was assumed.
    ``device`` names the device as far as it has told, ``topics`` are those that it may have.
    """

    topics: tuple[str, ...] = (IMU_TOPIC, MAG_TOPIC, FIX_TOPIC, VELOCITY_TOPIC)

    def __init__(self, strict: bool = True) -> None:
        self.strict = strict
        self.lost: Counter[str] = Counter()
        self.remarks: list[str] = []
        self.device = ""

    def feed(self, data: bytes, part: str = "") -> list[Block]:
        """Take more bytes; return what has become complete.

        Args:
            data: bytes, cut anywhere.
            part: which of several streams they belong to: the name of a file in a folder or an
                archive, or of what was asked for.

        Raises:
            SampleError: they are not what they should be, if ``strict``.
        """
        raise NotImplementedError

    def finish(self) -> list[Block]:
        """Nothing more comes; return what that completes."""
        return []

    def restart(self) -> None:
        """The connection was lost: what was incomplete will not be completed."""

    def request(self) -> str | None:
        """What a device that has to be asked is asked next, a path of HTTP; None: nothing."""
        return None

    def lose(self, what: str, where: str = "") -> None:
        """Leave something out: an error if strict, else counted under ``what``."""
        if self.strict:
            raise SampleError(f"{where}: {what}" if where else what)
        self.lost[what] += 1

    def remark(self, text: str) -> None:
        """Say something, once."""
        if text not in self.remarks:
            self.remarks.append(text)


class Lines:
    """Cuts bytes into lines, numbered from 1; a longer one than LONGEST_LINE is cut up."""

    def __init__(self, first: int = 1) -> None:
        self._rest = b""
        self._number = first - 1

    def feed(self, data: bytes) -> list[tuple[int, str]]:
        """The lines that are complete now, without their ends."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST_LINE:
            lines, self._rest = [*lines, self._rest], b""
        return [self._line(line) for line in lines]

    def finish(self) -> list[tuple[int, str]]:
        """The last line, if nothing ended it."""
        rest, self._rest = self._rest, b""
        return [self._line(rest)] if rest else []

    def _line(self, line: bytes) -> tuple[int, str]:
        self._number += 1
        if self._number == 1:
            line = line.removeprefix(b"\xef\xbb\xbf")
        return self._number, decoded(line.rstrip(b"\r"))


def decoded(line: bytes) -> str:
    """The text of a line: UTF-8, or else the code page of Windows in the west, in which a degree
    sign is one byte."""
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        return line.decode("cp1252", "replace")


class WholeSource(Source):
    """A format that can only be read as a whole: :meth:`finish` makes the samples of ``parts``."""

    def __init__(self, strict: bool = True) -> None:
        super().__init__(strict)
        self.parts: dict[str, bytearray] = {}
        self._size = 0

    def feed(self, data: bytes, part: str = "") -> list[Block]:
        self._size += len(data)
        if self._size > LARGEST_WHOLE:
            raise SampleError(f"{part}: more than {LARGEST_WHOLE >> 20} MB, which this format "
                              "would need in memory at once")
        self.parts.setdefault(part, bytearray()).extend(data)
        return []


def numbers(where: str, name: str, lines: list[int], texts: list[str]) -> np.ndarray:
    """(n,) float64 of the texts of a column, NaN where they are empty.

    Raises:
        SampleError: names ``where``, the line and the column ``name`` of what is no number.
    """
    if all(texts) and _PLAIN.fullmatch("".join(texts)):
        try:
            return np.array(texts, dtype=np.float64)
        except ValueError:
            pass
    return np.array([number(where, name, line, text) for line, text in zip(lines, texts)])


def number(where: str, name: str, line: int, text: str) -> float:
    """The number that a text is, NaN if it is empty; SampleError as in :func:`numbers`."""
    text = text.strip()
    if not text:
        return np.nan
    if not is_number(text):
        raise SampleError(f"{where}, line {line}, column '{name}': '{text[:40]}' is not a number")
    return float(text)


def is_number(text: str) -> bool:
    """Whether a text is a number, in decimal digits, or one of the words for what is none."""
    return bool(_NUMBER.fullmatch(text)) or text.lower() in _NOT_FINITE


def named(blocks: Mapping[str, Log]) -> list[Block]:
    """Blocks of those topics that have samples."""
    return [Block(topic, log) for topic, log in blocks.items() if len(log)]
