"""A file of a device, played at its own pace."""

import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from imu_fusion.errors import DeviceError
from imu_fusion.messages.layouts import NANOSECONDS
from imu_fusion.recordings.source_storage import format_of, read_source
from imu_fusion.samples.logs import Log
from imu_fusion.sources.description import Description
from imu_fusion.sources.registry import file_source
from imu_fusion.sources.source import Block, Source
from imu_fusion.sources.table import TableSource

_PLAYED = 0.01       # s of a file that are published at once


class Lot(NamedTuple):
    """Samples that came together."""

    blocks: list[Block]
    arrival: int


class DeviceFile:
    """A file, folder or archive of a device.

    Args:
        path: of it. description, described_in: content of the description file, and its name.

    ``source`` has read it, ``topics`` are in it.
    """

    def __init__(self, path: Path, description: Any, described_in: str) -> None:
        if not path.exists():
            raise DeviceError(f"{path}: no such file")
        known = format_of(path)
        if description is not None and (known is None or not known.options):
            self.source: Source = TableSource(Description.from_mapping(description, described_in))
        elif known is not None:
            self.source = file_source(known, description, described_in)
        else:
            raise DeviceError(f"{path}: of no format that is known; a table needs a description")
        blocks = [block for block in read_source(path, self.source) if len(block.log)]
        self._logs: dict[tuple[str, str], Log] = {}
        for key in dict.fromkeys((block.topic, block.clock) for block in blocks):
            joined = Log.joined([b.log for b in blocks if (b.topic, b.clock) == key])
            self._logs[key] = joined[np.argsort(joined.stamp, kind="stable")]
        if not self._logs:
            raise DeviceError(f"{path}: without any samples")
        self.topics = tuple(dict.fromkeys(topic for topic, _ in self._logs))
        self._first = min(int(log.stamp[0]) for log in self._logs.values())
        self._last = max(int(log.stamp[-1]) for log in self._logs.values())
        self._played = self._first - 1
        self._begun: float | None = None

    def due(self) -> tuple[Lot, float | None]:
        """(samples that are due, s until the next ones; None at the end)."""
        if self._begun is None:
            self._begun = time.monotonic()
        until = self._first + round((time.monotonic() - self._begun) * NANOSECONDS)
        blocks = [Block(topic, part, clock) for (topic, clock), log in self._logs.items()
                  if len(part := log.between(self._played + 1, until + 1))]
        self._played = until
        return Lot(blocks, time.time_ns()), None if until >= self._last else _PLAYED
