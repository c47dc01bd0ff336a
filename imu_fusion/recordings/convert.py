"""Recordings of other formats, and files of devices, as rosbag2 MCAP: whole or not at all."""

from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from imu_fusion.errors import BagError
from imu_fusion.parameters.bounded_yaml import read_yaml
from imu_fusion.recordings.array_parameters import array_parameters
from imu_fusion.recordings.bag_reader import Reader, find_topic, open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.repair import copy
from imu_fusion.recordings.targets import refuse_files, refuse_source, whole_file
from imu_fusion.sources.description import Description
from imu_fusion.sources.source import ARRAY_TOPIC

Messages = Iterable[tuple[str, str, int, bytes]]
Watch = Callable[[Messages, int], AbstractContextManager[Messages]]


@dataclass(frozen=True)
class Converted:
    """What was written: ``counts`` of topics, the ``parameter_file`` beside it, if there is one;
    the ``warnings`` of the source, whether it was ``damaged``, and the ``format`` that it was taken
    for, if it is no recording."""

    counts: dict[str, int]
    parameter_file: Path | None
    warnings: list[str]
    damaged: bool
    format: str


def convert(source: str | Path, out: str | Path, description: str | Path | None = None,
            topics: Collection[str] = (), remap: Mapping[str, str] | None = None,
            overwrite: bool = False, watch: Watch | None = None) -> Converted:
    """Convert what :func:`~imu_fusion.recordings.bag_reader.open_bag` opens.

    Args:
        source, description: see there. With accelerometers of an array in the description,
            ``<out>.yaml`` becomes the parameter file of their estimator, if it tells where they
            are; ``<out>_parameters.yaml`` if the description itself is called so.
        out: rosbag2 directory to write. overwrite: replace it, and the parameter file.
        topics: those to keep, by either name; all, if empty. remap: names of ours to those in the
            source.
        watch: makes a context that passes messages on, given them and how many they are.

    Raises:
        ImuFusionError: names the file with what is wrong; nothing is written then, and nothing
            that was there is touched.
    """
    out = Path(out)
    parameter_file = out.with_name(out.name + ".yaml")
    refuse_source(source, out)
    if description is not None:
        refuse_source(description, out)
        if Path(description).resolve() == parameter_file.resolve():
            parameter_file = out.with_name(out.name + "_parameters.yaml")
    with open_bag(source, description, remap) as reader:
        text = ""
        array = None if description is None else _array(description)
        if array is not None and not any("position" in own for own in array.own.values()):
            reader.warnings.append(f"{description}: no 'position' of the accelerometers, which the "
                                   "acceleration field needs; give it and convert again to have "
                                   "its parameter file, too")
        elif description is not None and array is not None:
            refuse_files([source, description], parameter_file)
            if parameter_file.exists() and not overwrite:
                raise BagError(f"{parameter_file}: exists already; choose another name or "
                               "--overwrite")
            text = _parameters(reader, array, Path(description))
        named = {other: name for name, other in reader.recorded.items()}
        kept = [reader.require(named.get(find_topic(named, topic) or "", topic)).name
                for topic in topics] or list(reader.topics)
        with (whole_file(parameter_file) if text else nullcontext() as beside,
              BagWriter(out, overwrite=overwrite, whole=True) as writer):
            messages: Messages = reader.messages(kept)
            with (nullcontext(messages) if watch is None else watch(
                    messages, sum(reader.topics[t].count or 0 for t in kept))) as watched:
                copy(reader, writer, kept, watched)
            if beside is not None:
                beside.write_text(text)
        return Converted(dict(writer.counts), parameter_file if text else None,
                         list(reader.warnings), reader.damaged, reader.format)


def _array(path: str | Path) -> Description | None:
    """The description, None where it has no array."""
    content = read_yaml(path)
    if not isinstance(content, dict) or not content.get("accelerometers"):
        return None
    return Description.from_mapping(content, str(path))


def _parameters(reader: Reader, array: Description, path: Path) -> str:
    """The text of the parameter file."""
    topic = f"/{ARRAY_TOPIC}{next(iter(array.array))}"
    stamps = np.array([stamp for _, _, stamp, _ in reader.messages([topic])], dtype=np.int64)
    return (f"# Made from {reader.path.name} as {path.name} says.\n"
            + array_parameters(array, stamps, str(path)))
