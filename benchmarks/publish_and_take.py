"""What passing bytes through three processes costs without any work: the bound of the nodes.

    python -m benchmarks.publish_and_take ROLE COUNT

``first`` publishes ``COUNT`` messages on each of two topics, ``middle`` takes both and publishes
one for each of the first topic, ``last`` takes all three and prints how many a second they were.
Windows and QoS are those of the nodes.
"""

import sys
import time

import rclpy
from rclpy.duration import Duration
from sensor_msgs.msg import Imu, MagneticField

from imu_fusion.messages.convert import imu_message, mag_message
from imu_fusion.nodes.base import LEAVING, use_fast_heartbeats
from imu_fusion.nodes.ending import ends_within
from imu_fusion.nodes.flow.qos import reliable_qos, session_qos
from imu_fusion.nodes.flow.source import WINDOW

TOPICS = {"/imu/data_raw": Imu, "/imu/mag": MagneticField, "/imu/data": Imu}
NAP = 0.002  # s
MADE = {Imu: imu_message(0, "imu_link", (0, 0, 0), (0, 0, 9.8)),
        MagneticField: mag_message(0, "imu_link", (0, 0, 0))}


def publish(publisher, sent):
    """One more after so many, as fast as they are acknowledged."""
    publisher.publish(MADE[publisher.msg_type])
    if sent % WINDOW == WINDOW - 1:
        while not publisher.wait_for_all_acked(Duration(nanoseconds=0)):
            time.sleep(NAP)


def main(role, count):
    """One of the three processes."""
    use_fast_heartbeats()
    rclpy.init()
    node = rclpy.create_node(role)
    topics = list(TOPICS)
    outs = [node.create_publisher(TOPICS[t], t, reliable_qos())
            for t in {"first": topics[:2], "middle": topics[2:], "last": []}[role]]
    ins = [node.create_subscription(TOPICS[t], t, lambda cdr: None, session_qos(), raw=True)
           for t in {"first": [], "middle": topics[:2], "last": topics}[role]]
    readers = {"/imu/data_raw": 2, "/imu/mag": 2, "/imu/data": 1}
    while any(p.get_subscription_count() < readers[p.topic] for p in outs):
        time.sleep(NAP)
    if role == "first":
        # The last one sees the middle one a little later than we do.
        time.sleep(2.0)
        for i in range(count):
            for publisher in outs:
                publish(publisher, i)
    left = {id(s): count for s in ins}
    began = 0.0
    while any(left.values()):
        taken = 0
        for s in ins:
            with s.handle:
                while s.handle.take_message(s.msg_type, True) is not None:
                    taken += 1
                    if outs and s is ins[0]:
                        publish(outs[0], count - left[id(s)])
                    left[id(s)] -= 1
        if not taken:
            time.sleep(NAP)
        began = began or (time.monotonic() if taken else 0.0)
    if role == "last":
        print(len(ins) * count / (time.monotonic() - began))
    for p in outs:
        p.wait_for_all_acked(Duration(seconds=60))
    with ends_within(LEAVING, 0):
        node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
