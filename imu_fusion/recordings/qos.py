"""The quality of service of a topic as rosbag2 stores it."""

from typing import Any

from imu_fusion.errors import ParameterError
from imu_fusion.parameters.bounded_yaml import parse_yaml

RELIABLE = "reliable"
BEST_EFFORT = "best_effort"

_UNLIMITED = {"sec": 9223372036, "nsec": 854775807}   # RMW_DURATION_INFINITE
# Up to version 8 of its metadata rosbag2 wrote the numbers of rmw.
_WORDS: dict[str, dict[int, str]] = {
    "history": {1: "keep_last", 2: "keep_all"},
    "reliability": {1: RELIABLE, 2: BEST_EFFORT},
    "durability": {1: "transient_local", 2: "volatile"}}


def qos_profile(depth: int = 10, reliability: str = RELIABLE, durability: str = "volatile",
                history: str = "keep_last") -> dict:
    """The offered QoS of one topic as rosbag2 (metadata version 9) stores it."""
    return {"history": history, "depth": int(depth), "reliability": reliability,
            "durability": durability, "deadline": dict(_UNLIMITED), "lifespan": dict(_UNLIMITED),
            "liveliness": "automatic", "liveliness_lease_duration": dict(_UNLIMITED),
            "avoid_ros_namespace_conventions": False}


def read_profiles(text: str, source: str) -> list[dict]:
    """The profiles in the words of a recording, of any version of rosbag2.

    Args:
        text: YAML, a list of mappings.
        source: what is named in errors.

    Returns:
        list of :func:`qos_profile`; what is not understood is at its default, for a recording
        is worth reading without it.
    """
    try:
        found = parse_yaml(text, source)
    except ParameterError:
        return []
    return [_profile(entry) for entry in found if isinstance(entry, dict)] if isinstance(
        found, list) else []


def _profile(entry: dict[Any, Any]) -> dict:
    depth = entry.get("depth")
    values: dict[str, Any] = {
        "depth": depth} if isinstance(depth, int) and 0 <= depth < 2**31 else {}
    for name, words in _WORDS.items():
        value = entry.get(name)
        value = words.get(value) if isinstance(value, int) else value
        if value in words.values():
            values[name] = value
    return qos_profile(**values)
