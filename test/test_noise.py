"""Noise from a recording at rest. Skipped without allantools, which brings much along."""

import numpy as np
import pytest
import yaml

from imu_fusion.calibrate.noise import noise_of, noise_parameters, recorded_noise
from imu_fusion.errors import CalibrationError
from imu_fusion.messages.convert import imu_message
from imu_fusion.messages.layouts import IMU
from imu_fusion.recordings.bag_writer import BagWriter
from test.sources.test_exports import at_hand, convert

pytest.importorskip("allantools")
RATE = 50.0


def test_density_and_walk_are_those_that_were_put_in():
    """Half an hour: white noise to some percent, the walk to some tens of percent."""
    rng = np.random.default_rng(4)
    n, density, walk = int(1800 * RATE), 2e-3, 3e-4
    values = density * np.sqrt(RATE) * rng.standard_normal((n, 3)) + np.cumsum(
        walk / np.sqrt(RATE) * rng.standard_normal((n, 3)), axis=0)
    found = noise_of("gyroscope", "rad/s", values, RATE)
    assert found.density == pytest.approx([density] * 3, rel=0.1)
    assert found.walk == pytest.approx([walk] * 3, rel=0.6)
    with pytest.raises(CalibrationError, match="at least 5 s"):
        noise_of("gyroscope", "rad/s", values[:100], RATE)


def test_white_noise_shows_no_walk_and_a_knock_is_said(tmp_path):
    rng = np.random.default_rng(5)
    acc = [0.0, 0.0, 9.81] + 0.02 * rng.standard_normal((3000, 3))
    acc[1000:1030] += 2.0 * rng.standard_normal((30, 3))
    gyr = 1e-3 * rng.standard_normal((3000, 3))
    with BagWriter(tmp_path / "bag") as writer:
        for i, (g, a) in enumerate(zip(gyr, acc)):
            stamp = 10**18 + i * 20_000_000
            writer.write("/imu/data_raw", "sensor_msgs/msg/Imu",
                         imu_message(stamp, "imu_link", g, a), stamp)
    found, remarks = recorded_noise(tmp_path / "bag")
    assert any("accelerometer: not still" in text for text in remarks)
    assert not any("gyroscope: not still" in text for text in remarks)
    assert sum("60 s show white noise" in text for text in remarks) == 2
    values = yaml.safe_load(noise_parameters(found, "bag"))["/**"]["ros__parameters"]
    assert values["sensor.gyro_noise_density"] == pytest.approx(1e-3 / np.sqrt(50), rel=0.15)


def test_stamps_that_are_not_set_leave_no_samples(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for i in range(400):
            writer.write("/imu/data_raw", IMU.msgtype,
                         imu_message(0, "imu", np.zeros(3), [0.0, 0.0, 9.81]), i + 1)
    with pytest.raises(CalibrationError, match="gyroscope: 1 usable samples; .*repeated stamp"):
        recorded_noise(tmp_path / "bag")


def test_a_static_log_of_an_avanode(tmp_path):
    """Densities are the scatter of its samples over the root of half its rate, as white noise has
    it, for a bandwidth of 200 Hz: .0075 deg/s/sqrt(Hz) and .33 mg/sqrt(Hz); biases below 1.1 deg/s.
    Of fourteen seconds it says that they tell nothing else."""
    assert convert(at_hand("avanode/C03LData001.txt"), tmp_path / "bag")[0] == 0
    found, remarks = recorded_noise(tmp_path / "bag")
    gyr, acc, _ = found
    assert np.degrees(gyr.density) == pytest.approx([0.0075] * 3, rel=0.4)
    assert acc.density[:2] / 9.80665 == pytest.approx([0.33e-3] * 2, rel=0.4)
    assert np.degrees(np.abs(gyr.mean)).max() < 1.1
    assert any("gyroscope: 14 s show white noise" in text for text in remarks)
