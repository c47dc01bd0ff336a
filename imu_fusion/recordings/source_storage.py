"""Files of devices, read as if they were recordings: no description needed where the format is
recognised, and a YAML description where it is a table."""

from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from imu_fusion.errors import BagError, ImuFusionError
from imu_fusion.messages.samples import fits_message, msgtype_of, sample_messages
from imu_fusion.recordings.qos import qos_profile
from imu_fusion.recordings.storage import Row, Storage, StoredTopic
from imu_fusion.samples.logs import Log
from imu_fusion.sources.description import Description
from imu_fusion.sources.registry import HEAD, Format, file_source, recognise
from imu_fusion.sources.source import Block, Source
from imu_fusion.sources.table import TableSource
from imu_fusion.sources.transports.files import heads, parts

_BLOCK = 2000    # samples that are encoded at once


def format_of(path: Path) -> Format | None:
    """The format of a file, folder or archive of a device; None if it is none that is known."""
    return recognise(heads(path, HEAD))


def read_source(path: Path, source: Source) -> list[Block]:
    """All samples of a file, folder or archive that messages can hold.

    Raises:
        ImuFusionError: names the file, and the line or part that is wrong.
    """
    try:
        blocks = [block for part, data in parts(path, lose=lambda text: source.lost.update([text]))
                  for block in source.feed(data, part)]
        return [in_range(block, source) for block in blocks + source.finish()]
    except ImuFusionError:
        raise
    except Exception as error:
        raise BagError(f"{path}: damaged beyond reading ({type(error).__name__}: {error})"
                       ) from error


def in_range(block: Block, source: Source) -> Block:
    """Without the samples whose stamps no message can hold, which are counted as lost."""
    fits = fits_message(block.log.stamp)
    if fits.all():
        return block
    source.lost["samples stamped before 1970 or after 2038"] += int((~fits).sum())
    return block._replace(log=block.log[fits])


class SourceStorage(Storage):
    """See :class:`imu_fusion.recordings.storage.Storage`; samples come in order of their stamps.

    Args:
        description: content of the description file, with which this is a table.
    """

    def __init__(self, path: Path, lose: Callable[[str], object],
                 mention: Callable[[str], object], known: Format | None = None,
                 description: Mapping[str, Any] | None = None, described_in: str = "") -> None:
        super().__init__(path, lose, mention)
        source = (file_source(known, description, described_in) if known is not None else
                  TableSource(Description.from_mapping(description, described_in), where=str(path)))
        found: dict[str, list[Log]] = {}
        for topic, log, _ in read_source(path, source):
            if len(log):
                found.setdefault("/" + topic, []).append(log)
        for what, count in source.lost.items():
            lose(f"{path.name}: {count} {what}")
        for remark in source.remarks:
            mention(remark)
        if not found:
            raise BagError("; ".join([
                f"{path}: {known.about if known else 'a table'}, without any samples",
                *(f"{count} {what}" for what, count in source.lost.items()), *source.remarks]))
        self._logs = {topic: _sorted(logs) for topic, logs in found.items()}
        for topic, log in self._logs.items():
            self.topics[topic] = StoredTopic(topic, msgtype_of(log), len(log), [qos_profile()])
        self.times = (min(int(log.stamp[0]) for log in self._logs.values()),
                      max(int(log.stamp[-1]) for log in self._logs.values()))

    def messages(self, topics: Collection[str], start: int | None,
                 stop: int | None) -> Iterator[Row]:
        wanted = [(topic, log) for topic, log in self._logs.items() if topic in topics]
        stamp = np.concatenate([np.empty(0, np.int64), *(log.stamp for _, log in wanted)])
        which = np.repeat(np.arange(len(wanted)), [len(log) for _, log in wanted])
        begins = np.cumsum([0, *(len(log) for _, log in wanted)])
        inside = (stamp >= (stamp if start is None else start)) & (
            stamp < (stamp + 1 if stop is None else stop))
        order = np.argsort(stamp, kind="stable")
        order = order[inside[order]]
        for first in range(0, len(order), _BLOCK):
            block = order[first:first + _BLOCK]
            cdrs: dict[int, bytes] = {}
            for k in np.unique(which[block]).tolist():
                mine = block[which[block] == k]
                cdrs |= zip(mine.tolist(), sample_messages(wanted[k][1][mine - begins[k]]))
            for place in block.tolist():
                yield int(stamp[place]), wanted[which[place]][0], cdrs[place]


def _sorted(logs: list[Log]) -> Log:
    """Logs of one topic as one, in order of the stamps."""
    joined = Log.joined(logs)
    return joined[np.argsort(joined.stamp, kind="stable")]
