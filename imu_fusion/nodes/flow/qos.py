"""QoS of data, timers of real time, and names of endpoints in the graph."""

import time
from collections.abc import Callable
from typing import TypeVar

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.timer import Timer
from rclpy.topic_endpoint_info import TopicEndpointInfo

E = TypeVar("E")

# The executor looks at each event of each publisher in each turn, and most of a live node's time
# goes there. What they tell of, QoS that do not match, a subscription tells as well.
SILENT = PublisherEventCallbacks(use_default_callbacks=False)

AT_ONCE = Duration(nanoseconds=0)
DEPTH = 1000  # queue depth of writers, and of readers outside sessions


def reliable_qos(depth: int = DEPTH,
                 durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    """The QoS of writers: reliable, with room for more than the window."""
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth,
                      reliability=ReliabilityPolicy.RELIABLE, durability=durability)


def sensor_qos() -> QoSProfile:
    """The QoS of live inputs: best effort takes any publisher; deep, for bursts."""
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=DEPTH,
                      reliability=ReliabilityPolicy.BEST_EFFORT)


def live_qos(name: str) -> QoSProfile:
    """That of the parameter ``qos``: 'reliable' or 'sensor_data'."""
    return reliable_qos() if name == "reliable" else sensor_qos()


def session_qos() -> QoSProfile:
    """The QoS of readers in a session: what is not taken is not overwritten."""
    return QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)


def steady_timer(node: Node, period: float, callback: Callable[[], object]) -> Timer:
    """A timer of real time: also under use_sim_time, and while nobody publishes /clock."""
    return node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def type_name(msg_type: type) -> str:
    """'sensor_msgs/msg/Imu' of the class."""
    return f"{msg_type.__module__.split('.')[0]}/msg/{msg_type.__name__}"


def full_name(info: TopicEndpointInfo) -> str:
    """Name of the node of an endpoint."""
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def gid(info: TopicEndpointInfo) -> str:
    """Identity of an endpoint; its first :data:`PARTICIPANT` characters are of its process."""
    return bytes(info.endpoint_gid).hex()


PARTICIPANT = 24
UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"  # as rmw calls it: endpoints are discovered before their names
_KEPT = 1.0  # s


class Endpoints:
    """Those of a topic, as the graph shows them. To be told of them takes a hundred times as long
    as to count them: so they are asked for when their number changes, and once a second.

    Args:
        count, infos: of a node, both ask by topic.
    """

    def __init__(self, count: Callable[[str], int],
                 infos: Callable[[str], list[TopicEndpointInfo]]) -> None:
        self._count, self._infos = count, infos
        self._known: dict[str, tuple[float, list[TopicEndpointInfo]]] = {}

    def __getitem__(self, topic: str) -> list[TopicEndpointInfo]:
        asked, found = self._known.get(topic, (float("-inf"), []))
        if (len(found) != self._count(topic) or time.monotonic() - asked > _KEPT
                or any(info.node_name == UNKNOWN_NODE for info in found)):
            found = self._infos(topic)
            self._known[topic] = time.monotonic(), found
        return found


def made(infos: Callable[[str], list], topic: str, make: Callable[[], E],
         participant: str = "") -> tuple[E, str]:
    """Make an endpoint: (what ``make`` returned, its gid).

    rclpy does not tell the gid of what it has made. It is the one that is new in the graph.
    """
    before = {gid(info) for info in infos(topic)}
    endpoint = make()
    new, = {g for g in map(gid, infos(topic)) if g.startswith(participant)} - before
    return endpoint, new
