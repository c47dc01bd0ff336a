"""One minute of tumbling with ordinary sensors, simulated once for all tests of this room."""

import pytest

from imu_fusion.simulation.rotation import Tumbling, simulate
from test.estimation.orientation.ordinary import ORDINARY


@pytest.fixture(scope="package")
def ordinary():
    return simulate(Tumbling(seed=11), 60.0, rate=200.0, sensors=ORDINARY, seed=3)
