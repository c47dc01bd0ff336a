"""What all calibrations share: the recording that they read, the parameter file that they write."""

import datetime
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from imu_fusion.errors import TopicError
from imu_fusion.recordings.bag_reader import Lose, open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.samples.guard import usable_part
from imu_fusion.samples.logs import FixLog

_FIX = "fix"


def read_topic(bag: str | Path, topic: str, lose: Lose = lambda text: None
               ) -> tuple[Any, FixLog | None, list[str]]:
    """The log of the usable samples of a topic, the first usable fix of the recording (FixLog of
    one) or None, and texts on what was left out.

    Raises:
        TopicError: no such topic.
    """
    with open_bag(bag) as reader:
        names = {name.lstrip("/") for name in reader.topics}
        if topic.lstrip("/") not in names:
            raise TopicError(f"{bag}: no topic {topic}; there are: {', '.join(sorted(names))}")
        log = read_log(reader, topic)
        fix = read_log(reader, _FIX) if _FIX in names else None
        for text in reader.losses:
            lose(text)
    log, remarks = usable_part(log, topic)
    return log, fix[fix.usable][0] if fix is not None and fix.usable.any() else None, remarks


def parameter_text(sensor: str, values: Mapping[str, Any], bag: str | Path, said: Sequence[str],
                   provenance: Mapping[str, Any]) -> str:
    """A ROS 2 parameter file (YAML) for all nodes.

    Args:
        sensor: what was calibrated. values: parameters. bag: what from. said: lines for people.
        provenance: what else is known; it stands under a node name that no node has, so that
            nodes pass it by.
    """
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    lines = [f"# {sensor.capitalize()}, from {Path(bag).name}, {date}:",
             *(f"# {line}" for line in said)]
    about = {"date": date, "recording": Path(bag).name, **provenance}
    return "\n".join(lines) + "\n" + yaml.safe_dump(
        {"/**": {"ros__parameters": dict(values)},
         f"calibration_of_{sensor}": {"ros__parameters": about}},
        default_flow_style=None, sort_keys=False)
