"""Our nodes as processes of an own ROS domain: for demo, pipeline and benchmarks."""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml

from imu_fusion.compile_ahead import compile_ahead
from imu_fusion.errors import INCOMPLETE, ImuFusionError
from imu_fusion.kernels import NOTICE
from imu_fusion.parameters.file import ParamsFile, files_of
from imu_fusion.signals import LEASH, Interrupted, came, held

_CLAIM = 9    # of the ports of a domain, the one that says that nodes will come
_PATIENCE = 15.0  # s, in which nodes end their sessions and files


class NodeError(ImuFusionError):
    """A node did not start, did not end or ended with an error."""


def claim_domain() -> tuple[int, socket.socket]:
    """A ROS domain id (1 to 101) that nobody on this machine uses, and the socket whose being open
    claims it: nodes need a second until they are seen.

    DDS participants of a domain bind the UDP ports from 7400 + 250 * id on, but for 2 to 9 of them.
    """
    first = os.getpid() % 101
    for i in range(101):
        domain = 1 + (first + i) % 101
        ports = [7400 + 250 * domain + offset for offset in (_CLAIM, 0, 10, 11, 12)]
        bound = [found for port in ports if (found := _bound(port)) is not None]
        is_free = len(bound) == len(ports)
        for probe in bound[1:] if is_free else bound:
            probe.close()
        if is_free:
            return domain, bound[0]
    raise NodeError("all ROS domain ids from 1 to 101 are in use on this machine")


def _bound(port):
    """A socket bound to an UDP port, None if it is in use."""
    probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        probe.bind(("", port))
    except OSError:
        probe.close()
        return None
    return probe


class NodeProcesses:
    """Processes of our nodes; leaving the context ends those that still run, and so does the end of
    this process, whatever ends it.

    Entering it compiles the kernels where that has not been done: nodes that compile would keep
    the others waiting, each for itself.

    Args:
        logs: directory for what the nodes print, one file per node; a temporary
            one if None, which stays where something fails.
        domain: ROS domain id, a free one if None.
    """

    def __init__(self, logs: str | Path | None = None, domain: int | None = None):
        self._claim: socket.socket | None = None
        if domain is None:
            domain, self._claim = claim_domain()
        self.domain = domain
        self._is_temporary = logs is None
        self._logs = Path(logs or tempfile.mkdtemp(prefix="imu_fusion_"))
        self._logs.mkdir(parents=True, exist_ok=True)
        self._processes: dict[str, subprocess.Popen] = {}
        self._announced = False

    def __enter__(self) -> "NodeProcesses":
        compile_ahead(_say)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_):
        try:
            for process in self._processes.values():
                if process.poll() is None:
                    # An interpreter that has just begun ends by it silently, by SIGINT not.
                    process.send_signal(signal.SIGTERM)
            deadline = time.monotonic() + _PATIENCE
            for process in self._processes.values():
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(max(0.1, deadline - time.monotonic()))
        finally:    # a second signal does not wait
            for process in self._processes.values():
                process.kill()
                process.wait()
                if process.stdin is not None:
                    process.stdin.close()
            if self._claim is not None:
                self._claim.close()
            if self._is_temporary and (kind is None or issubclass(kind, Interrupted)):
                shutil.rmtree(self._logs, ignore_errors=True)

    def start(self, node: str, show: bool = False, params_file: ParamsFile = None,
              **parameters: object) -> None:
        """Start a node.

        Args:
            node: module name in imu_fusion.nodes.
            show: let it print here instead of into its log.
            params_file: ParamsFile.
            parameters: its parameters; empty tuples, which rclpy cannot read, are left out.
        """
        command = [sys.executable, "-m", "imu_fusion.cli", "run", node, "--ros-args"]
        for file in files_of(params_file):
            command += ["--params-file", str(file)]
        if parameters:
            own = self._logs / f"{node}.yaml"
            own.write_text(yaml.safe_dump({node: {"ros__parameters": {
                k: list(v) if isinstance(v, tuple) else v
                for k, v in parameters.items() if v != ()}}}))
            command += ["--params-file", str(own)]
        environment = dict(os.environ, ROS_DOMAIN_ID=str(self.domain), PYTHONUNBUFFERED="1",
                           ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST", **LEASH)
        with open(self._logs / f"{node}.log", "w") as log, held():
            self._processes[node] = subprocess.Popen(
                command, env=environment, stdin=subprocess.PIPE,
                stdout=None if show else log, stderr=None if show else subprocess.STDOUT,
                start_new_session=True)

    def wait(self, node: str, timeout: float) -> None:
        """Wait until a node has ended by itself, whether or not something was lost; seconds.

        Raises:
            NodeError: this or another node failed, or it took too long; with its last words.
        """
        deadline = time.monotonic() + timeout
        while self._processes[node].poll() is None:
            self._announce_compiling()
            if came:
                raise Interrupted(came[0])
            for name, process in self._processes.items():
                if process.poll() not in (None, 0, INCOMPLETE):
                    raise NodeError(f"node {name} ended with code {process.returncode}: "
                                     f"{self._last_words(name)}")
            if time.monotonic() > deadline:
                raise NodeError(f"node {node} has not ended after {timeout:g} s: "
                                 f"{self._last_words(node)}")
            time.sleep(0.05)
        if self._processes[node].returncode not in (0, INCOMPLETE):
            raise NodeError(f"node {node} ended with code {self._processes[node].returncode}: "
                             f"{self._last_words(node)}")

    def _announce_compiling(self):
        """Say once what a node says into its log only."""
        if not self._announced and any(NOTICE in self.log(node) for node in self._processes):
            self._announced = True
            _say(NOTICE)

    def process(self, node: str) -> subprocess.Popen:
        """The process of a node that was started."""
        return self._processes[node]

    def log(self, node: str) -> str:
        """What a node has printed so far."""
        return (self._logs / f"{node}.log").read_text(errors="replace")

    def _last_words(self, node):
        lines = self.log(node).strip().splitlines()
        return f"{' | '.join(lines[-3:]) or 'it has printed above'} (logs: {self._logs})"


def _say(text):
    print(text, file=sys.stderr, flush=True)
