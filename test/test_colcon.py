"""The package as colcon builds it, and what it installs."""

import ast
import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree
from pathlib import Path

import pytest
import yaml

from imu_fusion.nodes import NODES
from test.test_registry import node_class

REPOSITORY = Path(__file__).resolve().parents[1]
COLCON = Path(sys.executable).parent / "colcon"
# Keys of rosdep/python.yaml that hold on Ubuntu 24.04; ROS packages are keys by themselves.
PYTHON_KEYS = {"python3-click", "python3-numpy", "python3-pymap3d", "python3-rich",
               "python3-scipy", "python3-yaml", "python3-pytest"}
ROS_KEYS = {"rclpy", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "nav_msgs",
            "rosgraph_msgs", "sensor_msgs", "std_msgs", "std_srvs", "launch", "launch_ros",
            "rcl_interfaces", "tf2_msgs"}


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Prefix of the package as `colcon build` installs it."""
    if not COLCON.exists():
        pytest.skip("colcon is not installed (pip install colcon-common-extensions)")
    workspace = tmp_path_factory.mktemp("workspace")
    # A copy: setuptools leaves build files in the source tree.
    shutil.copytree(REPOSITORY, workspace / "src" / "imu_fusion", ignore=shutil.ignore_patterns(
        ".*", "__pycache__", "build", "install", "log", "demo_out", "*.egg-info", "docs"))
    done = subprocess.run([COLCON, "build"], cwd=workspace, capture_output=True, text=True,
                          timeout=300, check=False)
    assert done.returncode == 0 and "1 package finished" in done.stdout, done.stdout + done.stderr
    return workspace / "install" / "imu_fusion"


def run(installed, command):
    """Run a shell command in the environment that the workspace's setup file makes."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return subprocess.run(
        ["bash", "-c", f". '{installed.parent / 'local_setup.bash'}' && {command}"],
        capture_output=True, text=True, timeout=120, check=False, env=environment, cwd=installed)


def test_every_node_starts_from_the_install_directory(installed):
    scripts = installed / "lib" / "imu_fusion"
    assert {p.name for p in scripts.iterdir()} == {"imu_fusion", *NODES}
    done = run(installed, " && ".join(f"'{scripts / node}' --help" for node in NODES))
    assert done.returncode == 0, done.stderr
    assert all(f"usage: {node} " in done.stdout for node in NODES)


def test_the_code_that_runs_is_the_installed_one(installed):
    done = run(installed, f"'{sys.executable}' -c 'import imu_fusion; print(imu_fusion.__file__)'")
    assert done.stdout.startswith(str(installed)), done.stdout + done.stderr


def test_a_node_runs_and_fails_with_its_own_message(installed):
    done = run(installed, "lib/imu_fusion/replayer --ros-args -p bag:=/nowhere")
    assert done.returncode == 1 and done.stderr.startswith("replayer: /nowhere"), done.stderr


def test_ament_finds_the_package_and_its_share(installed):
    marker = installed / "share" / "ament_index" / "resource_index" / "packages" / "imu_fusion"
    assert marker.is_file()
    share = installed / "share" / "imu_fusion"
    for folder in ("launch", "config", "bags"):
        for path in (REPOSITORY / folder).glob("**/*"):
            if path.is_file() and path.suffix in (".yaml", ".mcap") or \
                    path.name.endswith(".launch.py"):
                assert (share / path.relative_to(REPOSITORY)).is_file(), path
    assert (share / "package.xml").is_file()


def test_files_that_the_code_reads_are_installed(installed):
    package = next(installed.glob("lib/python*/site-packages/imu_fusion"))
    source = REPOSITORY / "imu_fusion"
    for path in source.glob("**/*"):
        if path.is_file() and "__pycache__" not in path.parts:
            assert (package / path.relative_to(source)).is_file(), path


def test_package_xml_names_keys_that_exist_and_what_the_nodes_import():
    root = xml.etree.ElementTree.parse(REPOSITORY / "package.xml").getroot()
    keys = {e.text for e in root if e.tag.endswith("depend")}
    assert keys <= PYTHON_KEYS | ROS_KEYS
    imported = set()
    for path in (REPOSITORY / "imu_fusion").glob("**/*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add(node.module.partition(".")[0])
    assert imported & ROS_KEYS <= keys


@pytest.mark.parametrize("path", sorted((REPOSITORY / "launch").glob("*.launch.py")),
                         ids=lambda p: p.name)
def test_launch_files_compile_and_name_our_executables(path):
    """launch is not on PyPI: what can be held here is syntax and names."""
    tree = ast.parse(path.read_text())
    compile(tree, str(path), "exec")
    assert any(isinstance(n, ast.FunctionDef) and n.name == "generate_launch_description"
               for n in tree.body)
    calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call)]
    # Given to Node, or to a local function that makes one of them.
    named = [k.value for n in calls for k in n.keywords if k.arg == "executable"]
    named += [n.args[0] for n in calls if getattr(n.func, "id", "") == "node"]
    executables = {n.value for n in named if isinstance(n, ast.Constant)}
    assert executables and executables <= set(NODES)


@pytest.mark.parametrize("file", ["replay", "pipeline"])
def test_parameters_of_the_launch_file_are_those_of_the_nodes(file):
    path = REPOSITORY / f"config/{file}.yaml"
    for name, content in yaml.safe_load(path.read_text()).items():
        known = {info.name: info for parameters in node_class(name).PARAMETERS
                 for info in parameters.infos()}
        for key, value in content["ros__parameters"].items():
            known[key].check(value)
