"""Writing recordings: rosbag2 directories with MCAP.

Log and publish time are kept apart, chunks carry CRCs.
"""

import contextlib
import os
import shutil
import struct
from collections import Counter
from pathlib import Path

import yaml
from rosbags.typesys.store import Typestore

from imu_fusion.errors import BagError
from imu_fusion.messages.typestore import TYPES
from imu_fusion.recordings.mcap_writer import McapWriter
from imu_fusion.recordings.qos import qos_profile
from imu_fusion.recordings.results import RESULTS_FILE

# What we write into the directory of a recording beside its files.
_BESIDE = ("metadata.yaml", RESULTS_FILE, "report.html")


class _Dumper(yaml.SafeDumper):
    """YAML without anchors: equal values are written out each time."""

    def ignore_aliases(self, data: object) -> bool:
        return True


class BagWriter:
    """Write a rosbag2 directory: ``<directory>/<name>_0.mcap`` and ``metadata.yaml``.

    A chunk is on its way to the disk as soon as it is complete, so that a crash
    loses at most the open one.

    Args:
        directory: must not exist or be empty, unless ``overwrite``.
        compression: ``zstd``, ``lz4`` or ``none``.
        chunk_size: bytes of messages per chunk.
        overwrite: replace what is there, if it is a recording.
        typestore: source of message definitions; Jazzy's by default.

    Raises:
        BagError: the directory is in the way or cannot be written.
    """

    def __init__(self, directory: str | Path, compression: str = "zstd",
                 chunk_size: int = 256 * 1024, overwrite: bool = False,
                 typestore: Typestore = TYPES):
        self.directory = Path(directory)
        self.counts: Counter[str] = Counter()
        self._typestore = typestore
        self._channels: dict[str, int] = {}
        self._topics: dict[str, dict] = {}
        self._prepare(overwrite)
        name = self.directory.resolve().name
        self._file = f"{name}_0.mcap"
        try:
            self._stream = open(self.directory / self._file, "wb")  # noqa: SIM115, closed by close
            self._writer = McapWriter(self._stream, "ros2", "imu_fusion", chunk_size, compression)
            self._stream.flush()
        except OSError as error:
            raise BagError(f"{self.directory}: cannot be written ({error.strerror})") from None

    def _prepare(self, overwrite):
        try:
            if self.directory.exists():
                if not self.directory.is_dir():
                    raise BagError(f"{self.directory}: is a file, not a directory to record into")
                present = sorted(p.name for p in self.directory.iterdir())
                ours = all(p in _BESIDE or p.endswith((".mcap", ".db3")) for p in present)
                if present and not (overwrite and ours):
                    raise BagError(f"{self.directory}: exists and is not empty; choose another "
                                   "directory" + ("" if ours else " (it holds other files)"))
                shutil.rmtree(self.directory)
            self.directory.mkdir(parents=True)
        except OSError as error:
            raise BagError(f"{self.directory}: cannot be written ({error.strerror})") from None

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(self, *_):
        self.close()

    def add_topic(self, topic: str, msgtype: str, qos: list[dict] | None = None,
                  definition: tuple[str, str] | None = None) -> None:
        """Register a topic (done by :meth:`write` when needed).

        Args:
            qos: list of :func:`qos_profile` as offered by its publishers.
            definition: (ros2msg text, RIHS01 hash) of a type that Jazzy does not have.
        """
        if not topic.startswith("/"):
            raise BagError(f"{self.directory}: topic '{topic}' must be absolute in a recording: "
                           f"'/{topic}'")
        qos = [qos_profile()] if qos is None else qos
        if definition is None:
            if msgtype not in self._typestore.fielddefs:
                raise BagError(f"topic {topic}: the definition of its type {msgtype} is not known")
            definition = (self._typestore.generate_msgdef(msgtype, ros_version=2)[0],
                          self._typestore.hash_rihs01(msgtype))
        text, digest = definition
        schema = self._writer.add_schema(msgtype, "ros2msg", text.encode())
        self._channels[topic] = self._writer.add_channel(
            topic, "cdr", schema, {"offered_qos_profiles": yaml.dump(qos, Dumper=_Dumper),
                                   "topic_type_hash": digest})
        self._topics[topic] = {"name": topic, "type": msgtype, "serialization_format": "cdr",
                               "offered_qos_profiles": qos, "type_description_hash": digest}
        self.counts[topic] += 0

    def write(self, topic: str, msgtype: str, cdr: bytes, log_time: int,
              publish_time: int | None = None, qos: list[dict] | None = None,
              definition: tuple[str, str] | None = None) -> None:
        """Append one message.

        Args:
            topic, msgtype: names; the topic is registered at its first message.
            cdr: serialized message with encapsulation.
            log_time: int nanoseconds, when it was received.
            publish_time: int nanoseconds, when it was sent or measured; ``log_time`` if unknown.

        Raises:
            BagError: the disk is full or the topic's type changed; what was written stays.
        """
        if topic not in self._channels:
            self.add_topic(topic, msgtype, qos, definition)
        elif self._topics[topic]["type"] != msgtype:
            raise BagError(f"{self.directory}: topic {topic} is {self._topics[topic]['type']}, "
                           f"not {msgtype}")
        try:
            self._writer.add_message(self._channels[topic], self.counts[topic], log_time,
                                     log_time if publish_time is None else publish_time,
                                     bytes(cdr))
        except OSError as error:
            raise BagError(f"{self.directory}: writing failed ({error.strerror}); what was "
                           "written before stays readable") from error
        except struct.error as error:
            raise BagError(f"{self.directory}: topic {topic}: a message at {log_time} ns cannot be "
                           f"recorded: MCAP counts from 1970 on ({error})") from None
        self.counts[topic] += 1

    def close(self) -> None:
        """Write index and metadata; safe to call twice.

        Raises:
            BagError: the disk is full; complete chunks stay readable.
        """
        if self._stream.closed:
            return
        try:
            self._writer.end_chunk()
            information = self._information()
            # As rosbag2 does: the file alone tells what the directory would.
            self._writer.finish("rosbag2", {"serialized_metadata": yaml.dump(
                information, Dumper=_Dumper, sort_keys=False)})
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self._write_metadata(information)
        except OSError as error:
            raise BagError(f"{self.directory}: closing failed ({error.strerror}); complete "
                           "chunks stay readable") from error
        finally:
            with contextlib.suppress(OSError):  # reported above
                self._stream.close()

    def abandon(self) -> None:
        """Close the file as it is, after an error: no index, chunks stay readable."""
        with contextlib.suppress(OSError):
            self._stream.close()

    def _information(self):
        """What rosbag2 calls the bag's metadata."""
        first = self._writer.start_time or 0
        duration = (self._writer.end_time or 0) - first
        total = sum(self.counts.values())
        times = {"starting_time": {"nanoseconds_since_epoch": first},
                 "duration": {"nanoseconds": duration}, "message_count": total}
        return {
            "version": 9, "storage_identifier": "mcap", **times,
            "relative_file_paths": [self._file],
            "topics_with_message_count": [
                {"topic_metadata": metadata, "message_count": self.counts[topic]}
                for topic, metadata in self._topics.items()],
            "compression_format": "", "compression_mode": "",
            "files": [{"path": self._file, **times}],
            "custom_data": None, "ros_distro": "jazzy"}

    def _write_metadata(self, information):
        # Under another name first: a metadata.yaml that exists is complete.
        temporary = self.directory / "metadata.yaml.part"
        temporary.write_text(yaml.dump({"rosbag2_bagfile_information": information},
                                       Dumper=_Dumper, sort_keys=False))
        os.replace(temporary, self.directory / "metadata.yaml")
