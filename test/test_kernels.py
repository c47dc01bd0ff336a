"""Compiled code is that of the sources as they are, wherever and however it was compiled."""

import ast
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numba
import pytest

import imu_fusion
from imu_fusion import kernels
from imu_fusion.kernels import NOTICE, announced_compiling

PACKAGE = Path(imu_fusion.__file__).parent

CALLED = """
from imu_fusion.kernels import njit
from imu_fusion.probe.constants import FACTOR

@njit
def called(x):
    return FACTOR * x
"""
CALLER = """
import sys
import numpy as np
from imu_fusion.kernels import announced_compiling, njit
from imu_fusion.probe.layout import STATE
from imu_fusion.probe import (constants,
                              called as other)  # two modules in one statement

@njit
def caller(state):
    total = 0.0
    for i in range(len(state)):
        total += other.called(state[i].b)
    return total

if __name__ == "__main__":
    with announced_compiling(print):
        print(caller(np.array([(3.0, 5.0)], STATE)))
"""
LAYOUT = """
import numpy as np
STATE = np.dtype([("a", "f8"), ("b", "f8")])
"""


@pytest.fixture
def copy(tmp_path):
    """A copy of the package, with kernels in three files and constants in a fourth."""
    root = tmp_path / "imu_fusion"
    (root / "probe").mkdir(parents=True)
    for name in ("__init__.py", "kernels.py", "errors.py"):
        shutil.copy(PACKAGE / name, root)
    for name, text in {"__init__": "", "called": CALLED, "caller": CALLER, "layout": LAYOUT,
                       "constants": "FACTOR = 2.0\n"}.items():
        (root / "probe" / f"{name}.py").write_text(text)
    return root


def environment(root, **changes):
    kept = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    return kept | {"PYTHONPATH": str(root.parent), "HOME": str(root.parent)} | changes


def start(root, **changes):
    return subprocess.Popen([sys.executable, "-m", "imu_fusion.probe.caller"],
                            env=environment(root, **changes), text=True, cwd=root.parent,
                            stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def result(process):
    """(whether anything was compiled, the number printed)."""
    said, _ = process.communicate(timeout=120)
    assert process.returncode == 0, said
    return NOTICE in said, float(said.splitlines()[-1])


def compute(root, **changes):
    return result(start(root, **changes))


def test_the_first_kernel_is_announced_and_later_ones_are_not():
    @numba.njit
    def twice(x):
        return 2 * x

    said = []
    with announced_compiling(said.append):
        assert (twice(1), twice(1.5)) == (2, 3.0)
    assert said == [NOTICE]
    with announced_compiling(said.append):
        twice(2)
    twice(1j)    # compiled outside
    assert said == [NOTICE]


def test_what_is_called_is_compiled_anew_when_it_changes_and_found_again(copy):
    """One change after the other: a file that is called, a constant, the order of a record."""
    assert compute(copy) == (True, 10.0)
    assert compute(copy) == (False, 10.0)
    for file, old, new, expected in [
            ("called", "FACTOR * x", "FACTOR * x + 1.0", 11.0),
            ("constants", "2.0", "3.0", 16.0),
            ("layout", '("a", "f8"), ("b", "f8")', '("b", "f8"), ("a", "f8")', 10.0)]:
        path = copy / "probe" / f"{file}.py"
        before = path.read_text()
        path.write_text(before.replace(old, new))
        assert compute(copy) == (True, expected), file
    assert compute(copy) == (False, 10.0)
    path.write_text(before)
    assert compute(copy) == (False, 16.0)
    # A longer record: the values given do not fit any more.
    path.write_text(before.replace('"f8")]', '"f8"), ("c", "f8", 2)]'))
    caller = copy / "probe" / "caller.py"
    caller.write_text(caller.read_text().replace("(3.0, 5.0)", "(3.0, 5.0, [1.0, 1.0])"))
    assert compute(copy) == (True, 16.0)


def block(path):
    """Something at ``path`` that no folder can be made of, whoever runs the test."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("")


def test_an_install_that_cannot_be_written_uses_the_cache_of_the_user(copy, tmp_path):
    block(copy / "__pycache__" / "kernels")
    home = str(tmp_path / "cache")
    assert compute(copy, XDG_CACHE_HOME=home) == (True, 10.0)
    assert list(Path(home, "imu_fusion", "kernels").rglob("caller-*.nbc"))
    assert compute(copy, XDG_CACHE_HOME=home) == (False, 10.0)


def test_without_any_place_for_a_cache_kernels_run_all_the_same(copy, tmp_path):
    block(copy / "__pycache__" / "kernels")
    block(tmp_path / "cache" / "imu_fusion")
    for _ in range(2):
        assert compute(copy, XDG_CACHE_HOME=str(tmp_path / "cache")) == (True, 10.0)


def test_numba_cache_dir_is_respected(copy, tmp_path):
    assert compute(copy, NUMBA_CACHE_DIR=str(tmp_path / "given")) == (True, 10.0)
    assert list((tmp_path / "given").rglob("caller-*.nbc"))
    assert not list(copy.rglob("*.nbc"))


def test_processes_at_once_leave_whole_files_only(copy):
    found = [result(p) for p in [start(copy) for _ in range(4)]]    # who is late finds it compiled
    assert [value for _, value in found] == [10.0] * 4 and any(compiled for compiled, _ in found)
    files = [f for f in (copy / "__pycache__" / "kernels").rglob("*") if f.is_file()]
    assert files and all(f.suffix == ".nbc" for f in files)
    assert compute(copy) == (False, 10.0)


def test_a_damaged_file_is_compiled_again(copy):
    compute(copy)
    for harm in (lambda data: data[:len(data) // 2], lambda data: b"",
                 lambda data: data[:-8] + bytes(8)):
        for file in copy.rglob("*.nbc"):
            file.write_bytes(harm(file.read_bytes()))
        assert compute(copy) == (True, 10.0)
    assert compute(copy) == (False, 10.0)


def test_a_killed_compilation_does_no_harm(copy):
    process = subprocess.Popen(
        [sys.executable, "-c", "import os, signal, numpy as np\n"
         "from imu_fusion.kernels import announced_compiling\n"
         "from imu_fusion.probe.caller import caller\n"
         "from imu_fusion.probe.layout import STATE\n"
         "with announced_compiling(lambda text: os.kill(os.getpid(), signal.SIGKILL)):\n"
         "    caller(np.zeros(1, STATE))"], env=environment(copy), cwd=copy.parent)
    assert process.wait(60) == -signal.SIGKILL
    assert compute(copy) == (True, 10.0)
    assert compute(copy) == (False, 10.0)


def imports_of(file):
    """Files of the package that a file imports, by its syntax tree."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in names:
            place = PACKAGE.parent.joinpath(*name.split("."))
            found |= {place.with_suffix(".py"), place / "__init__.py"}
    return {f for f in found if f.is_file() and f.is_relative_to(PACKAGE)} - {
        PACKAGE / "kernels.py"}


@pytest.mark.parametrize("file", sorted(PACKAGE.rglob("*.py")), ids=lambda f: str(
    f.relative_to(PACKAGE)))
def test_the_imports_that_the_digest_follows_are_all_there_are(file):
    """kernels.py itself is left out: what it decides is part of the name or does not matter."""
    assert imports_of(file) <= set(kernels._imports(file))


def test_every_kernel_uses_the_one_njit():
    for file in sorted(PACKAGE.rglob("*.py")):
        if file != PACKAGE / "kernels.py":
            assert "from numba" not in file.read_text(), file
