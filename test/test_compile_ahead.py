"""Kernels compiled ahead: all of them, interruptibly, once."""

import os
import re
import shutil
import signal
import subprocess
import sys
import threading

import pytest

from imu_fusion import compile_ahead, kernels
from imu_fusion.errors import ImuFusionError
from imu_fusion.kernels import NOTICE
from test.test_bags import ROOT

ALL_DOORS = """
import sys, tempfile
from pathlib import Path
from numba.core import event
from imu_fusion import kernels
from imu_fusion.batch import process

class Kernels(event.Listener):
    names = []
    def on_start(self, event):
        function = event.data["dispatcher"].py_func
        if function.__module__.startswith("imu_fusion."):
            self.names.append(function.__qualname__)
    def on_end(self, event):
        pass

root = Path(sys.argv[1])
with event.install_listener("numba:compile", Kernels()):
    for bag, file in (("broad_06_fast_rotation", None), ("jump_simulated", "jump_simulated.yaml"),
                      ("mimu4444", "mimu4444.yaml"), ("drive_0708", "drive_0708.yaml")):
        with tempfile.TemporaryDirectory() as folder:
            process(root / "bags" / bag, Path(folder, "out"), file and root / "config" / file)
print("compiled:", sorted(set(Kernels.names)))
"""


def run_command(*arguments, **environment):
    return subprocess.Popen([sys.executable, *arguments], text=True, stdout=subprocess.PIPE,
                            stderr=subprocess.STDOUT, env=os.environ | environment)


@pytest.mark.slow
def test_nothing_is_left_to_compile_for_process(tmp_path):
    """With what ``imu_fusion compile`` made, without what others have compiled since."""
    said, _ = run_command("-m", "imu_fusion.cli", "compile").communicate(timeout=900)
    assert said in ("", f"{NOTICE}\n")
    mark = kernels.cache_file(f"complete-{compile_ahead._state()}")
    made = mark.stat().st_mtime_ns
    for file in mark.parent.rglob("*"):
        if file.is_file() and file.stat().st_mtime_ns <= made:
            copy = tmp_path / "imu_fusion" / file.relative_to(mark.parent)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file, copy)
    cache = {"NUMBA_CACHE_DIR": str(tmp_path)}
    said, _ = run_command("-m", "imu_fusion.cli", "compile", **cache).communicate(timeout=60)
    assert said == ""
    said, _ = run_command("-c", ALL_DOORS, str(ROOT), **cache).communicate(timeout=600)
    assert said.splitlines()[-1] == "compiled: []", said


def test_a_failure_is_told_and_nothing_counts_as_complete(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compile_ahead, "_JOBS", {"nonsense": None})
    for _ in range(2):
        said = []
        with pytest.raises(ImuFusionError, match="kernels of nonsense do not compile.*KeyError"):
            compile_ahead.compile_ahead(said.append)
        assert said == [NOTICE]


def children_of(pid):
    listed = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True,
                            text=True, check=False).stdout
    return [int(child) for child in listed.split()]


def is_alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_signal_ends_all_compilers(tmp_path):
    process = run_command("-m", "imu_fusion.cli", "compile", NUMBA_CACHE_DIR=str(tmp_path))
    assert process.stdout.readline() == f"{NOTICE}\n"
    children = []
    while len(children) < len(compile_ahead._JOBS) and process.poll() is None:
        children = children_of(process.pid)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGINT
    assert not any(is_alive(child) for child in children)
    assert not list(tmp_path.rglob("complete-*"))


def test_a_node_that_compiles_listens_to_signals(tmp_path):
    """Told to end at its first kernel, it ends without compiling the last, the filter's step."""
    process = run_command("-m", "imu_fusion.cli", "run", "orientation_estimator",
                          NUMBA_CACHE_DIR=str(tmp_path), PYTHONUNBUFFERED="1")
    guard = threading.Timer(300.0, process.kill)
    guard.start()
    try:
        said = ""
        while NOTICE not in said:
            line = process.stdout.readline()
            assert line, said
            said += line
        process.send_signal(signal.SIGHUP)
        rest, _ = process.communicate()
    finally:
        guard.cancel()
    assert process.returncode == 128 + signal.SIGHUP and "Traceback" not in rest, rest
    names = {re.sub(r"-.*", "", file.name) for file in tmp_path.rglob("*.nbc")}
    assert "step_imu" not in names, names
