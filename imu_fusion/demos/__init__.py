"""``imu_fusion demo``: the main jobs on recordings, through real ROS 2 nodes.

Each demo is a module of its name with ``show(out, console)``.
"""

import importlib
from pathlib import Path
from typing import TYPE_CHECKING

from imu_fusion.errors import ParameterError

if TYPE_CHECKING:
    from rich.console import Console

DEMOS = {
    "orientation": "a sensor turned by hand, against an optical reference",
    "impact": "eight accelerometers recover what a clipping gyroscope has missed",
    "head": "a simulated blow to a head with four accelerometers, against its truth",
    "drive": "a car, GNSS withheld for a while and compared with RTK",
    "jump": "a simulated ski jump, against its truth",
    "avalanche": "a simulated ball in an avalanche, against its truth"}
"""Name to what it shows."""


def run_demo(name: str, out: str | Path, console: "Console") -> None:
    """Run a demo.

    Args:
        name: one of DEMOS.
        out: directory for its files.
        console: where its tables go.

    Raises:
        ParameterError: no such demo.
        ImuFusionError: a node failed.
    """
    if name not in DEMOS:
        raise ParameterError(f"no demo '{name}'; there are: {', '.join(DEMOS)}")
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    importlib.import_module(f"imu_fusion.demos.{name}").show(out, console)
