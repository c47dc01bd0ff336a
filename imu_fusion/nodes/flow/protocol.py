"""What both ends of a session share: topics, events, QoS."""

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

STATUS_TOPIC = "/flow/status"
ACK_TOPIC = "/flow/ack"

DEPTH = 1000  # queue depth of data topics, at both ends
WINDOW = 500  # unacknowledged messages per topic; late joiners add a quarter at most
ACK_EVERY = WINDOW // 4

# Events on /flow/status. NEXT: this session ended, the source starts another (loop).
BEGIN, NEXT, END = "begin", "next", "end"
# Events on /flow/ack.
ACK, DONE = "ack", "done"

RENEWED = "renewed"  # at a topic of BEGIN: a new writer, whose numbers begin at one
COMPANY = "nodes"  # key of BEGIN beside the topics: the sinks that the source knows


def reliable_qos(depth=DEPTH, durability=DurabilityPolicy.VOLATILE):
    """The QoS of data in a session: reliable, with room for the window."""
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth,
                      reliability=ReliabilityPolicy.RELIABLE, durability=durability)


def is_reliable(qos):
    """Whether a QoS profile asks for (or offers) repeats of what was lost."""
    return qos.reliability == ReliabilityPolicy.RELIABLE


def sensor_qos():
    """The QoS of live inputs: best effort takes any publisher; deep, for bursts."""
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=DEPTH,
                      reliability=ReliabilityPolicy.BEST_EFFORT)


# A source keeps one event: who comes late hears of the present session, not of past ones.
# None is overwritten unheard, since each but the last is answered before the next.
STATUS_OFFERED = reliable_qos(1, DurabilityPolicy.TRANSIENT_LOCAL)
STATUS_HEARD = reliable_qos(100, DurabilityPolicy.TRANSIENT_LOCAL)  # of all sources together
ACK_QOS = reliable_qos(1000)


def subscribe_raw(node, msg_type, topic, callback, qos, batch=100):
    """Subscribe to CDR bytes, taking all that wait (at most ``batch``) per wake-up.

    An executor takes one message per turn of its wait set, which costs 100 us and
    more; taking what is queued in the same turn is an order of magnitude faster.

    Args:
        callback: called as ``callback(cdr: bytes, info: dict)``, info as in rclpy
            (source_timestamp, received_timestamp, publication_sequence_number).
    """
    def on_message(cdr, info):
        callback(cdr, info)
        handle = subscription.handle
        with handle:
            for _ in range(batch):
                taken = handle.take_message(msg_type, True)
                if taken is None:
                    return
                callback(*taken)

    subscription = node.create_subscription(msg_type, topic, on_message, qos, raw=True)
    return subscription


def steady_timer(node, period, callback):
    """A timer of real time: also under use_sim_time, and while nobody publishes /clock."""
    return node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def type_name(msg_type):
    """'sensor_msgs/msg/Imu' of the class."""
    return f"{msg_type.__module__.split('.')[0]}/msg/{msg_type.__name__}"


def full_name(info):
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def status_message(node_name, session, event, values):
    return DiagnosticStatus(
        level=DiagnosticStatus.OK, name=node_name, hardware_id=session, message=event,
        values=[KeyValue(key=topic, value=value) for topic, value in values.items()])
