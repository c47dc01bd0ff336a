"""``imu_fusion demo``: the main job on a real recording, through real ROS 2 nodes."""

import importlib.util
import time
from dataclasses import dataclass
from pathlib import Path

from rich.table import Table

from imu_fusion.errors import BagError
from imu_fusion.estimation.orientation_error import BROAD_ANGLES, error_statistics, orientation_errors
from imu_fusion.graph import Graph
from imu_fusion.messages.bag import open_bag


def bags_directory():
    """Where the recordings of the package are: in the checkout, or installed under share/.

    Raises:
        BagError: neither is there.
    """
    package = Path(importlib.util.find_spec("imu_fusion").origin).parent
    candidates = [package.parent / "bags"]
    try:
        from ament_index_python.packages import get_package_share_directory
        candidates.append(Path(get_package_share_directory("imu_fusion")) / "bags")
    except (ImportError, LookupError):
        pass  # no ROS, or not installed with ament
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    raise BagError("the recordings of the demo are not installed; looked in "
                   + ", ".join(map(str, candidates)))
