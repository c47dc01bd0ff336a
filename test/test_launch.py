"""What the launch files do, in which order, with stand-ins for `launch`, which is not on PyPI."""

import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from imu_fusion.errors import BagError, ImuFusionError, ParameterError, TopicError
from imu_fusion.nodes import NODES
from test.nodes.conftest import write_bag
from test.nodes.test_smoother import write

LAUNCH = Path(__file__).resolve().parents[1] / "launch"
CONFIG = Path(__file__).resolve().parents[1] / "config"


class Entity:
    """Stands for any class of launch: it keeps what it was made with."""

    def __init__(self, *args, **options):
        self.args = args
        vars(self).update(options)

    def perform(self, context):
        """The value of a LaunchConfiguration."""
        return context.given[self.args[0]]


STAND_INS = {
    "launch": ("LaunchContext", "LaunchDescription", "LaunchDescriptionEntity"),
    "launch.actions": ("DeclareLaunchArgument", "EmitEvent", "ExecuteProcess", "OpaqueFunction",
                       "RegisterEventHandler"),
    "launch.event_handlers": ("OnProcessExit",), "launch.events": ("Shutdown",),
    "launch.events.process": ("ProcessExited",),
    "launch.substitutions": ("LaunchConfiguration", "PathJoinSubstitution"),
    "launch_ros": (), "launch_ros.actions": ("Node",),
    "launch_ros.substitutions": ("FindPackageShare",)}


class Launched:
    """A launch file for which arguments were given, as far as it has come."""

    def __init__(self, file, **given):
        description = runpy.run_path(str(LAUNCH / file))["generate_launch_description"]()
        entities = description.args[0]
        defaults = {e.args[0]: vars(e).get("default_value") for e in entities[:-1]}
        params_file = CONFIG / file.replace(".launch.py", ".yaml")
        self.context = SimpleNamespace(is_shutdown=False, given={
            **defaults, "params_file": str(params_file), **given})
        assert set(given) <= set(defaults)
        self.started, self.handlers, self.ended = [], [], ""
        self.add(entities[-1].function(self.context))

    def add(self, entities):
        for entity in entities or ():
            if hasattr(entity, "event"):
                self.ended = entity.event.reason
            elif hasattr(entity, "cmd") or hasattr(entity, "executable"):
                self.started.append(entity)
            else:
                self.handlers.append(entity.args[0])

    def exit(self, process, code):
        """A process has ended; what launch does then."""
        event = SimpleNamespace(returncode=code, process_name=self.name(process))
        for handler in [h for h in self.handlers if h.target_action is process]:
            self.add(handler.on_exit(event, self.context))

    @staticmethod
    def name(process):
        return vars(process).get("executable") or process.cmd[3]

    def names(self):
        return [self.name(process) for process in self.started]

    def __getitem__(self, name):
        process, = (p for p in self.started if self.name(p) == name)
        return process


@pytest.fixture
def launched(monkeypatch):
    for name, classes in STAND_INS.items():
        module = ModuleType(name)
        vars(module).update({cls: type(cls, (Entity,), {}) for cls in classes})
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "imu_fusion.nodes.launching", raising=False)
    yield Launched
    sys.modules.pop("imu_fusion.nodes.launching", None)


@pytest.fixture
def recording(tmp_path):
    return str(write(tmp_path / "bag", 20))


FILES = ["replay.launch.py", "pipeline.launch.py"]


@pytest.mark.parametrize("file", FILES)
def test_nodes_start_when_the_kernels_are_compiled(launched, recording, file):
    launch = launched(file, bag=recording)
    assert launch.names() == ["compile"]
    launch.exit(launch["compile"], 0)
    assert {"recorder", "replayer", "orientation_estimator"} <= set(launch.names())
    assert set(launch.names()) <= {"compile", *NODES}
    assert all(p.package == "imu_fusion" and p.name == p.executable for p in launch.started[1:])
    assert launch["recorder"].parameters[1]["whole"]    # a run that fails leaves nothing


@pytest.mark.parametrize("file", FILES)
def test_a_failure_to_compile_ends_the_launch(launched, recording, file):
    launch = launched(file, bag=recording)
    with pytest.raises(ImuFusionError, match="compile ended with code 1"):
        launch.exit(launch["compile"], 1)
    assert launch.names() == ["compile"]


@pytest.mark.parametrize("file", FILES)
def test_the_failure_of_any_node_ends_the_launch_but_not_that_of_one_that_was_asked_to_end(
        launched, recording, file):
    launch = launched(file, bag=recording)
    launch.exit(launch["compile"], 0)
    for name in launch.names()[1:]:
        with pytest.raises(ImuFusionError, match=f"{name} ended with code 1"):
            launch.exit(launch[name], 1)
    assert not launch.ended
    launch.context.is_shutdown = True
    for name in launch.names()[1:]:
        launch.exit(launch[name], -2)


@pytest.mark.parametrize("file", FILES)
def test_the_launch_ends_with_the_recorder(launched, recording, file):
    launch = launched(file, bag=recording)
    launch.exit(launch["compile"], 0)
    for name in set(launch.names()) - {"compile", "recorder"}:
        launch.exit(launch[name], 0)
    assert not launch.ended
    launch.exit(launch["recorder"], 0)
    assert launch.ended == "recording ended"


def test_the_report_comes_after_the_recording(launched, recording):
    launch = launched("pipeline.launch.py", bag=recording, report="True")
    launch.exit(launch["compile"], 0)
    launch.exit(launch["recorder"], 0)
    assert launch.names()[-1] == "report" and not launch.ended
    launch.exit(launch["report"], 0)
    assert launch.ended == "report written"


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("given, error, words", [
    ({"rate": "fast"}, ParameterError, "'rate': 'fast' is not a number"),
    ({"rate": "-1"}, ParameterError, "'rate'.*out of bounds"),
    ({"bag": "/nowhere/bag"}, BagError, "/nowhere/bag: no such file"),
    ({"params_file": "/nowhere.yaml"}, ParameterError, "/nowhere.yaml: cannot be read"),
    ({"out": str(LAUNCH)}, BagError, "exists and is not empty"),
    ({"out": "/proc/nowhere"}, BagError, "/proc/nowhere: cannot be written"),
])
def test_bad_arguments_are_refused_before_anything_starts(launched, recording, file, given, error,
                                                          words):
    with pytest.raises(error, match=words):
        launched(file, **{"bag": recording, **given})


def test_the_pipeline_refuses_what_it_cannot_do_before_anything_starts(launched, recording,
                                                                       tmp_path):
    with pytest.raises(ParameterError, match="'report': 'perhaps' is neither"):
        launched("pipeline.launch.py", bag=recording, report="perhaps")
    with pytest.raises(TopicError, match="nothing to smooth: no messages on 'fix'"):
        launched("pipeline.launch.py", bag=str(write_bag(tmp_path / "bare", 20)))


def test_the_replayer_waits_for_all_nodes_and_has_no_empty_lists(launched, recording):
    launch = launched("pipeline.launch.py", bag=recording, rate="2.0")
    launch.exit(launch["compile"], 0)
    _, given = launch["replayer"].parameters
    assert given["rate"] == 2.0
    assert set(given["wait_for_nodes"]) == set(launch.names()) - {"compile", "replayer"}
    assert all(value != [] for value in given.values())
