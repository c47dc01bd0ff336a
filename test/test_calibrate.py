"""Calibrations from recordings."""

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from imu_fusion.calibrate import calibrate_recorded_magnetometer
from imu_fusion.cli import cli
from imu_fusion.errors import TopicError
from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.geometry.magnetic_field import decimal_year, magnetic_field_world
from imu_fusion.messages.convert import fix_message, mag_message
from imu_fusion.parameters.file import parameters_for
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.simulation.ball_sensors import EPOCH
from imu_fusion.streams.smoother import SmootherNodeParams, SmoothingParams

OFFSET = np.array([12e-6, -20e-6, 8e-6])
SOFT = np.array([[1.05, 0.02, 0.0], [0.02, 0.96, -0.01], [0.0, -0.01, 1.01]])


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A magnetometer that turns in the field of the Flüela pass, and a fix there."""
    rng = np.random.default_rng(3)
    field = magnetic_field_world(46.7486, 9.9451, 2600.0, decimal_year(EPOCH))
    seen = Rotation.random(600, random_state=rng).inv().apply(field) @ SOFT.T + OFFSET
    seen += 2e-7 * rng.standard_normal(seen.shape)
    path = tmp_path_factory.mktemp("calibrate") / "bag"
    with BagWriter(path) as writer:
        writer.write("/fix", "sensor_msgs/msg/NavSatFix",
                     fix_message(EPOCH, "gnss", 46.7486, 9.9451, 2600.0), EPOCH)
        for i, mag in enumerate(seen):
            stamp = EPOCH + i * 10_000_000
            writer.write("/imu/mag", "sensor_msgs/msg/MagneticField",
                         mag_message(stamp, "imu_link", mag), stamp)
    return path


def test_iron_and_the_norm_of_the_place_are_found(bag):
    found, remarks = calibrate_recorded_magnetometer(bag)
    assert remarks == []
    assert found.matrix == pytest.approx(np.linalg.inv(SOFT), abs=2e-3)
    sd = np.sqrt(found.cov.diagonal()[:3])
    assert np.all(np.abs(found.offset - OFFSET) < 4.0 * sd) and sd.max() < 1e-7


def test_the_command_writes_what_both_estimators_read(bag, tmp_path):
    out = tmp_path / "ball.yaml"
    result = CliRunner().invoke(cli, ["calibrate", "magnetometer", str(bag), "--out", str(out)])
    assert result.exit_code == 0 and "directions seen" in result.output
    (orientation,) = parameters_for((OrientationParams,), "orientation_estimator", out)
    (smoother, _) = parameters_for((SmoothingParams, SmootherNodeParams), "smoother", out)
    assert orientation.sensor.mag_offset == smoother.sensor.mag_offset == pytest.approx(
        OFFSET, abs=1e-7)
    shown = CliRunner().invoke(cli, ["calibrate", "magnetometer", str(bag)])
    text = shown.output[shown.output.index("# Magnetometer"):]
    assert yaml.safe_load(text) == yaml.safe_load(out.read_text())


def test_a_topic_that_is_not_there_is_named(bag):
    with pytest.raises(TopicError, match="no topic imu/field"):
        calibrate_recorded_magnetometer(bag, "imu/field")
