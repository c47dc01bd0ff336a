"""A node of plain rclpy that takes and publishes what one of ours does, and does nothing else.

    python -m benchmarks.bare_node TAKEN PUBLISHED

Both are JSON, topic to type. Its callbacks get bytes, and with each message of the last topic taken
it publishes one on each of the others, made beforehand but for the stamp: what rclpy and the
middleware cost alone.
"""

import json
import sys
from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.serialization import serialize_message

from imu_fusion.nodes.base import message_class, use_fast_heartbeats
from imu_fusion.nodes.flow import reliable_qos


def main(taken, published):
    """Run until SIGINT."""
    use_fast_heartbeats()
    rclpy.init()
    node = rclpy.create_node("bare")
    outs = [(node.create_publisher(message_class(kind), topic, reliable_qos()),
             serialize_message(message_class(kind)()))
            for topic, kind in json.loads(published).items()]
    taken = json.loads(taken)

    def answer(cdr):
        for publisher, message in outs:
            publisher.publish(message[:4] + cdr[4:12] + message[12:])

    for topic, kind in taken.items():
        node.create_subscription(
            message_class(kind), topic, answer if topic == list(taken)[-1] else lambda cdr: None,
            reliable_qos(), raw=True)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main(*sys.argv[1:])
