"""The map of the house: which room may import which, arrow by arrow, and what stays outside."""

import ast
import subprocess
import sys
from pathlib import Path, PurePosixPath

import pytest

import imu_fusion

PACKAGE = Path(imu_fusion.__file__).parent

# What a room may import from; another room, and another arrow, needs a line here and a reason.
ARROWS = {
    "errors": (),
    "kernels": (),
    "signals": (),
    "parameters": ("errors",),
    "geometry": ("errors", "kernels"),
    # One search for flat tops, the estimators'.
    "samples": ("errors", "kernels"),
    "sensors": ("errors", "kernels", "parameters", "geometry", "samples"),
    "surfaces": ("errors", "kernels", "parameters", "geometry"),
    # The estimators do not know each other.
    "estimation.orientation": ("errors", "kernels", "parameters", "geometry", "samples", "sensors"),
    "estimation.acceleration_field": ("errors", "kernels", "parameters", "geometry", "samples",
                                      "sensors"),
    "estimation.smoother": ("errors", "kernels", "parameters", "geometry", "samples", "sensors",
                            "surfaces"),
    # The paper's method begins with attitudes.
    "estimation.avalanche": ("errors", "parameters", "samples", "sensors", "surfaces",
                             "estimation.orientation"),
    "evaluation": ("errors", "geometry", "samples"),
    # Rows become numbers of messages in kernels.
    "messages": ("errors", "kernels", "geometry", "samples", "estimation.orientation"),
    "sources": ("errors", "parameters", "samples"),
    "sources.transports": ("errors", "sources"),
    "recordings": ("errors", "parameters", "samples", "messages", "sources", "sources.transports"),
    "streams": ("errors", "kernels", "parameters", "geometry", "samples", "sensors", "surfaces",
                "estimation.orientation", "estimation.acceleration_field", "estimation.smoother",
                "messages"),
    "compile_ahead": ("errors", "kernels", "signals", "geometry", "samples", "surfaces",
                      "estimation.orientation", "estimation.acceleration_field",
                      "estimation.smoother", "messages", "streams"),
    "arrays": ("errors", "geometry", "samples", "estimation.orientation"),
    "simulation": ("errors", "kernels", "parameters", "geometry", "samples", "sensors", "surfaces",
                   "estimation.acceleration_field"),
    "nodes": ("errors", "kernels", "parameters", "samples", "sensors", "surfaces",
              "estimation.orientation", "estimation.acceleration_field", "estimation.smoother",
              "messages", "sources", "sources.transports", "recordings", "streams",
              "compile_ahead", "signals"),
    "batch": ("errors", "kernels", "parameters", "messages", "recordings", "samples", "streams"),
    "report": ("errors", "kernels", "parameters", "geometry", "samples", "surfaces",
               "estimation.orientation", "estimation.acceleration_field", "estimation.smoother",
               "estimation.avalanche", "evaluation", "messages", "recordings", "streams", "batch"),
    "calibrate": ("errors", "geometry", "recordings", "samples", "sensors"),
    "demos": ("errors", "parameters", "evaluation", "messages", "recordings", "streams", "nodes",
              "batch", "report", "calibrate"),
    "cli": ("errors", "kernels", "parameters", "evaluation", "recordings", "streams",
            "compile_ahead", "nodes", "batch", "report", "calibrate", "demos",
            "signals"),
}
# Arrows of one file, with the reason.
ARROWS_OF_FILES = {
    # A table of accelerometers is judged by the estimator that shall read it.
    "recordings/array_parameters.py": ("estimation.acceleration_field", "streams"),
    # People read roll, pitch and yaw.
    "recordings/export.py": ("geometry",),
}

# Below `messages`, and in the formats of devices, numbers are computed: no ROS, no files, no plots,
# no clock, no command line.
PURE = ("errors", "kernels", "parameters", "geometry", "samples", "sensors", "surfaces",
        "estimation.orientation", "estimation.acceleration_field", "estimation.smoother",
        "estimation.avalanche", "evaluation", "sources")
COMPUTING = {"abc", "array", "bisect", "collections", "contextlib", "copy", "dataclasses",
             "datetime", "enum", "functools", "heapq", "itertools", "math", "numbers", "operator",
             "reprlib", "types", "typing", "warnings", "numba", "numpy", "scipy", "pygeomag",
             "pymap3d"}
COMPUTING_OF_FILES = {
    "parameters/bounded_yaml.py": {"pathlib", "yaml"},
    "parameters/file.py": {"pathlib", "yaml"},
    "surfaces/file.py": {"pathlib", "sys"},
    "surfaces/elevation_grid.py": {"pyproj", "rasterio"},    # a terrain is a file
    # Formats take bytes that others have read, and some know a library for what is in them.
    **{f"sources/{name}.py": extra for name, extra in {
        "source": {"re"}, "table_reader": {"csv", "decimal"}, "times": {"decimal", "re"},
        "header": {"re"}, "sketch": {"re"}, "table_layout": {"re"}, "table_time": {"re"},
        "registry": {"pathlib", "re"}, "avanode": {"re"},
        "sensor_logger": {"csv", "json", "pathlib"}, "ximu3": {"pathlib", "struct"},
        "ulog": {"io", "pyulog"},
        "phyphox": {"io", "pathlib", "python_calamine", "re", "zipfile"},
        "phyphox_live": {"json", "urllib"},
        "gnss": {"pynmeagps", "pyubx2", "re"}, "gpx": {"xml"}}.items()},
    "kernels.py": {"hashlib", "os", "pathlib", "pickle", "re", "shutil", "sys", "tempfile", "time"},
}
ROS = {"rclpy", "launch", "launch_ros", "ament_index_python", "rcl_interfaces", "rosgraph_msgs",
       "builtin_interfaces", "sensor_msgs", "geometry_msgs", "nav_msgs", "std_msgs", "std_srvs",
       "diagnostic_msgs"}
# Imports by a name that is made at run time hide an arrow.
HIDDEN = {"importlib", "imp", "pkgutil", "runpy"}
HIDDEN_OF_FILES = {
    "nodes/__init__.py": {"importlib"},  # an executable imports its own node
    "demos/__init__.py": {"importlib"},  # `demo NAME` imports one demo
    "nodes/base.py": {"importlib"},      # message classes by the names of their types
    "report/html.py": {"importlib"},     # importlib.resources
}


def room_of(parts):
    """The room of a module, given by the parts of its name below the package."""
    if parts[0] == "estimation" or parts[:2] == ("sources", "transports"):
        return ".".join(parts[:2])
    return parts[0]


def imports_of(tree):
    """Full dotted names of what a module imports, inside functions, too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{'.' * node.level}{node.module or ''}.{alias.name}"
                        for alias in node.names)


def wrong_imports(path, source):
    """What is wrong with the imports of a file, in words.

    Args:
        path: of the file below the package, such as "samples/guard.py".
        source: its text.
    """
    parts = PurePosixPath(path).with_suffix("").parts
    tree = ast.parse(source)
    if parts == ("__init__",):
        return [f"{path}: the package itself imports {name}" for name in imports_of(tree)]
    if parts == ("estimation", "__init__"):
        return [f"{path}: imports {name}" for name in imports_of(tree)]
    room = room_of(parts)
    if room not in ARROWS:
        return [f"{path}: room '{room}' is unknown"]
    permitted = {room, *ARROWS[room], *ARROWS_OF_FILES.get(path, ())}
    return [f"{path}: imports {name}" for name in imports_of(tree)
            if not _is_permitted(name.split("."), room, path, permitted)] + [
            f"{path}: calls {call}" for call in _hidden_calls(tree, room)]


def _is_permitted(name, room, path, permitted):
    first = name[0]
    if first == "imu_fusion":
        return len(name) == 1 or room_of(tuple(name[1:])) in permitted
    if not first:
        return False    # a relative import
    if first in HIDDEN:
        return first in HIDDEN_OF_FILES.get(path, ())
    if room in PURE:
        return first in COMPUTING | COMPUTING_OF_FILES.get(path, set())
    return first not in ROS or room == "nodes"


def _hidden_calls(tree, room):
    called = {node.func.id for node in ast.walk(tree)
              if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
    return sorted(called & ({"__import__", "exec", "eval"}
                            | ({"open", "print", "input"} if room in PURE else set())))


FILES = {str(file.relative_to(PACKAGE).as_posix()): file for file in sorted(PACKAGE.rglob("*.py"))}


@pytest.mark.parametrize("path", FILES)
def test_a_file_imports_only_what_its_room_may(path):
    assert wrong_imports(path, FILES[path].read_text()) == []


@pytest.mark.parametrize("path, source", [
    ("samples/guard.py", "from imu_fusion.streams.stream import Stream"),
    ("geometry/rotation.py", "import imu_fusion.nodes"),
    ("estimation/orientation/state.py", "from imu_fusion.estimation.smoother import Smoother"),
    ("estimation/smoother/motion.py", "from imu_fusion.estimation import orientation"),
    ("estimation/__init__.py", "from imu_fusion.estimation import smoother"),
    ("messages/convert.py", "from imu_fusion.recordings.bag_reader import open_bag"),
    ("recordings/bag_reader.py", "from imu_fusion.streams.registry import STAGES"),
    ("nodes/pipeline.py", "from imu_fusion.batch import process"),
    ("report/figures.py", "from imu_fusion import cli"),
    ("streams/stage.py", "from ..nodes import base"),
    ("samples/logs.py", "def f():\n    import imu_fusion.nodes"),
    ("samples/logs.py", "def f():\n    from imu_fusion.cli import main"),
    ("attic/old.py", "import math"),
    ("samples/logs.py", "from imu_fusion.attic import old"),
    ("estimation/barometer/state.py", "import math"),
    ("estimation/orientation/state.py", "import rclpy"),
    ("samples/logs.py", "def f():\n    from sensor_msgs.msg import Imu"),
    ("streams/stream.py", "import rclpy"),
    ("batch.py", "import rclpy"),
    ("evaluation/consistency.py", "from matplotlib import pyplot"),
    ("surfaces/plane.py", "from pathlib import Path"),
    ("sources/ximu3.py", "import socket"),
    ("sources/table.py", "from imu_fusion.sources.transports.files import parts"),
    ("sources/transports/files.py", "from imu_fusion.messages.convert import imu_message"),
    ("parameters/declare.py", "import yaml"),
    ("sensors/params.py", "import time"),
    ("samples/logs.py", "import importlib\nimportlib.import_module('imu_fusion.nodes')"),
    ("streams/stream.py", "from importlib import import_module"),
    ("streams/stream.py", "__import__('imu_fusion.nodes')"),
    ("surfaces/plane.py", "def f(path):\n    return open(path).read()"),
    ("__init__.py", "import numpy"),
])
def test_a_planted_import_is_found(path, source):
    assert len(wrong_imports(path, source)) == 1
    if path in FILES:
        planted = f"{FILES[path].read_text()}\n\n{source}\n"
        assert len(wrong_imports(path, planted)) == 1


@pytest.mark.parametrize("path, source", [
    ("nodes/base.py", "import rclpy"), ("parameters/bounded_yaml.py", "import yaml"),
    ("estimation/smoother/motion.py", "from imu_fusion.surfaces.plane import Plane"),
    ("report/html.py", "import imu_fusion"), ("geometry/rotation.py", "import numpy as np"),
])
def test_what_a_room_may_import_is_left_alone(path, source):
    assert wrong_imports(path, source) == []


def test_arrows_go_down():
    """The rooms are named from the bottom up."""
    for number, (room, others) in enumerate(ARROWS.items()):
        assert set(others) <= set(list(ARROWS)[:number]), room


@pytest.mark.parametrize("path", [path for path in FILES if room_of(
    PurePosixPath(path).with_suffix("").parts) in PURE])
def test_pure_rooms_ask_no_clock(path):
    """datetime is welcome for the calendar, not for the present."""
    asked = {node.attr for node in ast.walk(ast.parse(FILES[path].read_text()))
             if isinstance(node, ast.Attribute)} & {"now", "utcnow", "today"}
    assert not asked


def test_the_package_itself_imports_nothing_heavy():
    """setup.py reads the lists of nodes before anything is installed."""
    script = ("import sys, imu_fusion, imu_fusion.nodes, imu_fusion.demos; "
              "print(sorted({'numpy', 'scipy', 'numba', 'rclpy', 'yaml'} & set(sys.modules)))")
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True,
                            check=True).stdout
    assert output.strip() == "[]"


def test_estimators_and_batch_need_no_ros():
    script = ("import sys, imu_fusion.batch, imu_fusion.estimation.orientation.estimator; "
              "print('rclpy' in sys.modules)")
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True,
                            check=True).stdout
    assert output.strip() == "False"
