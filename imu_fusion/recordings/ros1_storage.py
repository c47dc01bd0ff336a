"""ROS 1 bags (format 2.0), whole or damaged, their messages as CDR of ROS 2.

As of MCAP the records are walked from the begin to the end, and where none follows the next chunk
is searched for. Types come from the definitions that the bag holds for each connection.
"""

import bz2
import keyword
import re
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import lru_cache, partial

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.msg import normalize_msgtype
from rosbags.typesys.store import Typestore

from imu_fusion.errors import BagError
from imu_fusion.messages.typestore import TYPES
from imu_fusion.recordings.qos import qos_profile
from imu_fusion.recordings.storage import (
    DamageError,
    FileStorage,
    Part,
    Row,
    StoredTopic,
    Window,
    in_order,
    largest_chunk,
    span,
    unpack,
)

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _INDEX, _CHUNK, _INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_HEADER = 1 << 20          # bytes that a header takes at most: definitions are in the data
_DEFINITIONS = 1 << 24     # bytes of the data of a connection
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")
_SEARCH = 1 << 20
_MARK = b"compression="    # of the header of a chunk
_BEFORE = 64               # bytes from the begin of such a header to the mark, at most


@dataclass
class _Chunk:
    position: int
    size: int
    unpacked: int
    compression: str
    first: int | None = None
    last: int | None = None
    counts: dict[int, int] = field(default_factory=dict)


@dataclass(frozen=True)
class _Connection:
    topic: str
    msgtype: str
    text: str
    latching: bool


class Ros1Storage(FileStorage):
    """See :class:`imu_fusion.recordings.storage.Storage`."""

    def _open(self) -> None:
        self._chunks: list[_Chunk] = []
        self._connections: dict[int, _Connection] = {}
        self._stores: dict[str, Typestore] = {}
        self._broken: dict[str, int] = {}
        self._holes: list[tuple[int, int]] = []    # (bytes, number of the chunk after)
        self._lost = False    # a chunk, though its index may still be there
        if self._file.read(0, len(MAGIC)) != MAGIC:
            raise BagError(f"{self.path}: not a ROS 1 bag of format 2.0 (it does not begin with "
                           f"{MAGIC.decode().strip()}); rosbag migrate converts older ones")
        self._walk()
        self._count()
        self._make_topics()
        self._tell_holes()
        if not self._chunks:
            self.lose(f"{self.path.name}: holds no chunk: nothing was written, or the rest is "
                      "lost")

    def messages(self, topics: Collection[str], start: int | None,
                 stop: int | None) -> Iterator[Row]:
        wanted = {number: connection for number, connection in self._connections.items()
                  if connection.topic in topics and connection.topic in self._stores}
        parts = [Part(chunk.first or 0, chunk.unpacked,
                      partial(self._rows, chunk, wanted, start, stop))
                 for chunk in self._chunks
                 if not chunk.counts or not wanted.keys().isdisjoint(chunk.counts)]
        yield from in_order(parts)
        for topic, count in self._broken.items():
            self.lose(f"topic {topic}: {count} messages do not fit their definition and are left "
                      "out")

    def _walk(self) -> None:
        position = len(MAGIC)
        while position < self._file.size:
            record = _record(self._file, position)
            if record is None or not self._take(*record[:3]):
                start = position + 1
                chunk = self._chunks[-1] if self._chunks else None
                if chunk is not None and chunk.position + chunk.size == position:
                    # Perhaps it is shorter than it says: what is inside of it is no chunk.
                    start = chunk.position
                found = self._find(start)
                self._holes.append((found - position, len(self._chunks)))
                self._lost = True
                position = found
                continue
            position = record[3]

    def _find(self, start: int) -> int:
        """Position of the next chunk, the size of the file without one."""
        while start < self._file.size:
            data = self._file.read(start, _SEARCH)
            at = data.find(_MARK)
            while at >= 0:
                for before in range(12, min(_BEFORE, at) + 1):
                    record = _record(self._file, start + at - before)
                    if record is not None and record[0].get("op") == bytes([_CHUNK]) and (
                            _chunk(*record[:3]) is not None):
                        return start + at - before
                at = data.find(_MARK, at + 1)
            start += max(len(data) - _BEFORE - len(_MARK), 1)
            if len(data) < _SEARCH:
                break
        return self._file.size

    def _take(self, header: dict[str, bytes], content: int, size: int) -> bool:
        """What one record of the file says; False if it is none."""
        op = header.get("op", b"\0")
        if op == bytes([_CHUNK]):
            chunk = _chunk(header, content, size)
            if chunk is None:
                return False
            self._chunks.append(chunk)
            self._lost = False
        elif op == bytes([_CONNECTION]):
            self._connect(header, self._file.read(content, min(size, _DEFINITIONS)))
        elif op == bytes([_INDEX]) and self._chunks and not self._lost:
            self._take_index(header, content, size)
        return len(op) == 1 and _MESSAGE <= op[0] <= _CONNECTION

    def _take_index(self, header: dict[str, bytes], content: int, size: int) -> None:
        number, count = _integer(header.get("conn")), _integer(header.get("count"))
        chunk = self._chunks[-1]
        if number is None or count is None or size != 12 * count or size > _SEARCH * 64:
            return
        times = [sec * 10**9 + nsec for sec, nsec, _ in
                 struct.iter_unpack("<III", self._file.read(content, size))]
        chunk.counts[number] = chunk.counts.get(number, 0) + len(times)
        if times:
            chunk.first = min(times) if chunk.first is None else min(chunk.first, *times)
            chunk.last = max(times) if chunk.last is None else max(chunk.last, *times)

    def _connect(self, header: dict[str, bytes], data: bytes) -> None:
        number, fields = _integer(header.get("conn")), _fields(data)
        if number is None or fields is None or number in self._connections:
            return
        topic = header.get("topic", b"").decode("utf-8", "replace")
        name = fields.get("type", b"").decode("utf-8", "replace")
        if not topic or not _NAME.fullmatch(name):
            return
        topic = "/" * topic.startswith("/") + "/".join(filter(None, topic.split("/")))
        self._connections[number] = _Connection(
            topic, normalize_msgtype(name),
            fields.get("message_definition", b"").decode("utf-8", "replace"),
            fields.get("latching") == b"1")

    def _count(self) -> None:
        """Unpack the chunks whose index is missing, or names connections that are unknown."""
        for chunk in self._chunks:
            if chunk.counts and chunk.counts.keys() <= self._connections.keys():
                continue
            indexed = bool(chunk.counts)
            try:
                for header, content in _records(self._unpacked(chunk)):
                    if header.get("op") == bytes([_CONNECTION]):
                        self._connect(header, bytes(content))
                    elif header.get("op") == bytes([_MESSAGE]) and not indexed:
                        number, time = _integer(header.get("conn")), _time(header.get("time"))
                        if number is None or time is None:
                            continue
                        chunk.counts[number] = chunk.counts.get(number, 0) + 1
                        chunk.first = time if chunk.first is None else min(chunk.first, time)
                        chunk.last = time if chunk.last is None else max(chunk.last, time)
            except DamageError:
                continue    # told when it is read

    def _make_topics(self) -> None:
        counts: dict[int, int] = {}
        for chunk in self._chunks:
            for number, count in chunk.counts.items():
                counts[number] = counts.get(number, 0) + count
        times = [t for chunk in self._chunks for t in (chunk.first, chunk.last) if t is not None]
        if times:
            self.times = min(times), max(times)
        for number, connection in self._connections.items():
            topic = self.topics.get(connection.topic)
            if topic is not None and topic.msgtype != connection.msgtype:
                self.lose(f"topic {topic.name} holds several types and is read as {topic.msgtype}")
                continue
            if topic is None:
                try:
                    store, definition = _types(connection.msgtype, connection.text)
                except DamageError as error:
                    self.left_out.append(f"{connection.topic} ({connection.msgtype}: {error})")
                    continue
                self._stores[connection.topic] = store
                topic = self.topics[connection.topic] = StoredTopic(
                    connection.topic, connection.msgtype, 0, [qos_profile(
                        durability="transient_local")] if connection.latching else [], definition)
            topic.count += counts.get(number, 0)

    def _tell_holes(self) -> None:
        for size, after in self._holes:
            last = next((c.last for c in reversed(self._chunks[:after]) if c.last is not None),
                        None)
            first = next((c.first for c in self._chunks[after:] if c.first is not None), None)
            self.lose(f"{self.path.name}: {size if size > 0 else 'some'} bytes are damaged or cut "
                      f"off; messages of {span(last, first)} may be missing")

    def _unpacked(self, chunk: _Chunk) -> bytes:
        data = self._file.read(chunk.position, chunk.size)
        if chunk.compression != "bz2":
            return unpack(data, chunk.compression, chunk.unpacked)
        if chunk.unpacked > largest_chunk():
            unpack(data, "bz2", chunk.unpacked)    # refuses it
        try:
            found = bz2.BZ2Decompressor().decompress(data, chunk.unpacked + 1)
        except (OSError, EOFError, ValueError) as error:
            raise DamageError(f"it cannot be unpacked ({error})") from None
        if len(found) != chunk.unpacked:
            raise DamageError(f"it unpacks to another size than the {chunk.unpacked} bytes stated")
        return found

    def _rows(self, chunk: _Chunk, wanted: dict[int, _Connection], start: int | None,
              stop: int | None) -> Iterator[Row]:
        rows = []
        try:
            for header, content in _records(self._unpacked(chunk)):
                if header.get("op") != bytes([_MESSAGE]):
                    continue
                connection = wanted.get(_integer(header.get("conn")) or 0)
                time = _time(header.get("time"))
                if connection is not None and time is not None and (
                        start is None or time >= start) and (stop is None or time < stop):
                    rows.append((time, connection, content))
        except DamageError as error:
            self.lose(f"{self.path.name}: a chunk at byte {chunk.position} is damaged: {error}; "
                      f"of its {sum(chunk.counts.values())} messages of "
                      f"{span(chunk.first, chunk.last)} {len(rows)} are read")
        rows.sort(key=lambda row: row[0])
        for time, connection, content in rows:
            try:
                cdr = bytes(self._stores[connection.topic].ros1_to_cdr(
                    bytes(content), connection.msgtype))
            except Exception:
                self._broken[connection.topic] = self._broken.get(connection.topic, 0) + 1
                continue
            yield time, connection.topic, cdr


@lru_cache(maxsize=256)
def _types(msgtype: str, text: str) -> tuple[Typestore, tuple[str, str]]:
    """Types as the bag itself defines them, those of Jazzy where it does not; and (definition,
    hash) of this one in ROS 2.

    Raises:
        DamageError: the definition cannot be read.
    """
    try:
        store = _store(msgtype, text)
        return store, (store.generate_msgdef(msgtype, ros_version=2)[0],
                       store.hash_rihs01(msgtype))
    except DamageError:
        raise
    except Exception as error:    # whatever a parser makes of a hostile text
        raise DamageError(f"its definition cannot be read ({str(error)[:100]})") from None


def _store(msgtype: str, text: str) -> Typestore:
    if not text.strip() and msgtype in TYPES.fielddefs:
        return TYPES
    found = get_types_from_msg(text, msgtype)
    # Code is made from names: they are checked here, and constants left out.
    found = {name: ([], [(word, kind) for word, kind in fields if not (
                name == "std_msgs/msg/Header" and word == "seq")])
             for name, (_, fields) in found.items()}
    for name, (_, fields) in found.items():
        for word in (*name.split("/"), *(word for word, _ in fields)):
            if not word.isidentifier() or keyword.iskeyword(word):
                raise DamageError(f"'{word[:40]}' in its definition is no name")
    _refuse_recursion(found)
    store = get_typestore(Stores.EMPTY)
    store.register({name: TYPES.fielddefs[name] for name in (
        "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")} | found)
    store.get_msgdef(msgtype)
    return store


def _refuse_recursion(types: dict) -> None:
    """A type inside of itself has no end."""
    def used(name):
        for _, kind in types.get(name, ((), ()))[1]:
            while kind[0].name in ("ARRAY", "SEQUENCE"):
                kind = kind[1][0]
            if kind[0].name == "NAME":
                yield kind[1]

    depth = {name: 0 for name in types}
    for _ in range(len(types) + 1):
        deeper = {name: 1 + max((depth.get(inner, 0) for inner in used(name)), default=0)
                  for name in types}
        if deeper == depth:
            return
        depth = deeper
    raise DamageError("a type in its definition contains itself")


def _record(file: Window, position: int) -> tuple[dict[str, bytes], int, int, int] | None:
    """(header, position and size of the data, end) of a record, None if there is none."""
    if position < 0:
        return None
    head = file.read(position, 4)
    if len(head) < 4:
        return None
    (length,) = struct.unpack("<I", head)
    if not 0 < length <= _HEADER or position + 8 + length > file.size:
        return None
    fields = _fields(file.read(position + 4, length))
    if not fields or len(fields.get("op", b"")) != 1:
        return None
    (size,) = struct.unpack("<I", file.read(position + 4 + length, 4))
    content = position + 8 + length
    return (fields, content, size, content + size) if content + size <= file.size else None


def _records(data: bytes) -> Iterator[tuple[dict[str, bytes], memoryview]]:
    """(header, data) of the records of a chunk.

    Raises:
        DamageError: at the first one whose lengths do not fit.
    """
    view, position = memoryview(data), 0
    while position < len(data):
        if position + 4 > len(data):
            raise DamageError("a record is cut off")
        (length,) = struct.unpack_from("<I", data, position)
        start = position + 4 + length
        if start + 4 > len(data):
            raise DamageError("a length in it is wrong")
        fields = _fields(bytes(view[position + 4:start]))
        (size,) = struct.unpack_from("<I", data, start)
        position = start + 4 + size
        if not fields or position > len(data):    # none: zeros, by the million
            raise DamageError("a record in it is damaged")
        yield fields, view[start + 4:position]


def _fields(data: bytes) -> dict[str, bytes] | None:
    """The name=value pairs of a header, None if it is none."""
    fields, position = {}, 0
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
        fields[name.decode("ascii", "replace")] = value
    return fields


def _integer(value: bytes | None) -> int | None:
    return int.from_bytes(value, "little") if value is not None and len(value) == 4 else None


def _time(value: bytes | None) -> int | None:
    if value is None or len(value) != 8:
        return None
    sec, nsec = struct.unpack("<II", value)
    return sec * 10**9 + nsec


def _chunk(header: dict[str, bytes], content: int, size: int) -> _Chunk | None:
    unpacked = _integer(header.get("size"))
    compression = header.get("compression", b"").decode("ascii", "replace")
    if unpacked is None or compression not in ("none", "lz4", "bz2") or (
            compression == "none" and unpacked != size):
        return None
    return _Chunk(content, size, unpacked, compression)
