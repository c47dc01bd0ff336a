"""sqlite3 files of rosbag2, whole or damaged.

Messages are read in order of log time through the index of the file. Where a page of it is
damaged, what is left is fetched row by row, and the rows that cannot be read are counted.
"""

import os
import sqlite3
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from urllib.parse import quote

from imu_fusion.errors import BagError
from imu_fusion.recordings.qos import read_profiles
from imu_fusion.recordings.storage import Row, Storage, StoredTopic, largest_chunk, span

_LARGEST_STAMP = 2**63 - 1
_ROWS = 1000             # looked for at once
_SMALLEST = 32           # bytes that a row takes at least: bounds the rows that may be missing
_GIVE_UP = 2000          # rows in a row that cannot be read: the rest of the file is not there


class SqliteStorage(Storage):
    """See :class:`imu_fusion.recordings.storage.Storage`. Log times below zero, which nothing else
    can hold, are zero."""

    def __init__(self, path: Path, lose: Callable[[str], object],
                 mention: Callable[[str], object]) -> None:
        super().__init__(path, lose, mention)
        beside = [file.name for file in (Path(f"{path}-wal"), Path(f"{path}-journal"))
                  if file.exists() and file.stat().st_size]
        # Immutable: sqlite neither looks for files beside it nor makes any, as it would even to
        # read; with what a killed recorder has left there it must, if it can.
        for options in (("mode=ro", "immutable=1") if beside else ("immutable=1",)):
            self._database = sqlite3.connect(
                f"file:{quote(os.path.realpath(path))}?{options}", uri=True,
                check_same_thread=False)
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(largest_chunk(), 10**9))
            self._database.text_factory = lambda data: data.decode("utf-8", "replace")
            try:
                self._open()
                return
            except sqlite3.Error as error:
                self._database.close()
                reason = str(error)
            if options != "immutable=1":
                self.lose(f"{path.name}: {', '.join(beside)} cannot be used ({reason}); what is "
                          "only there is missing")
        raise BagError(f"{path}: no recording of rosbag2, or damaged at its beginning ({reason})"
                       + (f"; a {path.name}-wal that was beside it belongs to it"
                          if "no such table" in reason and not beside else ""))

    def close(self) -> None:
        self._database.close()

    def messages(self, topics: Collection[str], start: int | None,
                 stop: int | None) -> Iterator[Row]:
        wanted = {number: name for number, name in self._numbers.items() if name in topics}
        low = start or -_LARGEST_STAMP
        high = _LARGEST_STAMP if stop is None else stop - 1
        where = (f"topic_id in ({', '.join('?' * len(wanted))}) and timestamp >= ? "
                 "and timestamp <= ?")
        values = (*wanted, low, high)
        done = (low, -1)
        try:
            for number, stamp, data, row in self._database.execute(
                    f"select topic_id, timestamp, data, id from messages where {where} "
                    "order by timestamp, id", values):
                done = (stamp, row)
                if isinstance(data, bytes) and isinstance(stamp, int):
                    yield max(stamp, 0), wanted[number], data
                else:
                    self.lose(f"{self.path.name}: messages of {wanted[number]} are no bytes and "
                              "left out")
        except (sqlite3.Error, OverflowError, MemoryError) as error:
            where = span(done[0], None) if done[1] >= 0 else "all of it"
            self.lose(f"{self.path.name}: damaged ({error}); what is left, {where}, is fetched row "
                      "by row")
            yield from self._salvage(wanted, done, high)

    def _open(self) -> None:
        self.topics.clear()
        self._numbers: dict[int, str] = {}
        self._others: set[int] = set()    # topics that are known and left out
        try:
            kinds = dict(self._database.execute(
                "select name, type from sqlite_master where name in ('topics', 'messages')"))
        except sqlite3.DatabaseError:    # shorter than it says: sqlite would read nothing of it
            self._database.execute("pragma writable_schema = on")
            kinds = dict(self._database.execute(
                "select name, type from sqlite_master where name in ('topics', 'messages')"))
            self.lose(f"{self.path.name}: cut off, or damaged at its beginning")
        if any(kind != "table" for kind in kinds.values()):    # a view may be without end
            raise sqlite3.DatabaseError("topics and messages are no tables")
        self._make_topics()
        self._count()

    def _make_topics(self) -> None:
        columns = {row[1] for row in self._database.execute("pragma table_info(topics)")}
        texts = self._definitions()
        digest = "type_description_hash" if "type_description_hash" in columns else "''"
        qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
        for number, name, msgtype, encoding, profiles, value in self._database.execute(
                f"select id, name, type, serialization_format, {qos}, {digest} from topics"):
            name, msgtype = str(name), str(msgtype)
            if encoding != "cdr" or not name:
                self.left_out.append(f"{name} ({encoding})")
                self._others.add(number)
                continue
            if name in self.topics and self.topics[name].msgtype != msgtype:
                self.lose(f"topic {name} holds several types and is read as "
                          f"{self.topics[name].msgtype}")
                self._others.add(number)
                continue
            self._numbers[number] = name
            text = texts.get(msgtype)
            self.topics[name] = StoredTopic(
                name, msgtype, 0, read_profiles(str(profiles), f"{self.path.name}, QoS of {name}"),
                (text, str(value)) if text else None)

    def _definitions(self) -> dict[str, str]:
        try:
            return {str(name): str(text) for name, encoding, text in self._database.execute(
                "select topic_type, encoding, encoded_message_definition from message_definitions")
                if encoding == "ros2msg"}
        except sqlite3.Error:    # files of before Iron have no such table
            return {}

    def _count(self) -> None:
        try:
            for number, count in self._database.execute(
                    "select topic_id, count(*) from messages group by topic_id"):
                if number in self._numbers:
                    self.topics[self._numbers[number]].count += count
                elif number not in self._others:
                    self.lose(f"{self.path.name}: {count} messages are of a topic ({number}) that "
                              "is not listed; they are left out")
            first, last = self._database.execute(
                "select min(timestamp), max(timestamp) from messages").fetchone()
            if isinstance(first, int) and isinstance(last, int):
                self.times = max(first, 0), max(last, 0)
                if first < 0:
                    self.mention(f"{self.path.name}: log times go down to {first} ns; those below "
                                 "zero are read as zero")
        except sqlite3.Error as error:
            self.lose(f"{self.path.name}: damaged ({error}); what can be read is read row by row")
            stamps = []
            for _, number, stamp in self._rows_left():
                if number in self._numbers:
                    self.topics[self._numbers[number]].count += 1
                    stamps.append(stamp)
            if stamps:
                self.times = max(min(stamps), 0), max(0, *stamps)

    def _rows_left(self) -> Iterator[tuple[int, int, int]]:
        """(row, topic, log time) of all rows that can be reached, in order of the rows."""
        size = self.path.stat().st_size
        row, most, lost, in_a_row = 0, size // _SMALLEST, 0, 0
        while row <= most and in_a_row < _GIVE_UP:
            try:
                found = self._database.execute(
                    "select id, topic_id, timestamp from messages not indexed where id >= ? "
                    "order by id limit ?", (row, _ROWS)).fetchall()
            except (sqlite3.Error, OverflowError):
                found = []
                for one in range(row, row + _ROWS):
                    try:
                        found += self._database.execute(
                            "select id, topic_id, timestamp from messages where id = ?",
                            (one,)).fetchall()
                        in_a_row = 0
                    except (sqlite3.Error, OverflowError):
                        lost, in_a_row = lost + 1, in_a_row + 1
                        if in_a_row >= _GIVE_UP:
                            break
                yield from (entry for entry in found if all(isinstance(v, int) for v in entry))
                row += _ROWS
                continue
            if not found:
                break
            yield from (entry for entry in found if all(isinstance(v, int) for v in entry))
            # A damaged page may name any row, also those that have been.
            row = max(found[-1][0] + 1, row + len(found))
        if lost:
            self.lose(f"{self.path.name}: rows are on damaged pages and lost")

    def _salvage(self, wanted: dict[int, str], done: tuple[int, int], high: int) -> Iterator[Row]:
        left = sorted((stamp, row, number) for row, number, stamp in self._rows_left()
                      if number in wanted and done < (stamp, row) and stamp <= high)
        missing = []
        for stamp, row, number in left:
            try:
                data = self._database.execute("select data from messages where id = ?",
                                              (row,)).fetchone()
            except (sqlite3.Error, OverflowError, MemoryError):
                data = None
            if data is not None and isinstance(data[0], bytes):
                yield max(stamp, 0), wanted[number], data[0]
            else:
                missing.append(stamp)
        if missing:
            self.lose(f"{self.path.name}: {len(missing)} messages of "
                      f"{span(missing[0], missing[-1])} cannot be read and are left out")
