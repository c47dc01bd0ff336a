"""Where a recording holds the topics that somebody needs, and what to say if it does not."""

from collections.abc import Collection, Mapping

from imu_fusion.recordings.bag_reader import Reader
from imu_fusion.sources.source import ARRAY_TOPIC


def find_inputs(reader: Reader, required: Mapping[str, str], optional: Mapping[str, str],
                dispensable: Collection[str] = ()) -> tuple[dict[str, str], str]:
    """Where a recording holds topics.

    Args:
        reader: an open recording.
        required, optional: topic to message type.
        dispensable: required topics that are done without where a recording holds nothing of their
            type, so that none has another name.

    Returns:
        dict of our topic to its name in the recording, and words for required ones that it
        lacks, '' if none. An optional one of another type is lacking, too, and ``reader.warnings``
        says so.
    """
    names, missing = {}, []
    for topic, msgtype in {**required, **optional}.items():
        name = reader.find(topic)
        if name is None or not reader.topics[name].count:
            why = f"no messages on '{topic}' ({msgtype})"
        elif reader.topics[name].msgtype != msgtype:
            why = f"topic '{name}' is {reader.topics[name].msgtype}, expected {msgtype}"
            if topic in optional:
                reader.mention(f"{why}; it is left out")
        else:
            names[topic] = name
            continue
        if topic in dispensable and not any(
                t.msgtype == msgtype and t.count for t in reader.topics.values()):
            continue
        if topic in required:
            missing.append(f"{why}; {_instead(reader, topic, msgtype)}")
    return names, "; ".join(missing)


def _instead(reader: Reader, topic: str, msgtype: str) -> str:
    """Words for the topics of a recording that would fit. One accelerometer of an array does not,
    though its messages have the type of an Imu's."""
    fitting = [t.name for t in reader.topics.values() if t.msgtype == msgtype and t.count
               and not t.name.lstrip("/").startswith(ARRAY_TOPIC)]
    if fitting:
        return (f"of that type it has {', '.join(fitting)}: add "
                f"--remap {topic}:={fitting[0]}")
    held = [t for t in reader.topics.values() if t.count]
    others = [f"{t.name} ({t.msgtype})" for t in held
              if not t.name.lstrip("/").startswith(ARRAY_TOPIC)]
    if not others and held:
        return "it has accelerometers of an array"
    return f"it has {', '.join(others) or 'no messages'}"
