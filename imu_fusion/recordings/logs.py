"""One topic of a recording as a typed log."""

from collections.abc import Callable
from typing import Any

from imu_fusion.errors import TopicError
from imu_fusion.messages.convert import SAMPLE_TYPES
from imu_fusion.recordings.bag_reader import Reader
from imu_fusion.samples.logs import Log


def read_log(reader: Reader, topic: str, log_of: Callable[[list], Log] | None = None) -> Any:
    """The log of one topic of an open recording: which subclass of Log, its type decides.

    Args:
        reader: what :func:`imu_fusion.recordings.bag_reader.open_bag` returned.
        topic: name, with or without leading slash.
        log_of: function of a list of messages, if not the one of its type
            (such as :func:`imu_fusion.messages.convert.attitude_log`).

    Raises:
        TopicError: no such topic, or a type that has no log.
        MessageError: bytes that do not fit the type.
    """
    info = reader.require(topic)
    if log_of is None and info.msgtype not in SAMPLE_TYPES:
        raise TopicError(f"{reader.path}: topic '{info.name}' is {info.msgtype}; "
                         f"logs exist for {', '.join(sorted(SAMPLE_TYPES))}")
    log_of = log_of or SAMPLE_TYPES[info.msgtype].read
    return log_of([cdr for *_, cdr in reader.messages([info.name])])
