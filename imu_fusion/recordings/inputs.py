"""Where a recording holds the topics that somebody needs, and what to say if it does not."""

from collections.abc import Mapping

from imu_fusion.recordings.bag_reader import Reader


def find_inputs(reader: Reader, required: Mapping[str, str], optional: Mapping[str, str]
                ) -> tuple[dict[str, str], str]:
    """Where a recording holds topics.

    Args:
        reader: an open recording.
        required, optional: topic to message type.

    Returns:
        dict of our topic to its name in the recording, and words for required ones that it
        lacks, '' if none.

    Raises:
        TopicError: a topic has another type.
    """
    names = {}
    for topic, msgtype in {**required, **optional}.items():
        name = reader.find(topic)
        if name is not None and reader.topics[name].count:
            names[topic] = reader.require(name, msgtype).name
    missing = {topic: msgtype for topic, msgtype in required.items() if topic not in names}
    return names, "; ".join(_explain_missing(reader, *item) for item in missing.items())


def _explain_missing(reader, topic, msgtype):
    """Words for a topic that a recording lacks, with the ones in it that would fit."""
    text = f"no messages on '{topic}' ({msgtype}); "
    fitting = [t.name for t in reader.topics.values() if t.msgtype == msgtype and t.count]
    if fitting:
        return (f"{text}of that type it has {', '.join(fitting)}: add "
                f"--remap {topic}:={fitting[0]}")
    others = ", ".join(f"{t.name} ({t.msgtype})" for t in reader.topics.values())
    return f"{text}it has {others or 'no topics'}"
