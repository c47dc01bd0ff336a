"""Files, folders and archives as parts of bytes, within bounds."""

import codecs
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from imu_fusion.errors import BagError

PIECE = 1 << 20
_SUFFIXES = (".csv", ".tsv", ".txt", ".xls", ".xlsx", ".ubx", ".nmea", ".gpx", ".ulg", ".ximu3")
_PARTS = 1000            # files of a folder or archive
_UNPACKED = 1 << 30      # bytes of an archive
_LARGEST_RATIO = 1000    # of an archive and what it unpacks to
_DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError, IndexError,
           ValueError)    # BagError is none of them
_UTF16 = codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE


def parts(path: Path, most: int | None = None, lose: Callable[[str], object] | None = None
          ) -> Iterator[tuple[str, bytes]]:
    """Yield (path, bytes) of a file, or of those in a folder or zip archive, in pieces. Text in
    UTF-16, as spreadsheets write it, comes in UTF-8.

    Args:
        path: a folder may have folders in it, one level deep.
        most: bytes of each file; None for all.
        lose: called with words on files of an archive that are damaged, of which comes what there
            is; None: that is an error.

    Raises:
        BagError: it cannot be read, or unpacks beyond all bounds.
    """
    try:
        if path.is_dir():
            files = sorted(f for pattern in ("*", "*/*") for f in path.glob(pattern)
                           if f.is_file() and _is_part(f))
            for file in files[:_PARTS]:
                yield from _pieces(file, most)
        elif zipfile.is_zipfile(path) and path.suffix.lower() not in (".xlsx", ".xls"):
            yield from _unpacked(path, most, lose)
        elif path.suffix.lower() == ".zip":
            raise BagError(f"{path}: no zip archive, or cut off: the list of its contents, at its "
                           "end, is missing; copy it again")
        else:
            yield from _pieces(path, most)
    except OSError as error:
        raise BagError(f"{path}: cannot be read ({error.strerror or error})") from None


def heads(path: Path, most: int) -> dict[str, bytes]:
    """The first bytes of each part, by its name."""
    found: dict[str, bytes] = {}
    damaged: list[str] = []
    for name, data in parts(path, most, damaged.append):
        found[name] = found.get(name, b"") + data
    if damaged and not found:
        raise BagError(f"{path}: {damaged[0]}")
    return found


def _is_part(file: Path) -> bool:
    """Whether a file may be of a device; macOS leaves others beside, called "._" and the same."""
    return file.suffix.lower() in _SUFFIXES and not file.name.startswith("._")


def _pieces(file: Path, most: int | None) -> Iterator[tuple[str, bytes]]:
    with open(file, "rb") as stream:
        for data in _read(stream, most):
            yield str(file), data


def _read(stream: IO[bytes], most: int | None) -> Iterator[bytes]:
    """The bytes of one part."""
    size = PIECE if most is None else most
    data = stream.read(size)
    head = data[:300]
    # Binary formats may begin so by chance, but have no zero in every other place.
    decoder = codecs.getincrementaldecoder("utf-16")("replace") if (
        head.startswith(_UTF16) and 3 * head.count(0) > len(head)) else None
    while data:
        yield data if decoder is None else decoder.decode(data).encode()
        data = stream.read(size) if most is None else b""


def _unpacked(path: Path, most: int | None, lose: Callable[[str], object] | None
              ) -> Iterator[tuple[str, bytes]]:
    bound = min(_UNPACKED, max(_LARGEST_RATIO * path.stat().st_size, PIECE))
    size = 0
    try:
        with zipfile.ZipFile(path) as archive:
            entries = [e for e in archive.infolist() if _is_part(Path(e.filename))]
            for entry in sorted(entries[:_PARTS], key=lambda e: e.filename):
                try:
                    with archive.open(entry) as stream:
                        for data in _read(stream, most):
                            size += len(data)
                            if size > bound:
                                raise BagError(
                                    f"{path}: unpacks to more than {bound >> 20} MB; unpack it "
                                    "yourself if that is right, and name the folder")
                            yield f"{path}/{entry.filename}", data
                except _DAMAGE as error:
                    if lose is None:
                        raise
                    lose(f"part of an archive that is damaged: {entry.filename} ({error})")
    except _DAMAGE as error:
        raise BagError(f"{path}: an archive that cannot be unpacked ({error})") from None
