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

from imu_fusion.errors import BagError
from imu_fusion.messages.typestore import TYPES
from imu_fusion.recordings.mcap_writer import McapWriter
from imu_fusion.recordings.qos import qos_profile
from imu_fusion.recordings.targets import (
    LIBRARY,
    METADATA_FILE,
    make_parents,
    remove_empty,
    why_not_replaced,
)


class _Dumper(yaml.SafeDumper):
    """YAML without anchors: equal values are written out each time."""

    def ignore_aliases(self, data: object) -> bool:
        return True


class BagWriter:
    """Write a rosbag2 directory: ``<directory>/<name>_0.mcap`` and ``metadata.yaml``.

    A chunk is on its way to the disk as soon as it is complete, so that a crash
    loses at most the open one. With ``whole`` the recording appears at its place complete, by
    renaming, or not at all: for what can be made again. What is replaced goes once the new one is
    complete.

    Args:
        directory: must not exist or be empty, unless ``overwrite``. The attribute ``directory``
            is where files are written now.
        compression: ``zstd``, ``lz4`` or ``none``.
        chunk_size: bytes of messages per chunk.
        overwrite: replace what is there, if it is a recording and nothing else.
        whole: see above; leaving the context by an exception leaves everything as it was.

    Raises:
        BagError: the directory is in the way or cannot be written.
    """

    def __init__(self, directory: str | Path, compression: str = "zstd",
                 chunk_size: int = 256 * 1024, overwrite: bool = False,
                 whole: bool = False):
        self._target = Path(os.path.realpath(directory))
        self.directory = self._target
        self._replaced: Path | None = None    # where what was there is kept until the end
        self._folders: list[Path] = []        # that were made for it, innermost first
        self._whole = whole
        self.counts: Counter[str] = Counter()
        self._channels: dict[str, int] = {}
        self._topics: dict[str, dict] = {}
        self._prepare(overwrite)
        self._file = f"{self._target.name}_0.mcap"
        try:
            self._stream = open(self.directory / self._file, "wb")  # noqa: SIM115, closed by close
            self._writer = McapWriter(self._stream, "ros2", LIBRARY, chunk_size, compression)
            self._stream.flush()
        except OSError as error:
            self._restore()
            raise BagError(f"{self._target}: cannot be written ({error.strerror})") from None

    def _prepare(self, overwrite):
        target = self._target
        try:
            occupied = os.path.lexists(target)
            if occupied and not target.is_dir():
                raise BagError(f"{target}: is a file, not a directory to record into")
            occupied = occupied and any(target.iterdir())
            if occupied:
                why = why_not_replaced(target)
                if why or not overwrite:
                    raise BagError(f"{target}: exists and is not empty; choose another directory"
                                   + (f" ({why})" if why else ""))
            self._folders = make_parents(target)
            if self._whole:
                # Inside of an empty directory that is there: it may be a mount point.
                inside = target.is_dir() and not occupied
                self.directory = target / ".part" if inside else self._beside("part")
                self.directory.mkdir()
            else:
                if occupied:
                    self._put_aside()
                target.mkdir(exist_ok=True)
        except OSError as error:
            raise BagError(f"{target}: cannot be written ({error.strerror})") from None

    def _beside(self, what):
        return self._target.with_name(f".{self._target.name}.{what}-{os.getpid()}")

    def _put_aside(self):
        self._replaced = self._beside("replaced")
        os.rename(self._target, self._replaced)

    def _restore(self):
        """Everything as it was before."""
        with contextlib.suppress(OSError):
            shutil.rmtree(self.directory)
        if self._replaced is not None:
            os.rename(self._replaced, self._target)
        remove_empty(self._folders)

    def _appear(self):
        """Put the complete recording at its place; let go of what it replaces."""
        if self.directory.parent == self._target:
            for file in sorted(self.directory.iterdir(), key=lambda f: f.name == METADATA_FILE):
                os.replace(file, self._target / file.name)
            self.directory.rmdir()
        elif self._whole:
            if self._target.exists():
                self._put_aside()
            os.rename(self.directory, self._target)
        self.directory = self._target
        if self._replaced is not None:
            shutil.rmtree(self._replaced)

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_):
        if kind is not None and self._whole:
            self.abandon()
        else:
            self.close()

    def add_topic(self, topic: str, msgtype: str, qos: list[dict] | None = None,
                  definition: tuple[str, str] | None = None) -> None:
        """Register a topic (done by :meth:`write` when needed).

        Args:
            qos: list of :func:`qos_profile` as offered by its publishers.
            definition: (ros2msg text, RIHS01 hash) of a type that Jazzy does not have.
        """
        if not topic.startswith("/"):
            raise BagError(f"{self._target}: topic '{topic}' must be absolute in a recording: "
                           f"'/{topic}'")
        qos = [qos_profile()] if qos is None else qos
        if definition is None:
            if msgtype not in TYPES.fielddefs:
                raise BagError(f"topic {topic}: the definition of its type {msgtype} is not known")
            definition = (TYPES.generate_msgdef(msgtype, ros_version=2)[0],
                          TYPES.hash_rihs01(msgtype))
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
            raise BagError(f"{self._target}: topic {topic} is {self._topics[topic]['type']}, "
                           f"not {msgtype}")
        try:
            self._writer.add_message(self._channels[topic], self.counts[topic], log_time,
                                     log_time if publish_time is None else publish_time,
                                     bytes(cdr))
        except OSError as error:
            raise BagError(f"{self._target}: writing failed ({error.strerror}); "
                           + self._what_stays()) from error
        except struct.error as error:
            raise BagError(f"{self._target}: topic {topic}: a message at {log_time} ns cannot be "
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
            self._stream.close()
            self._appear()
        except OSError as error:
            self.abandon()
            raise BagError(f"{self._target}: closing failed ({error.strerror}); "
                           + self._what_stays()) from error

    def abandon(self) -> None:
        """After an error. A ``whole`` recording vanishes, and what was there before stays. Of
        another one the file stays as it is, without index, its chunks readable."""
        with contextlib.suppress(OSError):
            self._stream.close()
        if self._whole and self.directory != self._target:
            self._restore()

    def _what_stays(self):
        if self._whole:
            return "nothing was written"
        kept = f", and what it replaces at {self._replaced}" if self._replaced else ""
        return "what was written before stays readable" + kept

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
        temporary = self.directory / f"{METADATA_FILE}.part"
        temporary.write_text(yaml.dump({"rosbag2_bagfile_information": information},
                                       Dumper=_Dumper, sort_keys=False))
        os.replace(temporary, self.directory / METADATA_FILE)
