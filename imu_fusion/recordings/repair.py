"""A clean copy of a damaged recording."""

from collections.abc import Collection, Iterable
from pathlib import Path

from imu_fusion.recordings.bag_reader import Reader, open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.targets import refuse_source


def repair(path: str | Path, directory: str | Path) -> dict[str, int]:
    """Copy all that can be read of ``path`` into a new, clean recording.

    Returns:
        dict of topic to number of messages.
    """
    refuse_source(path, directory)
    with open_bag(path) as reader, BagWriter(directory, whole=True) as writer:
        copy(reader, writer)
        return dict(writer.counts)


def copy(reader: Reader, writer: BagWriter, topics: Collection[str] | None = None,
         messages: Iterable[tuple[str, str, int, bytes]] | None = None) -> None:
    """Copy the messages of a recording, with their types and QoS.

    Args:
        topics: those to copy; None for all.
        messages: those of ``reader``, if somebody looks on.

    Topics whose type nobody defines cannot be written; ``reader.warnings`` says so.
    """
    names = list(reader.topics) if topics is None else topics
    kept = set()
    for name in names:
        if reader.definition(name) is None:
            reader.lose(f"topic {name} is not copied: the definition of its type "
                        f"{reader.topics[name].msgtype} is not in the recording")
        else:
            kept.add(name)
    for topic, msgtype, log_time, cdr in reader.messages(kept) if messages is None else messages:
        if topic in kept:
            writer.write("/" + topic.lstrip("/"), msgtype, cdr, log_time,
                         qos=reader.topics[topic].qos_profiles or None,
                         definition=reader.definition(topic))
