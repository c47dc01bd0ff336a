"""A graph in this process: nodes on one executor, spun until something has happened."""

import time

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import Imu

from imu_fusion.messages.convert import imu_message, mag_message
from imu_fusion.nodes.base import use_fast_heartbeats
from imu_fusion.nodes.flow import Flow
from imu_fusion.recordings.bag_writer import BagWriter

START = 1_700_000_000_000_000_000
STEP = 10_000_000  # ns


class Graph:
    """Nodes of a test; every wait is for an event and bounded."""

    def __init__(self):
        self.executor = SingleThreadedExecutor()
        self.nodes = []

    def add(self, node):
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def node(self, name):
        return self.add(rclpy.create_node(name))

    def start(self, cls, **parameters):
        """One of our nodes with ROS parameters, as from the command line."""
        return self.add(cls(parameter_overrides=[
            Parameter(name, value=value)
            for name, value in parameters.items()]))

    def close(self, node):
        node.close()
        self.remove(node)

    def remove(self, node):
        self.executor.remove_node(node)
        self.nodes.remove(node)
        node.destroy_node()

    def until(self, condition, timeout=180.0):  # the first run compiles kernels
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline, "the event did not happen"
            pause = min([0.05, *(n.work() for n in self.nodes
                                 if hasattr(n, "work") and not n.finished)])
            self.executor.spin_once(timeout_sec=pause)

    def call(self, node, service_type, name, timeout=30.0):
        client = node.create_client(service_type, name)
        self.until(client.service_is_ready)
        future = client.call_async(service_type.Request())
        self.until(future.done, timeout)
        node.destroy_client(client)
        return future.result()


@pytest.fixture
def graph():
    use_fast_heartbeats()
    rclpy.init()
    graph = Graph()
    yield graph
    for node in graph.nodes:
        if hasattr(node, "close"):
            node.close()
        node.destroy_node()
    graph.executor.shutdown()
    rclpy.try_shutdown()


class Collector:
    """Takes sessions: the messages of each topic in order, what came with them, how they ended."""

    def __init__(self, node, topics, **options):
        self.messages = {topic: [] for topic in topics}
        self.infos = {topic: [] for topic in topics}
        self.ended = []
        self.takes = True
        self.flow = Flow(node, **options)
        self.flow.sink.gate.can_execute = lambda entity: self.takes
        for topic, msg_type in topics.items():
            self.flow.input(msg_type, topic)
        node.work, node.finished = self.work, False

    def work(self):
        """One turn."""
        if self.takes:
            turn = self.flow.take()
            for topic, block in turn.blocks.items():
                self.messages[topic] += [cdr for cdr, _ in block]
                self.infos[topic] += [info for _, info in block]
            self.ended += [session.event for session in turn.over]
            self.flow.finish(turn)
        return self.flow.pause(0.05)


def collector(graph, name="collector", topics=None, **options):
    return Collector(graph.node(name), topics or {"/imu/data_raw": Imu}, **options)


@pytest.fixture
def bag(tmp_path):
    """200 Imu messages at 100 Hz and 50 MagneticField at 25 Hz; acc.x numbers them."""
    return write_bag(tmp_path / "recording", 200)


def write_bag(path, count):
    with BagWriter(path) as writer:
        for i in range(count):
            stamp = START + i * STEP
            writer.write("/imu/data_raw", "sensor_msgs/msg/Imu",
                         imu_message(stamp, "imu_link", (0, 0, 0), (i, 0, 9.81)), stamp)
            if i % 4 == 0:
                writer.write("/imu/mag", "sensor_msgs/msg/MagneticField",
                             mag_message(stamp, "imu_link", (i * 1e-9, 0, 0)), stamp)
    return path
