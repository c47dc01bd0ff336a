"""MCAP files (https://mcap.dev/spec), whole or damaged, by one way.

The records of the file are walked from its begin to its end, without unpacking a chunk: an index
at the end is a convenience that a crash leaves out. Where no record follows, the next one is
searched for; a chunk is checked when it is unpacked, and left out if its bytes have changed.
"""

import contextlib
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from imu_fusion.errors import BagError
from imu_fusion.recordings.mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    DATA_END,
    FOOTER,
    HEAD,
    INDEX,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    NONE,
    SCHEMA,
    SEARCH,
    Channel,
    Schema,
    Search,
    define,
    end_of,
    is_followed,
    records,
)
from imu_fusion.recordings.qos import read_profiles
from imu_fusion.recordings.storage import (
    DamageError,
    FileStorage,
    Part,
    Row,
    StoredTopic,
    in_order,
    span,
    unpack,
)

_TOGETHER = 1 << 20        # bytes of records outside of chunks that are read at once
_TRIES = 3                 # chunks that are unpacked in search of a channel


@dataclass
class _Block:
    """A chunk, or a run of records outside of chunks (``compression`` None)."""

    position: int
    size: int
    unpacked: int
    compression: str | None
    crc: int = 0
    first: int | None = None
    last: int | None = None
    counts: dict[int, int] = field(default_factory=dict)   # messages of each channel
    claimed: tuple[int | None, int | None] = (None, None)   # first and last, by its header

    def forget(self) -> None:
        """What its index said of it."""
        self.counts = {}
        self.first, self.last = self.claimed

    def claims(self, first: int, last: int) -> bool:
        """Whether its header has these times."""
        low, high = self.claimed
        return low is not None and high is not None and low <= first and last <= high

    def saw(self, first: int, last: int) -> None:
        """Its log times are at least from ``first`` to ``last``."""
        self.first = first if self.first is None else min(self.first, first)
        self.last = last if self.last is None else max(self.last, last)


class McapStorage(FileStorage):
    """See :class:`imu_fusion.recordings.storage.Storage`."""

    def _open(self) -> None:
        self._blocks: list[_Block] = []
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        # Those of the index: good as long as its checksum says so.
        self._index: tuple[dict[int, Channel], dict[int, Schema]] = {}, {}
        self._index_at: int | None = None    # its first record, once that has come
        self._holes: list[tuple[int, int, _Block]] = []   # (bytes, number of the block after, lost)
        self._lost: _Block | None = None    # a chunk that is no more, though its index may be
        self._search = Search(self._file)
        self._walk()
        self._learn_channels()
        self._make_topics()
        self._tell_holes()
        if not self._blocks and not self._channels and self._file.read(0, 8) != MAGIC:
            raise BagError(f"{self.path}: not an MCAP file, or damaged beyond reading")

    def messages(self, topics: Collection[str], start: int | None,
                 stop: int | None) -> Iterator[Row]:
        wanted = {number: channel.topic for number, channel in self._channels.items()
                  if channel.topic in topics and channel.topic in self.topics
                  and self._type_of(channel)}
        parts = [Part(block.first or 0, block.unpacked,
                      partial(self._rows, block, wanted, start, stop))
                 for block in self._blocks
                 if (not block.counts or not wanted.keys().isdisjoint(block.counts))
                 and (block.first is None or stop is None or block.first < stop)
                 and (block.last is None or start is None or block.last >= start)]
        return in_order(parts)

    # The walk over the records.

    def _walk(self) -> None:
        position = len(MAGIC) if self._file.read(0, len(MAGIC)) == MAGIC else 0
        size = self._file.size
        while position < size:
            if size - position == len(MAGIC) and self._file.read(position, 8) == MAGIC:
                return
            end = end_of(self._file, position)
            if end is None or not is_followed(self._file, position, end):
                position = self._resume(position)
                continue
            self._take(position, end)
            position = end

    def _resume(self, position: int) -> int:
        """The next record after one that is none; the end of the file without one."""
        start = position + 1
        block = self._blocks[-1] if self._blocks else None
        if block is not None and block.compression is not None and (
                block.position + block.size == position and not self._is_sound(block)):
            # The chunk before it is shorter than it says: bytes are missing in it.
            self._blocks.pop()
            position = start = block.position
        elif block is not None and block.compression is not None:
            block.forget()    # a part of its index may be missing
        found = self._search.after(start)
        if self._index_at is not None:
            self.mention(f"{self.path.name}: not closed properly: its index is damaged or cut off; "
                         "it is read without")
        else:
            self._lost = _Block(position, 0, 0, "")
            self._holes.append((found - position, len(self._blocks), self._lost))
        return found

    def _is_sound(self, block: _Block) -> bool:
        try:
            self._unpacked(block)
        except DamageError:
            return False
        return bool(block.crc)

    # What the records say.

    def _take(self, position: int, end: int) -> None:
        opcode = self._file.read(position, 1)[0]
        content = position + HEAD.size
        if opcode in (CHUNK, MESSAGE):
            self._lost = None
        if opcode == CHUNK:
            self._take_chunk(content, end)
        elif opcode == INDEX:
            self._take_index(self._file.read(content, end - content))
        elif opcode == MESSAGE:
            number, _, log_time, _ = MESSAGE_HEAD.unpack(
                self._file.read(content, MESSAGE_HEAD.size))
            block = self._open_run(position)
            block.size = block.unpacked = end - block.position
            block.counts[number] = block.counts.get(number, 0) + 1
            block.saw(log_time, log_time)
        elif opcode in (SCHEMA, CHANNEL):
            channels, schemas = (self._channels, self._schemas) if self._index_at is None else (
                self._index)
            define(opcode, self._file.read(content, end - content), channels, schemas)
            if self._index_at is None:    # read with the messages: it may contradict earlier ones
                block = self._open_run(position)
                block.size = block.unpacked = end - block.position
        elif opcode == DATA_END:
            self._index_at = end
        elif opcode == FOOTER:
            self._check_index(position, self._file.read(content, 20))

    def _take_chunk(self, content: int, end: int) -> None:
        head = self._file.read(content, 72)
        first, last, unpacked, crc, text = CHUNK_HEAD.unpack_from(head)
        compression = head[32:32 + text].decode("ascii", "replace")
        start = content + 40 + text
        block = _Block(start, end - start, unpacked, compression, crc)
        if first <= last:
            block.claimed = first, last
        block.forget()
        self._blocks.append(block)

    def _take_index(self, content: bytes) -> None:
        """How many messages of a channel the chunk before it holds, and when."""
        block = self._lost or (self._blocks[-1] if self._blocks else None)
        if block is None or block.compression is None or len(content) < 22:
            return
        (number,) = struct.unpack_from("<H", content)
        times = np.frombuffer(content, "<u8", offset=6)[::2]
        if block is self._lost and self._blocks and self._blocks[-1].claims(times.min(),
                                                                            times.max()):
            return    # of the chunk before the damage, which is counted without
        if not block.counts:
            block.first = block.last = None    # exact from here on
        block.counts[number] = len(times)
        block.saw(int(times.min()), int(times.max()))

    def _open_run(self, position: int) -> _Block:
        """The block of a record outside of chunks."""
        block = self._blocks[-1] if self._blocks else None
        if (block is None or block.compression is not None or block.size > _TOGETHER
                or block.position + block.size != position):
            block = _Block(position, 0, 0, None)
            self._blocks.append(block)
        return block

    def _check_index(self, position: int, footer: bytes) -> None:
        """Forget what the index said if its checksum does not fit."""
        start, _, crc = struct.unpack("<QQI", footer)
        if self._index_at is not None:
            start = self._index_at    # where it is, should bytes be missing before it
        if not crc or not 0 < start <= position:
            return
        value, size = 0, position + HEAD.size + 16 - start
        for offset in range(0, size, SEARCH):
            value = zlib.crc32(self._file.read(start + offset, min(SEARCH, size - offset)), value)
        if value != crc:
            self._index = {}, {}
            self.mention(f"{self.path.name}: its index is damaged; it is read without")

    def _learn_channels(self) -> None:
        """Find the channels that messages name: beside the chunks, else inside of them."""
        channels, schemas = self._index
        self._channels = channels | self._channels
        self._schemas = schemas | self._schemas
        # Of a damaged chunk: good as long as nothing sound contradicts them.
        doubtful: tuple[dict[int, Channel], dict[int, Schema]] = {}, {}
        tries: dict[int, int] = {}
        for block in self._blocks:
            if block.compression is None:
                continue
            unknown = [n for n in block.counts if n not in self._channels
                       and tries.get(n, 0) < _TRIES]
            if block.counts and not unknown:
                continue
            counted = bool(block.counts)
            known = self._channels, self._schemas
            try:
                data = self._unpacked(block)
            except DamageError as error:
                self._lose_chunk(block, error)
                if block.compression:
                    continue
                counted, known = True, doubtful
                data = self._file.read(block.position, block.size)    # definitions may be sound
            for number in unknown:
                tries[number] = tries.get(number, 0) + 1
            for opcode, content in records(data):
                if opcode in (SCHEMA, CHANNEL):
                    with contextlib.suppress(DamageError):
                        define(opcode, content, *known)
                elif opcode == MESSAGE and not counted and len(content) >= MESSAGE_HEAD.size:
                    number, _, log_time, _ = MESSAGE_HEAD.unpack_from(content)
                    block.counts[number] = block.counts.get(number, 0) + 1
                    block.saw(log_time, log_time)
        self._channels = doubtful[0] | self._channels
        self._schemas = doubtful[1] | self._schemas

    def _type_of(self, channel: Channel) -> str:
        """The message type of a channel; empty, if it is no topic of ROS 2."""
        schema = self._schemas.get(channel.schema)
        known = schema is not None and channel.encoding == "cdr" and channel.topic
        return schema.name if schema is not None and known else ""

    def _make_topics(self) -> None:
        counts: dict[int, int] = {}
        times: list[int] = []
        for block in self._blocks:
            for number, count in block.counts.items():
                counts[number] = counts.get(number, 0) + count
            if block.counts:
                times += [t for t in (block.first, block.last) if t is not None]
        if times:
            self.times = min(times), max(times)
        several: dict[str, set[str]] = {}
        for number, channel in self._channels.items():
            name, schema = self._type_of(channel), self._schemas.get(channel.schema)
            if schema is None and channel.schema:
                self.lose(f"{self.path.name}: the type of topic {channel.topic} (schema "
                          f"{channel.schema}) is not in the file; {counts.get(number, 0)} "
                          "messages are left out")
                continue
            if not name or schema is None:
                kind = channel.encoding or "no encoding"
                self.left_out.append(f"{channel.topic or 'a channel without name'} ({kind})")
                continue
            topic = self.topics.get(channel.topic)
            if topic is None:
                source = f"{self.path.name}, QoS of {channel.topic}"
                topic = self.topics[channel.topic] = StoredTopic(
                    channel.topic, name, 0, read_profiles(
                        channel.metadata.get("offered_qos_profiles", ""), source),
                    (schema.data.decode("utf-8", "replace"),
                     channel.metadata.get("topic_type_hash", ""))
                    if schema.encoding == "ros2msg" else None)
            if topic.msgtype != name:
                several.setdefault(channel.topic, {topic.msgtype}).add(name)
            topic.count += counts.get(number, 0)
        for name, kinds in several.items():
            del self.topics[name]
            self.lose(f"topic {name} holds several types ({', '.join(sorted(kinds))}) and is left "
                      "out")
        unknown = sum(n for number, n in counts.items() if number not in self._channels)
        if unknown:
            self.lose(f"{self.path.name}: {unknown} messages are of channels whose definition is "
                      "lost with a damaged part; they are left out")

    def _tell_holes(self) -> None:
        for size, after, lost in self._holes:
            last = next((b.last for b in reversed(self._blocks[:after]) if b.last is not None),
                        None)
            first = next((b.first for b in self._blocks[after:] if b.first is not None), None)
            where = "damaged" if after < len(self._blocks) else (
                "damaged or cut off: the file is not closed properly; what comes before is "
                "recovered")
            which = (f"messages of {span(last, first)} may be missing" if not lost.counts else
                     f"{sum(lost.counts.values())} messages of {span(lost.first, lost.last)} are "
                     "missing")
            self.lose(f"{self.path.name}: {size if size > 0 else 'some'} bytes are {where}; "
                      f"{which}")
        if self._index_at is None and not self._holes:
            self.lose(f"{self.path.name}: not closed properly; what comes before is recovered, "
                      "what was not yet written to the disk is missing")

    # Messages.

    def _unpacked(self, block: _Block) -> bytes:
        if block.compression is None:
            return self._file.read(block.position, block.size)
        if block.compression == "" and block.unpacked != block.size:
            raise DamageError(f"it unpacks to another size than the {block.unpacked} bytes stated")
        data = unpack(self._file.read(block.position, block.size), block.compression,
                      block.unpacked)
        if block.crc and zlib.crc32(data) != block.crc:
            raise DamageError("its checksum does not fit")
        return data

    def _lose_chunk(self, block: _Block, error: DamageError) -> None:
        count = sum(block.counts.values()) or "its"
        self.lose(f"{self.path.name}: a chunk at byte {block.position} is left out: {error}; "
                  f"{count} messages of {span(block.first, block.last)} are missing")

    def _rows(self, block: _Block, wanted: dict[int, str], start: int | None,
              stop: int | None) -> Iterator[Row]:
        try:
            data = self._unpacked(block)
        except DamageError as error:
            self._lose_chunk(block, error)
            return iter(())
        rows, found, damaged = [], 0, 0
        for opcode, content in records(data):
            found += opcode == MESSAGE
            if opcode == NONE:
                damaged += len(content)
            elif opcode in (SCHEMA, CHANNEL):
                self._drop_redefined(opcode, content, wanted)
            if opcode != MESSAGE or len(content) < MESSAGE_HEAD.size:
                continue
            number, _, log_time, _ = MESSAGE_HEAD.unpack_from(content)
            topic = wanted.get(number)
            if topic is not None and (start is None or log_time >= start) and (
                    stop is None or log_time < stop):
                rows.append((log_time, topic, bytes(content[MESSAGE_HEAD.size:])))
        if damaged:
            missing = sum(block.counts.values()) - found
            self.lose(f"{self.path.name}: {damaged} bytes in a chunk at byte {block.position} are "
                      f"damaged; {missing if missing > 0 else 'some'} messages of "
                      f"{span(block.first, block.last)} are missing")
        rows.sort(key=lambda row: row[0])
        return iter(rows)

    def _drop_redefined(self, opcode: int, content: memoryview, wanted: dict[int, str]) -> None:
        """Read no more of channels that a definition contradicts: what comes after it is of another
        topic, or of another type."""
        channels: dict[int, Channel] = {}
        schemas: dict[int, Schema] = {}
        with contextlib.suppress(DamageError):
            define(opcode, content, channels, schemas)
        for number, channel in self._channels.items():
            schema = self._schemas.get(channel.schema)
            if number in wanted and (
                    channels.get(number, channel)[:3] != channel[:3]
                    or schema and schemas.get(channel.schema, schema)[:2] != schema[:2]):
                self.lose(f"{self.path.name}: channel {number} ({wanted.pop(number)}) is defined "
                          "anew with another topic or type; its messages after that are left out")
