"""The notice that numba is at work."""

import os
import subprocess
import sys

from numba import njit

from imu_fusion.kernels import NOTICE, announced_compiling

_PROGRAM = """
import numpy as np
from imu_fusion.kernels import announced_compiling
from imu_fusion.geometry.rotation import quat_exp
with announced_compiling(print):
    quat_exp(np.zeros(3))
"""


def test_the_first_kernel_is_announced():
    @njit
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


def test_kernels_from_the_cache_are_not(tmp_path):
    environment = dict(os.environ, NUMBA_CACHE_DIR=str(tmp_path))
    said = [subprocess.run([sys.executable, "-c", _PROGRAM], env=environment, check=True,
                           capture_output=True, text=True).stdout for _ in range(2)]
    assert said == [NOTICE + "\n", ""]
