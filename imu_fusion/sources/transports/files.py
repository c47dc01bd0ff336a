"""Files, folders and archives as parts of bytes, within bounds."""

import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

from imu_fusion.errors import BagError

PIECE = 1 << 20
_SUFFIXES = (".csv", ".tsv", ".txt", ".xls", ".xlsx", ".ubx", ".nmea", ".gpx", ".ulg", ".ximu3")
_PARTS = 1000            # files of a folder or archive
_UNPACKED = 1 << 30      # bytes of an archive
_LARGEST_RATIO = 1000    # of an archive and what it unpacks to


def parts(path: Path, most: int | None = None) -> Iterator[tuple[str, bytes]]:
    """Yield (path, bytes) of a file, or of those in a folder or zip archive, in pieces.

    Args:
        path: a folder may have folders in it, one level deep.
        most: bytes of each file; None for all.

    Raises:
        BagError: it cannot be read, or unpacks beyond all bounds.
    """
    try:
        if path.is_dir():
            files = sorted(f for pattern in ("*", "*/*") for f in path.glob(pattern)
                           if f.is_file() and f.suffix.lower() in _SUFFIXES)
            for file in files[:_PARTS]:
                yield from _pieces(file, most)
        elif zipfile.is_zipfile(path) and path.suffix.lower() not in (".xlsx", ".xls"):
            yield from _unpacked(path, most)
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
    for name, data in parts(path, most):
        found[name] = found.get(name, b"") + data
    return found


def _pieces(file: Path, most: int | None) -> Iterator[tuple[str, bytes]]:
    with open(file, "rb") as stream:
        while data := stream.read(PIECE if most is None else most):
            yield str(file), data
            if most is not None:
                return


def _unpacked(path: Path, most: int | None) -> Iterator[tuple[str, bytes]]:
    bound = min(_UNPACKED, max(_LARGEST_RATIO * path.stat().st_size, PIECE))
    size = 0
    try:
        with zipfile.ZipFile(path) as archive:
            entries = [e for e in archive.infolist()
                       if Path(e.filename).suffix.lower() in _SUFFIXES]
            for entry in sorted(entries[:_PARTS], key=lambda e: e.filename):
                with archive.open(entry) as stream:
                    while data := stream.read(PIECE if most is None else most):
                        size += len(data)
                        if size > bound:
                            raise BagError(f"{path}: unpacks to more than {bound >> 20} MB; unpack "
                                           "it yourself if that is right, and name the folder")
                        yield f"{path}/{entry.filename}", data
                        if most is not None:
                            break
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError,
            IndexError, ValueError) as error:
        raise BagError(f"{path}: an archive that cannot be unpacked ({error})") from None
