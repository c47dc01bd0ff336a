"""Which files a recording is made of, and what each of them is.

The first bytes of a file say what it is; its name does where they are damaged.
"""

from collections.abc import Callable
from pathlib import Path, PurePosixPath

from imu_fusion.errors import BagError, ParameterError
from imu_fusion.parameters.bounded_yaml import read_yaml
from imu_fusion.recordings.mcap_records import MAGIC
from imu_fusion.recordings.targets import DATA_SUFFIXES, METADATA_FILE

PACKED = ".zstd"           # rosbag2's --compression-mode file
ZSTD = b"\x28\xb5\x2f\xfd"
_BEGINNINGS = {MAGIC: ".mcap", b"SQLite format 3\0": ".db3", b"#ROSBAG V": ".bag", ZSTD: PACKED}
_PACKERS = {b"\x1f\x8b": "gzip -d", b"BZh": "bzip2 -d", b"\xfd7zXZ": "xz -d",
            b"\x04\x22\x4d\x18": "lz4 -d", b"7z\xbc\xaf": "7z x"}


def kind_of(file: Path) -> str:
    """``.mcap``, ``.db3``, ``.bag``, or :data:`PACKED` (any of them); empty if it is none."""
    head = _head(file)
    for beginning, kind in _BEGINNINGS.items():
        if head.startswith(beginning):
            return kind
    name = file.name.removesuffix(".active")    # of a ROS 1 recorder that was killed
    return next((kind for kind in _BEGINNINGS.values() if name.endswith(kind)), "")


def unpacked_by(file: Path) -> str:
    """The command that unpacks a file; empty if it is not compressed."""
    head = _head(file)
    return next((tool for beginning, tool in _PACKERS.items() if head.startswith(beginning)), "")


def _head(file: Path) -> bytes:
    with open(file, "rb") as stream:
        return stream.read(16)


def is_recording(path: Path) -> bool:
    """Whether a file, or what a directory holds, is one of ours; else it may be of a device."""
    if path.is_file():
        return bool(kind_of(path))
    return any(file.name.endswith(DATA_SUFFIXES) for file in path.iterdir())


def storage_files(path: Path, mention: Callable[[str], object]) -> list[Path]:
    """The files of a recording, in order.

    Args:
        mention: called with what is wrong with its metadata.

    Raises:
        BagError: there are none.
    """
    if path.is_file():
        return [path]
    found = {suffix: sorted((p for p in path.iterdir() if p.name.endswith(suffix) and p.is_file()),
                            key=_split_index) for suffix in DATA_SUFFIXES}
    files = [file for of_suffix in found.values() for file in of_suffix]
    if not files:
        raise BagError(f"{path}: a directory without .mcap or .db3 files is not a recording")
    named = _named(path, files, mention)
    if named is not None:
        return named
    chosen = next(of_suffix for of_suffix in found.values() if of_suffix)
    if len(chosen) < len(files):
        _leave_out(set(files) - set(chosen), mention, "is of another kind")
    return chosen


def _split_index(path: Path) -> tuple[int, str]:
    """Order of the files of a split recording: by the number at their end, 2 before 10."""
    number = path.name.partition(".")[0].rpartition("_")[2]
    return (int(number) if number.isdecimal() and len(number) < 19 else 0, path.name)


def _named(path: Path, files: list[Path], mention: Callable[[str], object]) -> list[Path] | None:
    """Those of the data files that metadata.yaml names; None where it cannot be trusted."""
    if not (path / METADATA_FILE).exists():
        return None
    try:
        if not (path / METADATA_FILE).is_file():
            raise ParameterError("it is no file")
        said = read_yaml(path / METADATA_FILE)["rosbag2_bagfile_information"]
        names = [PurePosixPath(str(name)).name for name in said["relative_file_paths"]]
    except (ParameterError, KeyError, TypeError) as error:
        why = str(error) if isinstance(error, ParameterError) else "no metadata of rosbag2"
        mention(f"{METADATA_FILE} is not used: {why.removeprefix(f'{path}/')}")
        return None
    known = {file.name for file in files}
    missing = sorted(set(names) - known)
    if missing:
        mention(f"{METADATA_FILE} names {', '.join(missing[:5])}, which "
                f"{'is' if len(missing) == 1 else 'are'} not there; read is what is there")
        return None
    chosen = [file for file in files if file.name in names]
    if 0 < len(chosen) < len(files):
        _leave_out(set(files) - set(chosen), mention, f"is not named in {METADATA_FILE}")
    return chosen or None


def _leave_out(files: set[Path], mention: Callable[[str], object], why: str) -> None:
    names = sorted(file.name for file in files)
    mention(f"{', '.join(names[:5])} {why} and is left out; it can be read by its own name")
