"""The lists of nodes, services, stages and demos, and all that must agree with them."""

import importlib
import re
import runpy
import xml.etree.ElementTree
from pathlib import Path

import pytest
import setuptools
from click.testing import CliRunner

import imu_fusion
from imu_fusion.cli import cli
from imu_fusion.demos import DEMOS
from imu_fusion.nodes import NODES
from imu_fusion.nodes.base import Node
from imu_fusion.streams.registry import STAGES

ROOT = Path(__file__).resolve().parents[1]
PAGES = {str(path.relative_to(ROOT)): path.read_text()
         for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")),
                      *sorted((ROOT / "config").rglob("*.yaml")), ROOT / "bags" / "README.md",
                      ROOT / "Makefile"]}
TEXT = "\n".join(PAGES.values())


def node_class(name):
    """The class of a node by the name of its executable."""
    return getattr(importlib.import_module(f"imu_fusion.nodes.{name}"), NODES[name].node)


def help_of(command):
    """What a command prints for --help, words only."""
    result = CliRunner().invoke(cli, [command, "--help"])
    assert result.exit_code == 0
    return " ".join(result.output.split())


@pytest.mark.parametrize("name", NODES)
def test_an_executable_is_a_node_of_that_name_which_says_what_it_does(name):
    cls = node_class(name)
    assert name == cls.NAME and issubclass(cls, Node)
    assert cls.__doc__.splitlines()[0] == NODES[name].summary
    assert f"{name} {NODES[name].summary}" in help_of("run")


def test_every_node_is_an_executable():
    for path in (ROOT / "imu_fusion" / "nodes").glob("*.py"):
        if "\n    NAME = " in path.read_text():
            assert path.stem in NODES


def test_setup_installs_these_executables_and_this_version(monkeypatch):
    given = {}
    monkeypatch.setattr(setuptools, "setup", lambda **values: given.update(values))
    monkeypatch.chdir(ROOT)
    runpy.run_path("setup.py")
    assert given["entry_points"]["console_scripts"] == [
        "imu_fusion = imu_fusion.cli:main",
        *(f"{name} = imu_fusion.nodes:main" for name in NODES)]
    root = xml.etree.ElementTree.parse(ROOT / "package.xml").getroot()
    assert given["version"] == imu_fusion.__version__ == root.findtext("version")


@pytest.mark.parametrize("name", DEMOS)
def test_a_demo_is_a_module_of_its_name(name):
    assert callable(importlib.import_module(f"imu_fusion.demos.{name}").show)
    assert f"{name} {DEMOS[name]}" in help_of("demo")
    assert re.search(rf"imu_fusion demo(?:\s+{name}\b|\b(?!\s+[a-z]))", TEXT)


def test_stages_are_nodes_and_take_what_they_say():
    assert set(STAGES) <= set(NODES)
    for name, stage in STAGES.items():
        assert stage.node == name and stage.outputs
        assert set(stage.required) <= set(stage.inputs)
        parameters = node_class(name).PARAMETERS
        assert set(stage.node_params) <= set(parameters)


@pytest.mark.parametrize("page", PAGES)
def test_pages_name_only_what_there_is(page):
    text = PAGES[page]
    shown = set(re.findall(r"imu_fusion demo ([a-z_]+)", text))
    assert shown <= set(DEMOS)
    started = set(re.findall(r"(?:ros2 run imu_fusion|imu_fusion run) ([a-z_]+)", text))
    # The command line is installed beside the nodes: ros2 run imu_fusion imu_fusion info.
    assert started <= {*NODES, "imu_fusion"}
    # In code, where it begins a command: elsewhere it is the package.
    commands = set(re.findall(r"(?:`|^|bin/)imu_fusion ([a-z][a-z-]*)", text, re.MULTILINE))
    assert commands <= set(cli.commands)
    for node, service in re.findall(r"`(\w+)/(\w+)`", text):
        if node in NODES and f"{node}/{service}" not in STAGE_TOPICS:
            assert service in NODES[node].services


STAGE_TOPICS = {topic for stage in STAGES.values() for topic in (*stage.inputs, *stage.outputs)}


@pytest.mark.parametrize("name", NODES)
def test_services_are_documented(name):
    for service in NODES[name].services:
        assert f"`{name}/{service}`" in TEXT


def test_the_table_of_topics_is_that_of_the_stages():
    """Rows of tables with the columns topic and type, in README or the docs."""
    text = "\n".join(text for page, text in PAGES.items()
                     if page == "README.md" or page.startswith("docs/"))
    tables = re.findall(r"^\| topic \| type [^\n]*\n\|[-| ]+\|\n((?:\|[^\n]*\n)+)", text,
                        re.MULTILINE)
    types = {}
    for row in "".join(tables).splitlines():
        topics, kinds = row.split("|")[1:3]
        for topic in re.findall(r"`([^`]+)`", topics):
            types.setdefault(topic, "")
            types[topic] += kinds
    for stage in STAGES.values():
        for topic, msgtype in [*stage.outputs.items(), *(
                (topic, kind.layout.msgtype) for topic, kind in stage.inputs.items())]:
            assert msgtype.replace("/msg/", "/").rpartition("/")[2] in types.get(topic, ""), topic
    other = {"accelerometers/<name>", "diagnostics", "/diagnostics", "<node>/_flow/<instance>",
             "/recorder/summary", "/tf",
             "/clock", "clock"}
    assert types.keys() <= STAGE_TOPICS | other
