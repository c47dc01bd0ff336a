"""A simulated jump, its recording and its result, for tests of the smoother."""

import numpy as np
import pytest

from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.simulation.jump_sensors import record
from imu_fusion.simulation.ski_jump import SkiJump
from imu_fusion.surfaces.file import load_surface


@pytest.fixture(scope="module")
def jump():
    return SkiJump(load_surface("oberstdorf_hs106"))


@pytest.fixture(scope="module")
def recording(jump):
    return record(jump, np.random.default_rng(4))


@pytest.fixture(scope="module")
def result(jump, recording):
    return Smoother(SmootherParams(), jump.hill).run(
        recording.imu, recording.mag, recording.fix, recording.velocity)
