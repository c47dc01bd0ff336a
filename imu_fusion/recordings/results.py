"""results.json beside a recording: what estimators found, as plain numbers by node."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from imu_fusion.errors import BagError
from imu_fusion.recordings.targets import RESULTS_FILE, whole_file
from imu_fusion.samples.guard import Verdict

LEFT_OUT, RECORDING = "left_out", "recording"    # what was not used, of the nodes and as a whole
FINDINGS = "findings"    # texts on what looks wrong with the samples
UNDECODABLE = "cannot be decoded"
_BROKEN = {UNDECODABLE, Verdict.NEGATIVE.value, Verdict.WILD.value}


def write_results(directory: str | Path, found: Mapping[str, Any]) -> None:
    """Write what nodes found; numbers that are not finite become null.

    Raises:
        BagError: it cannot be written.
    """
    with whole_file(Path(directory) / RESULTS_FILE) as file:
        file.write_text(json.dumps(_plain(found), indent=2, allow_nan=False))


def read_results(directory: str | Path) -> dict | None:
    """What nodes found, None without such a file.

    Raises:
        BagError: the file is none of ours.
    """
    file = Path(directory) / RESULTS_FILE
    if not file.exists():
        return None
    try:
        found = json.loads(file.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise BagError(f"{file}: cannot be read ({error})") from None
    if not isinstance(found, dict):
        raise BagError(f"{file}: holds no results of nodes")
    return found


def results_of(directory: str | Path, node: str) -> dict[str, Any]:
    """What one node found, {} where there is nothing; errors as of :func:`read_results`."""
    found = (read_results(directory) or {}).get(node, {})
    if not isinstance(found, dict):
        raise BagError(f"{Path(directory) / RESULTS_FILE}: holds no results of '{node}'")
    return found


def left_out(refused: Mapping[str, Mapping], lost: Sequence[str]) -> dict[str, dict]:
    """The entry on what was not used, {} where there is nothing to say.

    Args:
        refused: node to topic to reasons and how many of each. lost: of the recording, in words.
    """
    found: dict[str, Any] = {node: topics for node, topics in refused.items() if topics}
    return {LEFT_OUT: found | ({RECORDING: list(lost)} if lost else {})} if found or lost else {}


def is_incomplete(directory: str | Path) -> bool:
    """Whether messages of the recording were lost: damaged parts, messages or stamps that are
    broken. What a sensor repeats or reports as absent is left out, too, but not lost."""
    left_out = (read_results(directory) or {}).get(LEFT_OUT, {})
    return RECORDING in left_out or any(not _BROKEN.isdisjoint(reasons)
                                        for topics in left_out.values()
                                        for reasons in topics.values())


def _plain(value):
    if isinstance(value, Mapping):
        return {key: _plain(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
