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


@pytest.mark.parametrize("values", [{}, {"sensor.mag_range": [60e-6] * 3}], ids=["found", "given"])
def test_samples_at_the_magnetometer_s_limit_do_not_bend_its_calibration(values):
    """A sensor of +-60 uT turns slowly beside iron that adds 50 uT on x: a third of the samples are
    cut off. With these the offset would come out 9 uT too small, with 0.3 uT stated."""
    rng = np.random.default_rng(2)
    t = np.arange(6000) * 0.02
    directions = np.column_stack([np.cos(0.9 * t) * np.cos(0.13 * t), np.sin(0.9 * t),
                                  np.cos(0.9 * t) * np.sin(0.13 * t)])
    true = 48e-6 * directions + [50e-6, 0.0, -5e-6] + rng.normal(0.0, 1e-7, (len(t), 3))
    mag = np.clip(np.round(true / 1.5e-7) * 1.5e-7, -60e-6, 60e-6)
    if not values:   # a range below the Earth's field is not searched for
        mag, true = 2.0 * mag, 2.0 * true
    scale = np.abs(mag).max() / 60e-6
    assert (np.abs(mag) >= 60e-6 * scale).any(axis=1).mean() > 0.3
    stream = OrientationStream(OrientationParams.from_mapping(values))
    stamps = (t * 1e9).astype(np.int64)
    for part in np.array_split(np.arange(len(t)), 37):
        stream.use({MAG_TOPIC: (stamps[part], mag[part])})
    found = stream.calibrate_magnetometer()
    assert found.offset == pytest.approx([50e-6 * scale, 0.0, -5e-6 * scale], abs=4e-7 * scale)
