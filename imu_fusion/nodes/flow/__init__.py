"""Flow control between our nodes: nothing lost, ends known, whatever the speed.

A *session* is one pass of data from a node that sends it (the replayer, or a node that
processes the session of somebody else). What makes it lossless:

1. **DDS holds back.** Writers are RELIABLE KEEP_LAST 1000, readers in a session KEEP_ALL. After
   500 messages (or 16 MB) a writer waits until all are acknowledged; an acknowledged message is
   in the queue of the reader. A full queue acknowledges nothing. In a node between, what may not
   leave waits, and while 500 wait the node does not take: its queues fill, its writers stop.
2. **Each node says what it does**, on one latched topic of its own, ``<node>/_flow/<instance>``
   (diagnostic_msgs/DiagnosticArray, :class:`State`): which session it sends, with a writer and
   counts for each topic, and which sessions it has joined and finished. Always all of it: who
   hears the last state knows everything, and none can be overwritten unheard. An instance is one
   start of a node: the same name later, or twice, is somebody else.
3. **Joining**: a session lists the instances that it knows, and sends nothing before each has
   answered with the readers that it has made, and these are matched. Who comes later is added to
   the list: sending stops, the counts are stated, the newcomer answers; so does one that had lost
   sight of the sender (a lease may run out on one side only). A node between takes
   nothing before its own session may send, and lists also those whom its sender knows (discovery
   between each two nodes takes its own time); so readiness passes along the chain. Who waits for
   no names begins when nobody new has been seen for a second.
4. **The end** is stated, with the counts, when all is acknowledged: then it is in the queue of
   each reader, which takes what there is, compares, finishes, and says so. The sender stays until
   all have. More or less than the count, a sender that broke off, one that joined late, left or
   vanished: a *problem*, which is said, and makes the exit code 3 (:attr:`Flow.problems`).

Who speaks: a state is believed if the graph shows one writer of its topic, always the same, and
writers of the data that belong to that node. Anything else is ignored with a warning; two writers
of one state are waited for, ten seconds, and then both given up.

Without a session (live drivers) nobody waits. Other people's subscribers are named
(:attr:`Flow.foreign`). One that acknowledges nothing cannot stop a session: those who joined
tell twice a second how much they have taken, and that opens the writer as well (so it is slow,
1000 messages a second). The same numbers bound what waits in queues: 64 MB a topic.

Limits. Each hop buffers up to 1000 messages a topic (fastdds.xml; 5000 with other profiles). Nobody
can tell the messages of two publishers of one topic: a second one is named and its messages are
counted as not expected (no fault on /tf, which many share), but reach the estimators. A killed
node is noticed when its lease of five seconds is over (fastdds.xml; twenty with other profiles).
Tried with Fast DDS; other middleware must acknowledge what is in the queue of the reader, and
answer ``wait_for_all_acked`` at once.
"""

from imu_fusion.nodes.flow.flow import Flow
from imu_fusion.nodes.flow.qos import DEPTH, live_qos, reliable_qos, steady_timer
from imu_fusion.nodes.flow.sink import NAP_LIVE, NAP_PATIENT, Turn
from imu_fusion.nodes.flow.state import BEGIN, END, NEXT

__all__ = ["BEGIN", "DEPTH", "END", "NAP_LIVE", "NAP_PATIENT", "NEXT", "Flow", "Turn",
           "live_qos", "reliable_qos", "steady_timer"]
