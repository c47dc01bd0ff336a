"""Flow control between our nodes: nothing lost, ends known, whatever the speed.

DDS drops messages when a subscriber lags (KEEP_LAST) or blocks the publisher
(KEEP_ALL). So our nodes count. A *session* is one pass of data from a *source*
(the replayer, or a node that processes a session of somebody else):

1. The source announces the session on ``/flow/status``: its topics, with types
   and the sequence number after which the session starts, and the sinks that it
   knows. A node between waits for the same sinks: two nodes that the source has
   discovered may not have discovered each other.
2. Every node that owns a :class:`FlowSink` (seen in the graph as a publisher of
   ``/flow/ack``) answers on ``/flow/ack`` which of the topics it takes. The
   source sends nothing before all have answered, and their subscriptions are
   reliable and matched.
3. Sinks acknowledge the highest sequence number received. The source keeps at
   most ``WINDOW`` messages per topic unacknowledged, less than the queue depth.
4. At the end the source states the last sequence number of each topic, so that
   a sink knows when it has everything, or what it lost, and says that it is done.

A processing node is sink and source, tied by a :class:`Relay`: it answers and
acknowledges upstream only while its own outputs may flow, so that back pressure,
readiness and the end of the stream pass through any chain of nodes.

Without a session (live drivers) nobody waits and nobody acknowledges. Other
people's subscribers never acknowledge; :attr:`FlowSource.foreign` names them.

Both topics carry diagnostic_msgs/DiagnosticStatus: ``name`` is the node,
``hardware_id`` the session, ``message`` the event, ``values`` topic and numbers.
"""

from imu_fusion.nodes.flow.protocol import (
    ACK_EVERY,
    BEGIN,
    DEPTH,
    END,
    NEXT,
    WINDOW,
    reliable_qos,
    sensor_qos,
    steady_timer,
)
from imu_fusion.nodes.flow.relay import Relay
from imu_fusion.nodes.flow.sink import FlowSink
from imu_fusion.nodes.flow.source import FlowSource

__all__ = ["ACK_EVERY", "BEGIN", "DEPTH", "END", "NEXT", "WINDOW", "FlowSink", "FlowSource",
           "Relay", "reliable_qos", "sensor_qos", "steady_timer"]
