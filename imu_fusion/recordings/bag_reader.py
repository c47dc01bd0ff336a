"""Reading recordings: rosbag2 (MCAP, sqlite3) and ROS 1 bags.

Goes through ``rosbags``; a file without its closing index (power loss, ``kill -9``) is read chunk
by chunk with ``mcap``.
"""

import struct
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import mcap.exceptions
import mcap.records
import yaml
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.msg import normalize_msgtype

from imu_fusion.errors import BagError, TopicError
from imu_fusion.messages.typestore import TYPES
from imu_fusion.recordings.qos import qos_profile


@dataclass
class TopicInfo:
    """One topic of a recording; ``count`` is None while it is not known."""

    name: str
    msgtype: str
    count: int | None
    qos_profiles: list[dict] = field(default_factory=list)


def open_bag(path: str | Path) -> "Reader":
    """Open a recording for reading: a context manager with ``topics`` and ``messages``.

    Args:
        path: a rosbag2 directory, an ``.mcap`` or ``.db3`` file, or a ROS 1 ``.bag``.

    Raises:
        BagError: nothing there, not a recording, or damaged beyond reading.
    """
    path = Path(path)
    if not path.exists():
        raise BagError(f"{path}: no such file or directory")
    files, directory = _storage_files(path)
    if all(f.stat().st_size == 0 for f in files):
        raise BagError(f"{path}: the recording is empty (0 bytes); nothing was written to it")
    try:
        return _IndexedReader(path, directory or files[0])
    except (AnyReaderError, OSError, KeyError, ValueError, struct.error) as error:
        if files[0].suffix != ".mcap":
            raise BagError(f"{path}: cannot be read ({error})") from None
        reason = error
    reader = _RecoveringReader(path, files, reason)
    if not reader.topics:
        raise BagError(f"{path}: damaged, and no complete chunk could be recovered ({reason})")
    return reader


def _storage_files(path):
    """(the storage files, the rosbag2 directory if it has its metadata)."""
    if path.is_file():
        if path.suffix not in (".mcap", ".db3", ".bag"):
            raise BagError(f"{path}: not a recording; expected a rosbag2 directory or a "
                           ".mcap, .db3 or .bag file")
        return [path], None
    for suffix in (".mcap", ".db3"):
        files = sorted(path.glob(f"*{suffix}"), key=_split_index)
        if files:
            return files, path if (path / "metadata.yaml").exists() else None
    raise BagError(f"{path}: a directory without .mcap or .db3 files is not a recording")


def _split_index(path):
    """Order of the files of a split recording: by the number at their end, 2 before 10."""
    number = path.stem.rpartition("_")[2]
    return (int(number) if number.isdigit() else 0, path.name)


class Reader:
    """What every reader offers; ``warnings`` says what is wrong with the recording."""

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self.topics: dict[str, TopicInfo] = {}
        self.start_time = self.end_time = 0
        self.warnings: list[str] = []
        self.typestore = TYPES

    def __enter__(self) -> "Reader":
        return self

    def __exit__(self, *_):
        self.close()

    def close(self) -> None:
        """Release the files."""

    def messages(self, topics: Collection[str] | None = None, start: int | None = None,
                 stop: int | None = None) -> Iterator[tuple[str, str, int, bytes]]:
        """Yield (topic, msgtype, log time int nanoseconds, CDR bytes) in order of log time.

        Args:
            topics: names to yield; None for all.
            start, stop: bounds of the log time, start inclusive, stop exclusive.
        """
        raise NotImplementedError

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(info.count or 0 for info in self.topics.values())

    def require(self, name: str, msgtype: str | None = None) -> TopicInfo:
        """The TopicInfo of ``name`` (with or without leading slash), or a TopicError."""
        key = find_topic(self.topics, name)
        if key is None:
            listing = ", ".join(f"{t.name} ({t.msgtype})" for t in self.topics.values()) or "none"
            raise TopicError(f"{self.path}: no topic '{name}'; it has: {listing}")
        info = self.topics[key]
        if msgtype and info.msgtype != msgtype:
            raise TopicError(f"{self.path}: topic '{name}' is {info.msgtype}, expected {msgtype}")
        return info

    def definition(self, msgtype: str) -> tuple[str, str]:
        """(ros2msg definition with its dependencies, RIHS01 hash) of a type in this recording."""
        return self.typestore.generate_msgdef(msgtype, ros_version=2)[0], \
            self.typestore.hash_rihs01(msgtype)


def find_topic(names: Iterable[str], wanted: str) -> str | None:
    """The entry of ``names`` that is ``wanted`` up to a leading slash, or None."""
    for candidate in (wanted, "/" + wanted.lstrip("/"), wanted.lstrip("/")):
        if candidate in names:
            return candidate
    return None


class _IndexedReader(Reader):
    """A complete recording, through rosbags."""

    def __init__(self, path, source):
        super().__init__(path)
        self._reader = AnyReader([source], default_typestore=TYPES)
        self._reader.open()
        try:
            self._is_ros1 = not self._reader.is2
            if not self._is_ros1:
                self.typestore = self._reader.typestore
            for name, info in self._reader.topics.items():
                if info.msgtype is None:
                    kinds = sorted({c.msgtype for c in info.connections})
                    self.warnings.append(f"topic {name} holds several types ({', '.join(kinds)}) "
                                         "and is left out")
                    continue
                qos = [] if self._is_ros1 else _qos_of(info.connections[0])
                self.topics[name] = TopicInfo(name, info.msgtype, info.msgcount, qos)
            if any(info.count for info in self.topics.values()):
                self.start_time = self._reader.start_time
                self.end_time = self._reader.end_time
        except BaseException:
            self._reader.close()
            raise

    def close(self):
        self._reader.close()

    def messages(self, topics=None, start=None, stop=None):
        wanted = self.topics if topics is None else topics
        connections = [c for c in self._reader.connections
                       if c.topic in wanted and c.topic in self.topics]
        if not connections:
            return
        try:
            for connection, log_time, data in self._reader.messages(connections, start, stop):
                if self._is_ros1:
                    data = bytes(TYPES.ros1_to_cdr(data, connection.msgtype))
                yield connection.topic, connection.msgtype, log_time, data
        except KeyError as error:
            raise BagError(f"{self.path}: type {error} is not known; only ROS 2 Jazzy's own types "
                           "can be read from a ROS 1 bag") from None
        except Exception as error:
            if isinstance(error, (AnyReaderError, OSError, struct.error, ValueError,
                                  AssertionError)) or "Error" in type(error).__name__:
                raise BagError(f"{self.path}: damaged while reading ({error}); "
                               "try imu_fusion info --repair") from error
            raise


def _qos_of(connection):
    return [qos_profile(q.depth, q.reliability.name.lower(), q.durability.name.lower(),
                        q.history.name.lower())
            for q in getattr(connection.ext, "offered_qos_profiles", [])]


class _RecoveringReader(Reader):
    """MCAP files without a usable index: every complete chunk, in the order of the file."""

    def __init__(self, path, files, reason):
        super().__init__(path)
        self._files = files
        counts: Counter[str] = Counter()
        times = []
        for topic, _, log_time, _ in self._scan():
            counts[topic] += 1
            times.append(log_time)
        for name, info in self.topics.items():
            info.count = counts[name]
        if times:
            self.start_time, self.end_time = min(times), max(times) + 1
        self.warnings.append(f"not closed properly ({reason}); {len(times)} messages recovered "
                             "from its complete chunks; imu_fusion info --repair writes a clean "
                             "copy")

    def _scan(self):
        """Yield (topic, msgtype, log time, CDR bytes) as far as each file can be read: the open
        chunk at its end is lost."""
        for path in self._files:
            with open(path, "rb") as stream:
                try:
                    yield from self._scan_file(stream)
                except (mcap.exceptions.McapError, EOFError, struct.error, ValueError,
                        RuntimeError):
                    continue
                except Exception as error:  # decompressors raise types of their own
                    if "zstd" not in repr(type(error)).lower() and "lz4" not in repr(error).lower():
                        raise

    def _scan_file(self, stream):
        schemas, channels = {}, {}
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, mcap.records.Schema):
                schemas[record.id] = record
            elif isinstance(record, mcap.records.Channel):
                channels[record.id] = self._register(record, schemas)
            elif isinstance(record, mcap.records.Message):
                topic = channels.get(record.channel_id)
                if topic is not None:
                    yield topic, self.topics[topic].msgtype, record.log_time, record.data

    def _register(self, channel, schemas):
        schema = schemas.get(channel.schema_id)
        if schema is None or channel.message_encoding != "cdr":
            return None
        if channel.topic not in self.topics:
            msgtype = normalize_msgtype(schema.name)
            self.topics[channel.topic] = TopicInfo(channel.topic, msgtype, None, yaml.safe_load(
                channel.metadata.get("offered_qos_profiles", "")) or [])
            if msgtype not in TYPES.fielddefs and schema.encoding == "ros2msg":
                self._learn(msgtype, schema)
        return channel.topic

    def _learn(self, msgtype, schema):
        if self.typestore is TYPES:
            self.typestore = get_typestore(Stores.ROS2_JAZZY)
        known = get_types_from_msg(schema.data.decode("utf-8", "replace"), msgtype)
        self.typestore.register({k: v for k, v in known.items()
                                 if k not in self.typestore.fielddefs})

    def messages(self, topics=None, start=None, stop=None):
        rows = [(log_time, i, topic, msgtype, data)
                for i, (topic, msgtype, log_time, data) in enumerate(self._scan())
                if (topics is None or topic in topics)
                and (start is None or log_time >= start) and (stop is None or log_time < stop)]
        rows.sort(key=lambda row: row[:2])
        for log_time, _, topic, msgtype, data in rows:
            yield topic, msgtype, log_time, data
