"""Nodes as they run have the services and topics that the lists say."""

import pytest

from imu_fusion.nodes import NODES
from imu_fusion.streams.registry import STAGES
from test.test_registry import node_class

GIVEN = {
    "replayer": lambda bag, out: {"bag": str(bag), "wait_for_subscribers": 1},
    "recorder": lambda bag, out: {"out": str(out)},
    "driver": lambda bag, out: {"transport": "udp://127.0.0.1:0", "source": "ximu3"},
    "acceleration_field_estimator": lambda bag, out: {
        "sample_rate": 100.0, "accelerometers.names": ["a", "b", "c", "d"],
        **{f"accelerometers.{name}.position": place for name, place in (
            ("a", [0.1, 0.0, 0.0]), ("b", [0.0, 0.1, 0.0]), ("c", [0.0, 0.0, 0.1]),
            ("d", [-0.1, -0.1, 0.0]))}}}


@pytest.mark.parametrize("name", NODES)
def test_services_and_topics_of_a_running_node(graph, bag, tmp_path, name):
    given = GIVEN.get(name, lambda bag, out: {})(bag, tmp_path / "out")
    node = graph.start(node_class(name), **given)
    services = {service for service, (kind,) in node.get_service_names_and_types_by_node(
        name, "/") if kind == "std_srvs/srv/Trigger"}
    assert services == {f"/{name}/{service}" for service in NODES[name].services}
    if name in STAGES:
        stage = STAGES[name]
        published = dict(node.get_publisher_names_and_types_by_node(name, "/"))
        assert {f"/{topic}": [kind] for topic, kind in stage.outputs.items()}.items() \
            <= published.items()
        subscribed = dict(node.get_subscriber_names_and_types_by_node(name, "/"))
        taken = {f"/{topic}": [kind.layout.msgtype] for topic, kind in stage.inputs.items()}
        assert taken.items() <= subscribed.items()
