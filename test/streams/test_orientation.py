"""The stream of the orientation estimator: what its services do, without a node."""

import numpy as np
import pytest

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.streams.orientation import MAG_TOPIC, OrientationStream


@pytest.mark.parametrize("values", [{}, {"method": "gyro_mag"},
                                    {"method": "gyro_mag", "gyro_mag.as_printed": True}],
                         ids=["fusion", "gyro_mag", "as printed"])
def test_a_calibration_is_taken_over_by_every_method(values):
    stream = OrientationStream(OrientationParams.from_mapping(values))
    directions = np.random.default_rng(1).normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    stamps = np.arange(len(directions), dtype=np.int64) * 100_000_000
    stream.use({MAG_TOPIC: (stamps, 48e-6 * directions + [1e-5, 0.0, -5e-6])})
    found = stream.calibrate_magnetometer()
    params = stream.estimator.params
    assert params.sensor.mag_offset == pytest.approx([1e-5, 0.0, -5e-6], abs=1e-9)
    assert params.sensor.mag_offset == tuple(found.offset)
    assert params.method == stream.params.method and params.is_as_printed == (
        "gyro_mag.as_printed" in values)


def test_there_is_no_heading_to_set_before_the_first_row():
    with pytest.raises(EstimationError, match="no orientation yet"):
        OrientationStream().set_heading(0.0)
