"""A clean copy of a damaged recording."""

from pathlib import Path

from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.targets import refuse_source


def repair(path: str | Path, directory: str | Path) -> dict[str, int]:
    """Copy all that can be read of ``path`` into a new, clean recording.

    Returns:
        dict of topic to number of messages.
    """
    refuse_source(path, directory)
    with open_bag(path) as reader, BagWriter(directory, typestore=reader.typestore,
                                             whole=True) as writer:
        for topic, msgtype, log_time, cdr in reader.messages():
            writer.write(topic, msgtype, cdr, log_time, qos=reader.topics[topic].qos_profiles)
        return dict(writer.counts)
