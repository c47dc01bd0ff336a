"""The map of the house: imports go one way, and pure rooms stay pure."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import imu_fusion

PACKAGE = Path(imu_fusion.__file__).parent
PURE = ("samples", "geometry", "sensors", "surfaces", "estimation")
# What no pure room may import: ROS, files and the system, plots, clocks, the command line.
FORBIDDEN = {"rclpy", "rosbags", "mcap", "plotly", "matplotlib", "yaml", "pathlib", "os", "io",
             "time", "subprocess", "socket", "click", "rich", "logging",
             "sensor_msgs", "geometry_msgs", "nav_msgs", "std_msgs", "std_srvs",
             "diagnostic_msgs"}
# Rooms from the bottom up; a room imports only from rooms of a lower number.
FLOOR = {"errors": 0, "parameters": 0, "compiling": 0,
         "geometry": 1, "samples": 1, "sensors": 2, "surfaces": 2,
         "estimation": 3, "simulation": 3, "messages": 4, "parameter_file": 4,
         "surface_file": 4, "drivers": 5,
         "nodes": 5, "report": 5, "batch": 5, "graph": 5, "pipeline": 6,
         "demos": 7, "demos_trajectory": 6, "demos_impact": 6, "cli": 7}


def imports_of(file):
    """Full dotted names of what a file imports."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def room_of(file):
    """The part of the package that a file belongs to."""
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


FILES = sorted(f for f in PACKAGE.rglob("*.py") if f.name != "__init__.py" or f.parent != PACKAGE)


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(PACKAGE)))
def test_imports_go_one_way(file):
    room = room_of(file)
    for name in imports_of(file):
        parts = name.split(".")
        if room in PURE:
            assert parts[0] not in FORBIDDEN, f"{file.name} imports {name}"
        if parts[0] == "imu_fusion" and len(parts) > 1 and parts[1] in FLOOR:
            assert parts[1] == room or FLOOR[parts[1]] <= FLOOR[room], \
                f"{file.name} ({room}) imports {name}"


@pytest.mark.parametrize("room", PURE)
def test_pure_rooms_ask_no_clock(room):
    """datetime is welcome for the calendar, not for the present."""
    for file in (PACKAGE / room).rglob("*.py"):
        asked = {node.attr for node in ast.walk(ast.parse(file.read_text()))
                 if isinstance(node, ast.Attribute)} & {"now", "utcnow", "today"}
        assert not asked, f"{file}: {asked}"


def test_the_package_itself_imports_nothing_heavy():
    script = ("import sys, imu_fusion; "
              "print(sorted({'numpy', 'scipy', 'numba', 'rclpy'} & set(sys.modules)))")
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True,
                            check=True).stdout
    assert output.strip() == "[]"


def test_estimators_and_batch_need_no_ros():
    script = ("import sys, imu_fusion.batch, imu_fusion.estimation.orientation.estimator; "
              "print('rclpy' in sys.modules)")
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True,
                            check=True).stdout
    assert output.strip() == "False"
