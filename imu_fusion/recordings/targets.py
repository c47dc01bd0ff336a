"""Where a recording may be written: not over what it is made of, nor over other files."""

import contextlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from imu_fusion.errors import BagError, ParameterError
from imu_fusion.parameters.file import read_yaml

METADATA_FILE = "metadata.yaml"
RESULTS_FILE = "results.json"
LIBRARY = "imu_fusion"    # what the header of our MCAP files names

# What we write into the directory of a recording beside its files.
_REPORT = "report.html"
_BESIDE = (METADATA_FILE, RESULTS_FILE, _REPORT)
_HEADER = 256             # bytes of an MCAP file in which its header names the library
DATA_SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")


def refuse_source(source: str | Path, out: str | Path) -> None:
    """Refuse an ``out`` whose replacement could take ``source`` with it.

    Raises:
        BagError: ``out`` is the source, contains it or lies in it; also through symbolic links,
            and where both hold the same file under two names (hard links).
    """
    source, out = (Path(os.path.realpath(path)) for path in (source, out))    # also through loops
    if source == out or source in out.parents or out in source.parents or (
            out.exists() and set(_identities(source)) & set(_identities(out))):
        raise BagError(f"{out}: is, contains or lies in the source {source}, which would be "
                       "destroyed; choose another name for the result")


def refuse_files(sources: Iterable[str | Path | None], out: str | Path) -> None:
    """Refuse to write the file ``out`` over one of the files read.

    Raises:
        BagError: names both.
    """
    out = Path(out)
    if not out.exists():
        return
    for source in sources:
        if source is not None and set(_identities(Path(source))) & set(_identities(out)):
            raise BagError(f"{out}: is read as {source} and would be overwritten; choose another "
                           "name for the result")


def _identities(path: Path) -> Iterator[tuple[int, int]]:
    """Device and inode of a file, or of the files below a directory, but for reports: nobody reads
    these."""
    if path.is_dir():
        for folder, _, names in os.walk(path):
            yield from (found for name in names if name != _REPORT
                        for found in _identities(Path(folder) / name))
    else:
        try:
            status = path.stat()
        except OSError:    # a link that leads nowhere
            return
        yield status.st_dev, status.st_ino


@contextlib.contextmanager
def whole_file(path: str | Path, begins: str = "") -> Iterator[Path]:
    """A file to write, which takes the place of ``path`` when it is complete: where the context is
    left by an exception, what was there stays, and nothing is left beside it.

    Args:
        begins: what the files begin with that may be replaced; empty: any may.

    Raises:
        BagError: it cannot be written, or something else is in its place.
    """
    target = Path(os.path.realpath(path))    # of a link what it leads to
    part = target.with_name(f".part-{os.getpid()}{target.suffix}")
    try:
        if target.exists() and not target.is_file():
            part = target    # /dev/stdout, which is written to and not replaced
        elif target.exists() and target.stat().st_size:
            with open(target, "rb") as stream:
                if stream.read(len(begins.encode())) != begins.encode():
                    raise BagError(f"{path}: exists already and is something else; choose another "
                                   "name")
        yield part
        if part != target:
            os.replace(part, target)
    except OSError as error:
        raise BagError(f"{path}: cannot be written ({error.strerror})") from None
    finally:
        if part != target:
            with contextlib.suppress(OSError):
                part.unlink()


def make_parents(target: Path) -> list[Path]:
    """Make the folders that a target shall stand in; those made, innermost first."""
    missing = [folder for folder in target.parents if not folder.exists()]
    target.parent.mkdir(parents=True, exist_ok=True)
    return missing


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove those of the folders that hold nothing, innermost first."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


def why_not_replaced(directory: Path) -> str:
    """Why a directory must not be replaced; empty if it is one recording and nothing else.

    A recording is what the metadata of rosbag2 describes, or the one file that our writer has
    left without metadata.
    """
    names = {path.name for path in directory.iterdir()}
    data = {name for name in names if name.endswith(DATA_SUFFIXES)}
    others = sorted(names - data - set(_BESIDE))
    if others:
        return f"it holds other files, such as {others[0]}"
    if METADATA_FILE not in names:
        only = data == {f"{directory.name}_0.mcap"}
        return "" if only and _is_ours(directory / data.pop()) else (
            f"without {METADATA_FILE} it is a folder of files, not a recording")
    try:
        said = read_yaml(directory / METADATA_FILE)["rosbag2_bagfile_information"]
        described = {Path(str(name)).name for name in said["relative_file_paths"]}
    except (ParameterError, KeyError, TypeError):
        return f"its {METADATA_FILE} does not describe a recording"
    undescribed = sorted(data - described)
    return f"its {METADATA_FILE} does not name {undescribed[0]}" if undescribed else ""


def _is_ours(file: Path) -> bool:
    with open(file, "rb") as stream:
        return LIBRARY.encode() in stream.read(_HEADER)
