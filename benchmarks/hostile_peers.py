"""Publishers that do what no sensor should: for benchmarks.faults.

    python -m benchmarks.hostile_peers KIND

Each runs for a few seconds beside the nodes, on their topics and under names of their own.
"""

import sys
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from sensor_msgs.msg import Imu, MagneticField
from std_msgs.msg import String

from imu_fusion.messages.convert import imu_message, mag_message
from imu_fusion.nodes.flow import reliable_qos
from imu_fusion.nodes.flow.state import MARK, STATE_QOS

SECONDS = 3.0
WILD = (float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 5e-324)
SECOND = 1_000_000_000
LAST = (2**31 - 1) * SECOND  # of a builtin_interfaces/Time
STAMPS = (0, 1, -1, -SECOND, LAST, LAST - SECOND, 1_700_000_000 * SECOND, 1_600_000_000 * SECOND)


def values(node):
    """Numbers that are none, or nearly."""
    imu, mag = publishers(node)
    for i in repeated(0.01):
        wild, stamp = WILD[i % len(WILD)], time.time_ns()
        imu.publish(imu_message(stamp, "imu_link", (wild, 0.0, wild), (0.0, wild, 9.81)))
        mag.publish(mag_message(stamp, "imu_link", (wild, 2e-5, -4e-5)))


def stamps(node):
    """Times of zero, before 1970, in 2038, and backwards."""
    imu, mag = publishers(node)
    for i in repeated(0.01):
        stamp = STAMPS[i % len(STAMPS)] if i % 3 else time.time_ns() - i * SECOND
        imu.publish(imu_message(stamp, "imu_link", (0.0, 0.0, 0.1), (0.0, 0.0, 9.81)))
        mag.publish(mag_message(stamp, "imu_link", (0.0, 2e-5, -4e-5)))


def bytes_(node):
    """Messages cut short, too long, with wild lengths, in frames with names of all kinds."""
    imu, _ = publishers(node)
    good = imu_message(time.time_ns(), "imu_link", (0.0, 0.0, 0.1), (0.0, 0.0, 9.81))
    frames = ("", "x" * 10_000, "\x00\x1b[31m", "ü/π")
    for i in repeated(0.01):
        kinds = (good[:i % len(good)], good + bytes(i % 50), good[:12] + b"\xff" * 8 + good[20:],
                 imu_message(time.time_ns(), frames[i % len(frames)], (0, 0, 0), (0, 0, 9.81)))
        imu.publish(kinds[i % len(kinds)])


def flood(node):
    """As many messages a second as this process can send."""
    imu, _ = publishers(node)
    end, stamp = time.monotonic() + SECONDS, time.time_ns()
    while time.monotonic() < end:
        for _ in range(1000):
            stamp += 10_000
            imu.publish(imu_message(stamp, "imu_link", (0.0, 0.0, 0.1), (0.0, 0.0, 9.81)))


def wrong_type(node):
    """Another type on the topics of the sensors."""
    outs = [node.create_publisher(String, topic, 10) for topic in ("/imu/data_raw", "/imu/mag")]
    for _ in repeated(0.05):
        for out in outs:
            out.publish(String(data="no sample"))


def forged(node):
    """Flow states of nodes that are there, and of some that are not; well-formed and not."""
    outs = {}
    for i in repeated(0.05):
        topics = [name for name, _ in node.get_topic_names_and_types() if MARK in name]
        for topic in [*topics[:20], f"/nobody{MARK}i{i % 3}", f"/recorder{MARK}ghost"]:
            if topic not in outs:
                outs[topic] = node.create_publisher(DiagnosticArray, topic, STATE_QOS)
            event = ("begin", "end", "next", "", "\x00")[i % 5]
            said = {"listens": "1", "lost": "0", "company": " ".join(topics), "version": "9",
                    "topic /imu/data_raw": f"sensor_msgs/msg/Imu {'0' * 48} 0 {10**i % 10**30}"}
            if i % 4 == 3:
                said = {"listens": "?", "lost": "-1", "company": "a" * 100_000}
            outs[topic].publish(DiagnosticArray(status=[DiagnosticStatus(
                name="sends", message=event, hardware_id=f"session{i % 2}",
                values=[KeyValue(key=key, value=value) for key, value in said.items()])]))


KINDS = {"values": values, "stamps": stamps, "bytes": bytes_, "flood": flood,
         "wrong_type": wrong_type, "forged": forged}


def publishers(node):
    """Of Imu and MagneticField, on the topics of the sensors."""
    return (node.create_publisher(Imu, "/imu/data_raw", reliable_qos()),
            node.create_publisher(MagneticField, "/imu/mag", reliable_qos()))


def repeated(interval):
    """Numbers from 0 on, one each ``interval`` seconds, for SECONDS."""
    end, i = time.monotonic() + SECONDS, 0
    while time.monotonic() < end:
        yield i
        i += 1
        time.sleep(interval)


def main(kind):
    """Be one of KINDS."""
    rclpy.init()
    node = rclpy.create_node(f"hostile_{kind}")
    time.sleep(1.0)  # to be discovered
    KINDS[kind](node)
    rclpy.try_shutdown()


if __name__ == "__main__":
    main(sys.argv[1])
