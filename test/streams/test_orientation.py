"""The stream of the orientation estimator: what its services do, without a node."""

import numpy as np
import pytest

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.messages.convert import imu_message, mag_message
from imu_fusion.messages.layouts import IMU, NANOSECONDS
from imu_fusion.messages.transforms import TF_TOPIC, TF_TYPE
from imu_fusion.messages.typestore import TYPES
from imu_fusion.streams.orientation import OrientationStream
from imu_fusion.streams.orientation_messages import ORIENTATION_TOPIC, OrientationOutputParams
from imu_fusion.streams.stream import IMU_TOPIC, MAG_TOPIC


@pytest.mark.parametrize("values", [{}, {"method": "gyro_mag"},
                                    {"method": "gyro_mag", "gyro_mag.as_printed": True}],
                         ids=["fusion", "gyro_mag", "as printed"])
def test_a_calibration_is_taken_over_by_every_method(values):
    stream = OrientationStream(OrientationParams.from_mapping(values))
    directions = np.random.default_rng(1).normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    stamps = np.arange(len(directions), dtype=np.int64) * 100_000_000
    list(stream.use({MAG_TOPIC: (stamps, 48e-6 * directions + [1e-5, 0.0, -5e-6])}))
    found = stream.calibrate_magnetometer()
    params = stream.estimator.params
    assert params.sensor.mag_offset == pytest.approx([1e-5, 0.0, -5e-6], abs=1e-9)
    assert params.sensor.mag_offset == tuple(found.offset)
    assert params.method == stream.params.method and params.is_as_printed == (
        "gyro_mag.as_printed" in values)


def test_transforms_are_the_published_orientations_from_the_fixed_frame():
    """Also turned by set_heading."""
    output = OrientationOutputParams(publish_tf=True, fixed_frame="map")
    stream = OrientationStream(output=output)
    stamps = range(0, 4 * NANOSECONDS, 10_000_000)
    messages = {IMU_TOPIC: [imu_message(s, "ball", (0, 0, 0), (0, 1, 9.7)) for s in stamps],
                MAG_TOPIC: [mag_message(s, "ball", (0, 2e-5, -4e-5)) for s in stamps]}
    made = stream.take({topic: cdrs[:300] for topic, cdrs in messages.items()})
    stream.set_heading(1.0)
    made += stream.take({topic: cdrs[300:] for topic, cdrs in messages.items()})
    imu, tf = ([cdr for part in made if part.topic == topic for cdr in part.cdrs]
               for topic in (ORIENTATION_TOPIC, TF_TOPIC))
    assert len(imu) == len(tf) == 400
    for cdr, transform in zip(imu, tf):
        stamp, frame_id, values = IMU.decode(cdr)
        (found,) = TYPES.deserialize_cdr(transform, TF_TYPE).transforms
        assert (found.header.frame_id, found.child_frame_id) == ("map", frame_id)
        assert found.header.stamp.sec * NANOSECONDS + found.header.stamp.nanosec == stamp
        turn = found.transform.rotation
        assert [turn.x, turn.y, turn.z, turn.w] == values[IMU["orientation"]].tolist()


def test_all_numbers_of_a_result_have_units():
    stream = OrientationStream()
    stamps = 10_000_000 * np.arange(200)
    force = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.81], (200, 1))
    mag = np.tile([0.0, 2e-5, -4e-5], (200, 1))
    list(stream.use({IMU_TOPIC: (stamps, force), MAG_TOPIC: (stamps, mag)}))
    results = stream.conclude().results
    numbers = {name for name, value in results.items() if isinstance(value, float)}
    assert results["aligned"] and len(numbers) > 20 and numbers <= set(results["units"])


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
        list(stream.use({MAG_TOPIC: (stamps[part], mag[part])}))
    found = stream.calibrate_magnetometer()
    assert found.offset == pytest.approx([50e-6 * scale, 0.0, -5e-6 * scale], abs=4e-7 * scale)


def test_samples_left_out_before_the_start_are_counted():
    said = []
    params = OrientationParams.from_mapping({"mode": "smoothed", "alignment.start": 2.0})
    stream = OrientationStream(params, warn=said.append)
    stamps = 10_000_000 * np.arange(500)
    list(stream.use({IMU_TOPIC: (stamps, np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.81], (500, 1)))}))
    rows = sum(len(part.stamp) for part in stream.flush() if part.topic == ORIENTATION_TOPIC)
    assert len(said) == 1 and said[0].startswith(f"{500 - rows} Imu samples before the rest")
    assert rows == 300
