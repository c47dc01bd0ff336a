"""The quality of service of a topic as rosbag2 stores it."""

RELIABLE = "reliable"
BEST_EFFORT = "best_effort"

_UNLIMITED = {"sec": 9223372036, "nsec": 854775807}   # RMW_DURATION_INFINITE


def qos_profile(depth: int = 10, reliability: str = RELIABLE, durability: str = "volatile",
                history: str = "keep_last") -> dict:
    """The offered QoS of one topic as rosbag2 (metadata version 9) stores it."""
    return {"history": history, "depth": int(depth), "reliability": reliability,
            "durability": durability, "deadline": dict(_UNLIMITED), "lifespan": dict(_UNLIMITED),
            "liveliness": "automatic", "liveliness_lease_duration": dict(_UNLIMITED),
            "avoid_ros_namespace_conventions": False}
