"""The recordings and parameter files that demos use."""

import os
import sys
from pathlib import Path

import imu_fusion
from imu_fusion.errors import BagError


def data_folder(folder: str) -> Path:
    """A data folder of the package: in the checkout, or installed under share/.

    Raises:
        BagError: neither is there.
    """
    prefixes = [sys.prefix, *os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)]
    candidates = [Path(imu_fusion.__file__).parent.parent / folder]
    candidates += [Path(prefix) / "share" / "imu_fusion" / folder for prefix in prefixes if prefix]
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    raise BagError("the files of the demo are not installed; looked in "
                   + ", ".join(map(str, candidates)))
