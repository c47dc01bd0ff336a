"""Reading recordings: rosbag2 (MCAP, sqlite3) and ROS 1 bags, whole or damaged.

One reader for each format (:mod:`~imu_fusion.recordings.mcap_storage`,
:mod:`~imu_fusion.recordings.sqlite_storage`, :mod:`~imu_fusion.recordings.ros1_storage`) steps
over what is damaged. The data files are what counts; metadata.yaml only says which of them belong
together, and where it contradicts them it is said and not believed.
"""

import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import zstandard

from imu_fusion.errors import BagError, ImuFusionError, MessageError, TopicError, shown
from imu_fusion.messages.nested import Nested, nested
from imu_fusion.messages.typestore import TYPES
from imu_fusion.parameters.bounded_yaml import read_yaml
from imu_fusion.recordings.files import (
    PACKED,
    ZSTD,
    is_recording,
    kind_of,
    storage_files,
    unpacked_by,
)
from imu_fusion.recordings.mcap_storage import McapStorage
from imu_fusion.recordings.ros1_storage import Ros1Storage
from imu_fusion.recordings.source_storage import SourceStorage, format_of
from imu_fusion.recordings.sqlite_storage import SqliteStorage
from imu_fusion.recordings.storage import (
    DamageError,
    Part,
    Storage,
    StoredTopic,
    in_order,
    largest_chunk,
    unpack,
)
from imu_fusion.recordings.targets import METADATA_FILE

_STORAGES: dict[str, type[Storage]] = {
    ".mcap": McapStorage, ".db3": SqliteStorage, ".bag": Ros1Storage}
_LARGEST_RATIO = 1000      # of a file and what it unpacks to
_PIECE = 1 << 17           # a block of zstd: what comes before a broken one is kept


Lose = Callable[[str], object]
"""Called with texts on what of a recording cannot be read."""


@dataclass
class TopicInfo:
    """One topic of a recording; ``count`` is what its index says, where it has one."""

    name: str
    msgtype: str
    count: int
    qos_profiles: list[dict] = field(default_factory=list)


def open_bag(path: str | Path, description: str | Path | None = None,
             remap: Mapping[str, str] | None = None) -> "Reader":
    """Open a recording for reading: a context manager with ``topics`` and ``messages``.

    Args:
        path: a rosbag2 directory, an ``.mcap`` or ``.db3`` file (also ``.mcap.zstd``,
            ``.db3.zstd``), a ROS 1 ``.bag``, or what a device has written in one of the formats of
            :mod:`imu_fusion.sources.registry`.
        description: YAML file that says what a table of a device holds, or what the export of a
            device does not tell.
        remap: names of topics to those in the recording; see :meth:`Reader.rename`.

    Raises:
        BagError: nothing there, not a recording, or damaged beyond reading.
        TopicError: ``remap`` names a topic that is not there.
        SampleError, ParameterError: the file of a device, or the description, is not usable.
    """
    path = Path(path)
    reader = Reader(path)
    try:
        try:
            if not path.exists():
                raise BagError(f"{path}: no such file or directory")
            if not (path.is_file() or path.is_dir()):
                raise BagError(f"{path}: neither a file nor a directory")
            if description is not None or not is_recording(path):
                reader.open_source(description)
            else:
                reader.open(storage_files(path, reader.mention))
        except ImuFusionError:
            raise
        except (OSError, ValueError) as error:    # ValueError: a name that no file can have
            raise BagError(f"{path}: cannot be read ({error})") from None
        except Exception as error:
            raise BagError(f"{path}: damaged beyond reading ({type(error).__name__}: {error})"
                           ) from error
        reader.rename(remap or {})
    except BaseException:
        reader.close()
        raise
    return reader


class Reader:
    """A recording; ``warnings`` says what is wrong with it, as far as it is known by now: what is
    damaged inside is found while it is read. ``losses`` are those of them that cost messages,
    ``format`` what a device's file was taken for. ``recorded`` maps topics that go by another name
    to the one in the recording."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.topics: dict[str, TopicInfo] = {}
        self.start_time = self.end_time = 0
        self.warnings: list[str] = []
        self.losses: list[str] = []
        self.format = ""
        self.recorded: dict[str, str] = {}
        self._nested: dict[str, tuple[str, Nested]] = {}    # topic.field: (topic, what is there)
        self._storages: list[Storage] = []
        self._stored: dict[str, StoredTopic] = {}
        self._temporary: list[tempfile.TemporaryDirectory] = []

    def __enter__(self) -> "Reader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self, files: list[Path]) -> None:
        """Open the files of the recording; see :func:`open_bag`."""
        if all(file.stat().st_size == 0 for file in files):
            raise BagError(f"{self.path}: the recording is empty (0 bytes); nothing was written "
                           "to it")
        for file in files:
            if file.stat().st_size == 0:
                self.lose(f"{file.name} is empty (0 bytes)")
                continue
            try:
                self._open_file(file)
            except BagError as error:
                if len(files) == 1:
                    raise
                self.lose(f"{file.name} is left out: {error}")
        if not self._storages:
            raise BagError(f"{self.path}: none of its files can be read "
                           f"({'; '.join(self.warnings)})")
        times = [time for storage in self._storages for time in storage.times or ()]
        if times:
            self.start_time, self.end_time = min(times), max(times) + 1
        left_out = list(dict.fromkeys(n for s in self._storages for n in s.left_out))
        if not self.topics and left_out:
            raise BagError(f"{self.path}: no topics of ROS 2 that can be read; it has "
                           f"{_listing(left_out)}")
        if left_out:
            self.warnings.append(f"no topics of ROS 2, left out: {_listing(left_out)}")
        if not self.topics and self.damaged:
            raise BagError(f"{self.path}: damaged, and nothing could be recovered "
                           f"({'; '.join(self.warnings)})")

    def _open_file(self, file: Path) -> None:
        """Open one of the files of the recording."""
        kind, plain = kind_of(file), file
        if kind == PACKED:
            plain = self._plain(file)
            kind = kind_of(plain)
        try:
            if kind not in _STORAGES:
                raise BagError(f"{plain}: unpacks to no recording")
            storage = _STORAGES[kind](plain, self.lose, self.mention)
        except BagError as error:
            raise BagError(str(error).replace(str(plain), str(file))) from None
        self._storages.append(storage)
        self._add(storage)

    def open_source(self, description: str | Path | None = None) -> None:
        """Open what a device has written; see :func:`open_bag`."""
        known = format_of(self.path)
        content = None if description is None else read_yaml(description)
        if known is None and description is None:
            if self.path.is_dir():
                raise BagError(f"{self.path}: a directory without .mcap or .db3 files is not a "
                               "recording" + (f": {METADATA_FILE} is there, and none of the files "
                                              "that it describes"
                                              if (self.path / METADATA_FILE).exists() else
                                              ", and it holds no export of a device that is known"))
            tool = unpacked_by(self.path)
            if tool:
                raise BagError(f"{self.path}: compressed; unpack it first ({tool})")
            raise BagError(f"{self.path}: not a recording; expected a rosbag2 directory, a .mcap, "
                           ".db3 or .bag file, or the export of a device. A table of numbers "
                           "needs a description: imu_fusion describe writes a first one")
        # Where there is a description, a table is read as that says.
        if content is not None and (known is None or not known.options):
            known = None
        self.format = "table as described" if known is None else known.about
        self._storages.append(SourceStorage(self.path, self.lose, self.mention, known, content,
                                            str(description)))
        self._add(self._storages[0])
        assert self._storages[0].times is not None
        self.start_time, self.end_time = self._storages[0].times
        self.end_time += 1

    def rename(self, remap: Mapping[str, str]) -> None:
        """Call topics by other names from here on. One that has such a name already cannot be seen
        any more; ``warnings`` says so.

        Args:
            remap: new names to those in the recording, also of messages inside of others; see
                :meth:`find`.

        Raises:
            TopicError: a topic is not there.
        """
        taken = {name: self.require(other).name for name, other in remap.items()}
        infos = {name: self.topics[other] for name, other in taken.items()}
        for other in taken.values():
            self.topics.pop(other, None)
        for name, info in infos.items():
            hidden = find_topic(self.topics, name)
            if hidden is not None:
                self.mention(f"{hidden} of the recording is left out: {info.name} goes by its name")
                del self.topics[hidden]
            self.recorded[name] = info.name
            self.topics[name] = replace(info, name=name)

    def close(self) -> None:
        """Release the files."""
        for storage in self._storages:
            storage.close()
        for folder in self._temporary:
            folder.cleanup()
        self._storages, self._temporary = [], []

    def messages(self, topics: Collection[str] | None = None, start: int | None = None,
                 stop: int | None = None) -> Iterator[tuple[str, str, int, bytes]]:
        """Yield (topic, msgtype, log time int nanoseconds, CDR bytes) in order of log time.

        Args:
            topics: names to yield; None for all.
            start, stop: bounds of the log time, start inclusive, stop exclusive.

        Raises:
            BagError: the file can no longer be read. What is damaged in it is no error but left
                out: see ``warnings``.
        """
        shown = {self.recorded.get(name, name): info for name, info in self.topics.items()
                 if topics is None or name in topics}
        fields = {name: self._nested[name] for name in shown if name in self._nested}
        asked = shown.keys() - fields.keys()
        wanted = asked | {topic for topic, _ in fields.values()}
        parts = [Part(storage.times[0] if storage.times else 0, 0,
                      partial(storage.messages, wanted, start, stop))
                 for storage in self._storages]
        rows = in_order(parts) if len(parts) > 1 else parts[0].rows()
        try:
            for log_time, topic, data in rows:
                if data[:4] == ZSTD:    # rosbag2's --compression-mode message; CDR never does
                    unpacked = self._unpacked(topic, data)
                    if unpacked is None:
                        continue
                    data = unpacked
                if topic in asked:
                    yield shown[topic].name, shown[topic].msgtype, log_time, data
                for name, (holder, member) in fields.items():
                    if holder == topic:
                        try:
                            yield (shown[name].name, member.msgtype, log_time,
                                   member.extract(data))
                        except MessageError as error:
                            self.lose(f"{name}: messages cannot be decoded and are left out "
                                      f"({error})")
        except ImuFusionError:
            raise
        except Exception as error:
            raise BagError(f"{self.path}: damaged beyond reading ({type(error).__name__}: {error})"
                           ) from error

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(info.count for info in self.topics.values())

    def require(self, name: str, msgtype: str | None = None) -> TopicInfo:
        """The TopicInfo of ``name`` (with or without leading slash), or a TopicError."""
        key = self.find(name)
        if key is None:
            listing = ", ".join(f"{t.name} ({t.msgtype})" for t in self.topics.values()) or "none"
            raise TopicError(f"{self.path}: no topic '{name}'; it has: {listing}")
        info = self.topics[key]
        if msgtype and info.msgtype != msgtype:
            raise TopicError(f"{self.path}: topic '{name}' is {info.msgtype}, expected {msgtype}")
        return info

    def find(self, name: str) -> str | None:
        """The topic that ``name`` is up to a leading slash, or None. ``topic.field`` is a message
        inside of those of a topic, such as a sensor_msgs/Imu in the message of a driver."""
        found = find_topic(self.topics, name)
        if found is not None:
            return found
        holder, field = name, ""
        while "." in holder:
            holder, _, last = holder.rpartition(".")
            field = f"{last}.{field}".rstrip(".")
            topic = find_topic(self.topics, holder)
            definition = None if topic is None else self.definition(topic)
            if topic is None or definition is None:
                continue
            inside = nested(self.topics[topic].msgtype, definition[0], field)
            if inside is not None:
                full = f"{topic}.{field}"
                self._nested[full] = self.recorded.get(topic, topic), inside
                self._stored[full] = StoredTopic(full, inside.msgtype)
                self.topics[full] = TopicInfo(full, inside.msgtype, self.topics[topic].count,
                                              self.topics[topic].qos_profiles)
                return full
        return None

    def definition(self, topic: str) -> tuple[str, str] | None:
        """(ros2msg definition with its dependencies, RIHS01 hash) of the type of a topic, as the
        recording has it, else as ROS 2 Jazzy does; None if neither knows it."""
        info = self._stored[self.recorded.get(topic, topic)]
        if info.definition is None and info.msgtype in TYPES.fielddefs:
            info.definition = (TYPES.generate_msgdef(info.msgtype, ros_version=2)[0],
                               TYPES.hash_rihs01(info.msgtype))
        return info.definition

    def _add(self, storage: Storage) -> None:
        """The topics of one more file."""
        for name, stored in storage.topics.items():
            # Line breaks and escapes would speak to the terminal.
            if not (name.isprintable() and stored.msgtype.isprintable()):
                storage.left_out.append(f"{ascii(name)} ({ascii(stored.msgtype)})")
                continue
            info = self.topics.get(name)
            if info is None:
                self._stored[name] = stored
                self.topics[name] = TopicInfo(name, stored.msgtype, stored.count,
                                              stored.qos_profiles)
            elif info.msgtype == stored.msgtype:
                info.count += stored.count
            else:
                self.lose(f"{storage.path.name}: topic {name} is {stored.msgtype} there, and "
                           f"{info.msgtype} in other files; read as the latter")

    @property
    def damaged(self) -> bool:
        """Whether messages are lost, as far as is known by now."""
        return bool(self.losses)

    def lose(self, text: str) -> None:
        """Say, once, that a part of the recording cannot be used."""
        if shown(text) not in self.losses:
            self.losses.append(shown(text))
        self.mention(text)

    def mention(self, text: str) -> None:
        """Say something, once, that costs no message."""
        text = shown(text)
        if text not in self.warnings:
            self.warnings.append(text)

    def _plain(self, file: Path) -> Path:
        """A temporary unpacked copy of a file that was compressed as a whole."""
        folder = tempfile.TemporaryDirectory(prefix="imu_fusion_")    # cleaned up by close
        self._temporary.append(folder)
        plain = Path(folder.name, file.stem)
        bound = max(_LARGEST_RATIO * file.stat().st_size, largest_chunk())
        size = 0
        try:
            with (open(file, "rb") as stream, open(plain, "wb") as target,
                  zstandard.ZstdDecompressor().stream_reader(stream) as unpacked):
                while data := unpacked.read(_PIECE):
                    size += len(data)
                    if size > bound:
                        raise BagError(f"{file}: unpacks to more than {_LARGEST_RATIO} times its "
                                       "size; unpack it yourself (zstd -d) if that is right")
                    target.write(data)
        except zstandard.ZstdError as error:
            self.lose(f"{file.name}: damaged ({error}); what unpacks before is read")
        if not size:
            raise BagError(f"{file}: cannot be unpacked, it is no zstd file or damaged at its "
                           "beginning")
        return plain

    def _unpacked(self, topic: str, data: bytes) -> bytes | None:
        """A message that was compressed by itself; None, and a warning, if it is broken."""
        try:
            size = zstandard.frame_content_size(data)
            if size < 0:
                raise DamageError("its size is not stated")
            return unpack(data, "zstd", size)
        except (DamageError, zstandard.ZstdError) as error:
            self.lose(f"topic {topic}: compressed messages are broken and left out ({error})")
            return None


def _listing(names: list[str]) -> str:
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return ", ".join(name[:120] for name in names[:5]) + more


def find_topic(names: Iterable[str], wanted: str) -> str | None:
    """The entry of ``names`` that is ``wanted`` up to a leading slash, or None."""
    for candidate in (wanted, "/" + wanted.lstrip("/"), wanted.lstrip("/")):
        if candidate in names:
            return candidate
    return None
