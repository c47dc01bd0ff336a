"""Topics of a recording as typed logs, decoded while they are read."""

import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from imu_fusion.errors import MessageError, TopicError
from imu_fusion.messages.convert import SAMPLE_TYPES, SampleType
from imu_fusion.messages.layouts import Decoded, Layout
from imu_fusion.recordings.bag_reader import Reader
from imu_fusion.samples.blocks import Growing
from imu_fusion.samples.logs import Log

_BLOCK = 2000    # messages that are decoded at once


class LogCollector:
    """Makes a log of the messages of one topic, keeping samples and not messages.

    ``refused`` maps reasons for which messages could not be decoded to how many there were;
    ``frame_ids`` are those that the others name, in order.
    """

    def __init__(self, kind: SampleType) -> None:
        self._kind = kind
        self._waiting: list[bytes] = []
        self._samples = Growing(kind.width)
        self.frame_ids: dict[str, None] = {}
        self.refused: dict[str, int] = {}

    def add(self, cdr: bytes) -> None:
        """Take one message."""
        self._waiting.append(cdr)
        if len(self._waiting) >= _BLOCK:
            self._decode()

    def log(self) -> Log:
        """The log of the messages that could be decoded, of those since it was last asked for."""
        self._decode()
        return self._kind.log(*self._samples.take(), next(iter(self.frame_ids), ""))

    def _decode(self) -> None:
        block = self._kind.layout.decode_block(self._waiting)
        self._waiting = []
        for reason in block.refused.values():
            self.refused[reason] = self.refused.get(reason, 0) + 1
        if len(block.stamp):
            self._samples.add(block.stamp, self._kind.values(block.values))
            self.frame_ids |= dict.fromkeys(block.frame_ids)


def undecodable(topic: str, refused: Mapping[str, int]) -> str:
    """Words for messages that could not be decoded."""
    reason = next(iter(refused))
    return (f"{topic}: {sum(refused.values())} messages cannot be decoded and are left out "
            f"({reason})")


def decoded_blocks(reader: Reader, topic: str, layout: Layout) -> Iterator[Decoded]:
    """The messages of a topic, decoded some at a time; ``reader.warnings`` says of those that do
    not fit their type."""
    refused: dict[str, int] = {}
    messages = reader.messages([topic])
    while waiting := [cdr for *_, cdr in itertools.islice(messages, _BLOCK)]:
        block = layout.decode_block(waiting)
        for reason in block.refused.values():
            refused[reason] = refused.get(reason, 0) + 1
        if len(block.stamp):
            yield block
    if refused:
        reader.lose(undecodable(topic, refused))


def readable_messages(reader: Reader, topic: str, form: Layout | Callable[[bytes], object]
                      ) -> list[bytes]:
    """The messages of a topic that fit their type; ``reader.warnings`` says of the others.

    Args:
        reader, topic: as of :func:`read_log`.
        form: their Layout, or what raises a MessageError of bytes that do not fit.

    Raises:
        TopicError: no such topic.
    """
    topic = reader.require(topic).name
    messages = [cdr for *_, cdr in reader.messages([topic])]
    refused = form.decode_block(messages).refused if isinstance(form, Layout) else {
        i: why for i, cdr in enumerate(messages) if (why := _why_not(form, cdr))}
    if refused:
        reader.lose(undecodable(topic, Counter(refused.values())))
    return [cdr for i, cdr in enumerate(messages) if i not in refused]


def _why_not(form: Callable[[bytes], object], cdr: bytes) -> str:
    try:
        form(cdr)
    except MessageError as error:
        return str(error)
    return ""


def read_log(reader: Reader, topic: str, log_of: Callable[[list], Log] | None = None) -> Any:
    """The log of one topic of an open recording: which subclass of Log, its type decides.

    Messages that do not fit their type are left out; ``reader.warnings`` says so.

    Args:
        reader: what :func:`imu_fusion.recordings.bag_reader.open_bag` returned.
        topic: name, with or without leading slash.
        log_of: function of a list of messages, if not the one of its type
            (such as :func:`imu_fusion.messages.convert.attitude_log`).

    Raises:
        TopicError: no such topic, or a type that has no log.
    """
    info = reader.require(topic)
    kind = SAMPLE_TYPES.get(info.msgtype)
    if kind is None:
        raise TopicError(f"{reader.path}: topic '{info.name}' is {info.msgtype}; "
                         f"logs exist for {', '.join(sorted(SAMPLE_TYPES))}")
    if log_of is not None:
        return log_of(readable_messages(reader, info.name, kind.layout))
    collector = LogCollector(kind)
    for *_, cdr in reader.messages([info.name]):
        collector.add(cdr)
    log = collector.log()
    if collector.refused:
        reader.lose(undecodable(info.name, collector.refused))
    return log
