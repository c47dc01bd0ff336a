"""ROS 1 bags (format 2.0), whole or damaged, their messages as CDR of ROS 2.

As of MCAP the records are walked from the begin to the end, and where none follows the next chunk
or message is searched for. Types come from the definitions that the bag holds for each connection.
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
from imu_fusion.recordings.ros1_records import (
    BAG,
    CHUNK,
    CONNECTION,
    INDEX,
    MAGIC,
    MESSAGE,
    Header,
    Search,
    compression,
    fields,
    header_at,
    integer,
    is_chunk,
    record_at,
    records,
    time,
)
from imu_fusion.recordings.storage import (
    DamageError,
    FileStorage,
    Part,
    Row,
    StoredTopic,
    in_order,
    largest_chunk,
    span,
    unpack,
)

_DEFINITIONS = 1 << 24     # bytes of the data of a connection
_LARGEST_INDEX = 1 << 26           # bytes of the index of a chunk
_TOGETHER = 1 << 20        # bytes of records outside of chunks that are read at once
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")


@dataclass
class _Chunk:
    """``loose``: not known by its header, but a run of records that are in none, or in one whose
    length is wrong."""

    position: int
    size: int
    unpacked: int
    compression: str
    loose: bool = False
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
        self._doubtful: dict[int, _Connection] = {}    # whose definition cannot be read
        self._stores: dict[str, Typestore] = {}
        self._broken: dict[str, int] = {}
        self._holes: list[tuple[int, int]] = []    # (bytes, number of the chunk after)
        self._is_closed = True
        self._lost = False    # a chunk, though its index may still be there
        self._walk()
        self._count()
        self._connections = self._doubtful | self._connections
        self._make_topics()
        self._tell_holes()
        if not self._chunks and self._file.read(0, len(MAGIC)) != MAGIC:
            raise BagError(f"{self.path}: not a ROS 1 bag of format 2.0 (it does not begin with "
                           f"{MAGIC.decode().strip()}); rosbag migrate converts older ones")
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
        position = len(MAGIC) if self._file.read(0, len(MAGIC)) == MAGIC else 0
        search = Search(self._file)
        while position < self._file.size:
            found = record_at(self._file, position)
            if found is not None and self._take(position, *found):
                position = found[2]
                continue
            inside = self._open_chunk(position)
            if inside is not None:
                position = inside
                continue
            chunk = self._chunks[-1] if self._chunks else None
            is_next = chunk is not None and chunk.position + chunk.size == position
            # Perhaps that chunk is shorter than it says.
            start = (chunk.position if chunk is not None and is_next and not chunk.loose
                     else position + 1)
            found_at = search.after(start)
            self._holes.append((found_at - position, len(self._chunks)))
            self._lost = True
            position = found_at

    def _open_chunk(self, position: int) -> int | None:
        """Where the records of a chunk begin, which are walked one by one if it is not packed and
        its length is wrong: it is cut off, or bytes are missing in it."""
        found = header_at(self._file, position)
        chunk = self._chunks[-1] if self._chunks else None
        if found is not None and found[0]["op"] == CHUNK and compression(found[0]) == "none":
            begin = found[1]
            self._holes.append((0, len(self._chunks)))
            self._chunks.append(_Chunk(begin, 0, 0, "none", loose=True))
        elif (chunk is not None and chunk.compression == "none" and not chunk.loose
                and chunk.position + chunk.size == position):
            begin = chunk.position
            self._chunks[-1] = _Chunk(begin, 0, 0, "none", loose=True)
        else:
            return None
        self._lost = True
        return begin

    def _take(self, position: int, header: Header, begin: int, end: int) -> bool:
        """What one record of the file says; False if it is none."""
        op, size = header["op"], end - begin
        if op == CHUNK:
            if not is_chunk(header, size):
                return False
            self._chunks.append(_Chunk(begin, size, integer(header["size"]) or 0,
                                       compression(header)))
            self._lost = False
        elif op == MESSAGE or (op == CONNECTION and self._is_open(position)):
            if not self._is_open(position) or self._chunks[-1].size > _TOGETHER:
                self._chunks.append(_Chunk(position, 0, 0, "none", loose=True))
            chunk = self._chunks[-1]
            chunk.size = chunk.unpacked = end - chunk.position
        elif op == CONNECTION:
            self._connect(header, self._file.read(begin, min(size, _DEFINITIONS)))
        elif op == INDEX and self._chunks and not self._lost:
            self._take_index(header, begin, end)
        elif op == BAG:
            place = int.from_bytes(header.get("index_pos", b""), "little")
            self._is_closed = 0 < place <= self._file.size
        return True

    def _is_open(self, position: int) -> bool:
        """Whether a record belongs to the chunk before it, whose recorder was killed, or whose
        length is wrong."""
        chunk = self._chunks[-1] if self._chunks else None
        return (chunk is not None and chunk.compression == "none"
                and chunk.position + chunk.size == position
                and (chunk.loose or chunk.size == 0))

    def _take_index(self, header: Header, begin: int, end: int) -> None:
        number, count = integer(header.get("conn")), integer(header.get("count"))
        chunk = self._chunks[-1]
        if number is None or count is None or not end - begin == 12 * count <= _LARGEST_INDEX:
            return
        entries = [*struct.iter_unpack("<III", self._file.read(begin, end - begin))]
        if any(place >= chunk.unpacked for _, _, place in entries):    # not of this chunk
            self._lost = True
            chunk.counts, chunk.first, chunk.last = {}, None, None
            return
        times = [sec * 10**9 + nsec for sec, nsec, _ in entries]
        chunk.counts[number] = chunk.counts.get(number, 0) + len(times)
        if times:
            chunk.first = min(times) if chunk.first is None else min(chunk.first, *times)
            chunk.last = max(times) if chunk.last is None else max(chunk.last, *times)

    def _connect(self, header: Header, data: bytes) -> None:
        number, about = integer(header.get("conn")), fields(data)
        if number is None or about is None or number in self._connections:
            return
        topic = header.get("topic", b"").decode("utf-8", "replace")
        name = about.get("type", b"").decode("utf-8", "replace")
        if not topic or not _NAME.fullmatch(name):
            return
        topic = "/" * topic.startswith("/") + "/".join(filter(None, topic.split("/")))
        found = _Connection(topic, normalize_msgtype(name),
                            about.get("message_definition", b"").decode("utf-8", "replace"),
                            about.get("latching") == b"1")
        try:
            _types(found.msgtype, found.text)
        except DamageError:    # it is written twice, in a chunk and behind all of them
            self._doubtful[number] = found
        else:
            self._connections[number] = found

    def _count(self) -> None:
        """Unpack the chunks whose index is missing, or names connections that are unknown."""
        for chunk in self._chunks:
            if chunk.counts and chunk.counts.keys() <= self._connections.keys():
                continue
            indexed = bool(chunk.counts)
            try:
                for header, content in records(self._unpacked(chunk)):
                    if header.get("op") == CONNECTION:
                        self._connect(header, bytes(content))
                    elif header.get("op") == MESSAGE and not indexed:
                        number, at = integer(header.get("conn")), time(header.get("time"))
                        if number is None or at is None:
                            continue
                        chunk.counts[number] = chunk.counts.get(number, 0) + 1
                        chunk.first = at if chunk.first is None else min(chunk.first, at)
                        chunk.last = at if chunk.last is None else max(chunk.last, at)
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
        if not self._is_closed and not self._holes:
            self.lose(f"{self.path.name}: not closed properly; what comes before is recovered, "
                      "what was not yet written to the disk is missing")

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
        rows, found, damaged = [], 0, 0
        try:
            data = self._unpacked(chunk)
        except DamageError as error:
            self.lose(f"{self.path.name}: a chunk at byte {chunk.position} is left out: {error}; "
                      f"{sum(chunk.counts.values()) or 'its'} messages of "
                      f"{span(chunk.first, chunk.last)} are missing")
            return
        for header, content in records(data):
            if not header:
                damaged += len(content)
            if header.get("op") != MESSAGE:
                continue
            found += 1
            number, at = integer(header.get("conn")), time(header.get("time"))
            connection = None if number is None else wanted.get(number)
            if connection is not None and at is not None and (
                    start is None or at >= start) and (stop is None or at < stop):
                rows.append((at, connection, content))
        if damaged:
            missing = sum(chunk.counts.values()) - found
            self.lose(f"{self.path.name}: {damaged} bytes in a chunk at byte {chunk.position} are "
                      f"damaged; {missing if missing > 0 else 'some'} messages of "
                      f"{span(chunk.first, chunk.last)} are missing")
        rows.sort(key=lambda row: row[0])
        for at, connection, content in rows:
            try:
                cdr = bytes(self._stores[connection.topic].ros1_to_cdr(
                    bytes(content), connection.msgtype))
            except Exception:
                self._broken[connection.topic] = self._broken.get(connection.topic, 0) + 1
                continue
            yield at, connection.topic, cdr


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
    found = {name: ([], [(word, kind) for word, kind in members if not (
                name == "std_msgs/msg/Header" and word == "seq")])
             for name, (_, members) in found.items()}
    for name, (_, members) in found.items():
        for word in (*name.split("/"), *(word for word, _ in members)):
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
