"""Calibrations from recordings."""

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from imu_fusion.batch import estimate
from imu_fusion.calibrate import inertial
from imu_fusion.calibrate.magnetometer import calibrate_recorded_magnetometer
from imu_fusion.cli import cli
from imu_fusion.errors import CalibrationError, ParameterError, TopicError
from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.geometry.magnetic_field import decimal_year, magnetic_field_world
from imu_fusion.messages.convert import attitude_log, fix_message, imu_message, mag_message
from imu_fusion.parameters.file import parameters_for
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.logs import read_log
from imu_fusion.simulation.ball_sensors import EPOCH
from imu_fusion.streams.orientation import OrientationStream
from imu_fusion.streams.orientation_messages import OrientationOutputParams
from imu_fusion.streams.smoother import SmootherStream
from imu_fusion.streams.smoother_params import SmootherNodeParams, SmoothingParams

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
    # The norm before and after: iron of 25 uT over all directions, and the noise.
    assert found.recorded_sd == pytest.approx(25e-6 / np.sqrt(3.0), rel=0.2)
    assert found.residual_sd == pytest.approx(2e-7, rel=0.1)


def test_the_command_writes_what_both_estimators_read(bag, tmp_path):
    out = tmp_path / "ball.yaml"
    result = CliRunner().invoke(cli, ["calibrate", "magnetometer", str(bag), "--out", str(out)])
    assert result.exit_code == 0 and "directions seen" in result.output
    orientation, output = parameters_for((OrientationParams, OrientationOutputParams),
                                         "orientation_estimator", out)
    (smoother, _) = parameters_for((SmoothingParams, SmootherNodeParams), "smoother", out)
    orientation = OrientationStream(orientation, output).params
    smoother = smoother.with_calibrated_magnetometer()
    assert orientation.sensor.mag_offset == smoother.sensor.mag_offset == pytest.approx(
        OFFSET, abs=1e-7)
    with pytest.raises(ParameterError, match="two calibrations"):
        smoother.replace(**{"calibration.mag_bias": (1e-6, 0.0, 0.0)})
    shown = CliRunner().invoke(cli, ["calibrate", "magnetometer", str(bag)])
    text = shown.output[shown.output.index("# Magnetometer"):]
    assert yaml.safe_load(text) == yaml.safe_load(out.read_text())


def test_a_topic_that_is_not_there_is_named(bag):
    with pytest.raises(TopicError, match="no topic imu/field"):
        calibrate_recorded_magnetometer(bag, "imu/field")


A_GYR = np.array([[1.02, 0.01, -0.005], [-0.008, 0.985, 0.006], [0.004, -0.01, 1.01]])
B_GYR = np.array([0.012, -0.02, 0.008])
A_ACC = np.array([[1.02, 0.006, -0.004], [0.006, 0.98, 0.008], [-0.004, 0.008, 1.01]])
B_ACC = np.array([0.2, -0.1, 0.15])
GRAVITY = 9.80665
RATE = 100


def turned_by_hand(seed=0, turns=16, angle=None, moved=0.0):
    """(stamp, gyr, acc) of rests of 1.6 s with smooth turns of 1.5 s between them, as the sensor
    that A and b calibrate measures them. angle: of every turn, deg; None: any."""
    rng = np.random.default_rng(seed)
    attitude, rates, forces = Rotation.random(random_state=rng), [], []
    still, moving = int(1.6 * RATE), int(1.5 * RATE)
    profile = 2.0 / 1.5 * np.sin(np.pi * (np.arange(moving) + 0.5) / moving) ** 2
    for k in range(turns + 1):
        up = attitude.inv().apply([0.0, 0.0, GRAVITY])
        rates.append(np.zeros((still, 3)))
        forces.append(np.tile(up, (still, 1)))
        if k < turns:
            axis = np.eye(3)[k % 3] + 0.3 * rng.standard_normal(3)
            by = np.radians(rng.uniform(70, 170) if angle is None else angle)
            by *= np.sign(rng.standard_normal())
            rate = np.outer(profile, by * axis / np.linalg.norm(axis))
            after = attitude * Rotation.from_rotvec(
                np.cumsum(rate, axis=0) / RATE)
            rates.append(rate)
            forces.append(after.inv().apply([0.0, 0.0, GRAVITY])
                          + moved * rng.standard_normal((moving, 3)))
            attitude = after[-1]
    rate, force = np.concatenate(rates), np.concatenate(forces)
    stamp = EPOCH + np.arange(len(rate)) * (10**9 // RATE)
    gyr = (rate - B_GYR) @ np.linalg.inv(A_GYR).T + 1e-3 * rng.standard_normal(rate.shape)
    acc = (force - B_ACC) @ np.linalg.inv(A_ACC).T + 0.02 * rng.standard_normal(rate.shape)
    return stamp, gyr, acc


def write(path, stamp, gyr, acc):
    with BagWriter(path) as writer:
        for t, g, a in zip(stamp.tolist(), gyr, acc):
            writer.write("/imu/data_raw", "sensor_msgs/msg/Imu", imu_message(t, "imu_link", g, a),
                         t)
    return path


@pytest.fixture(scope="module")
def by_hand(tmp_path_factory):
    return write(tmp_path_factory.mktemp("hand") / "bag", *turned_by_hand(1, 24))


def test_rests_and_turns_calibrate_accelerometer_and_gyroscope(by_hand):
    acc, remarks = inertial.calibrate_recorded_accelerometer(by_hand)
    assert "gravity of the place" in remarks[0]
    assert len(acc.residual) == 25
    error = np.r_[(acc.matrix - A_ACC).ravel(), acc.bias - B_ACC]
    assert np.abs(error).max() < 0.01 and np.mean(np.abs(error) < 3 * acc.sd) > 0.9
    gyr, remarks = inertial.calibrate_recorded_gyroscope(by_hand)
    assert "no angle" in remarks[0]
    error = np.r_[(gyr.matrix - A_GYR).ravel(), gyr.bias - B_GYR]
    assert np.abs(error).max() < 0.005 and np.mean(np.abs(error) < 3 * gyr.sd) > 0.9
    # The offset itself is a mean of noise, however well the turns tell the matrix.
    assert (np.abs(error[9:]) < 3 * gyr.sd[9:]).all()


def test_turns_by_a_known_angle_tell_the_scale(tmp_path):
    """Half turns about fixed axes, as on the sides of a table."""
    bag = write(tmp_path / "bag", *turned_by_hand(2, 12, angle=180.0))
    found, remarks = inertial.calibrate_recorded_gyroscope(bag, angle_deg=180.0)
    assert np.abs(np.linalg.norm(found.matrix, axis=1) - np.linalg.norm(A_GYR, axis=1)).max() < 2e-3
    with pytest.raises(CalibrationError, match="contradict gravity or their angle"):
        inertial.calibrate_recorded_gyroscope(bag, angle_deg=150.0)


def test_a_recording_that_never_rests_or_turns_is_refused(tmp_path):
    stamp, gyr, acc = turned_by_hand(3, 2)
    bag = write(tmp_path / "few", stamp, gyr, acc)
    with pytest.raises(CalibrationError, match="3 still poses"):
        inertial.calibrate_recorded_accelerometer(bag)
    with pytest.raises(CalibrationError, match="2 turns"):
        inertial.calibrate_recorded_gyroscope(bag)
    for count in (1, 2):
        bag = write(tmp_path / f"{count} samples", stamp[:count], gyr, acc)
        for calibrate in (inertial.calibrate_recorded_accelerometer,
                          inertial.calibrate_recorded_gyroscope):
            with pytest.raises(CalibrationError, match="no rest of a second"):
                calibrate(bag)


def test_both_estimators_see_calibrated_samples(by_hand, tmp_path):
    """The file of the command, read by the streams: what they publish is A x~ + b."""
    out = tmp_path / "acc.yaml"
    result = CliRunner().invoke(cli, ["calibrate", "accelerometer", str(by_hand), "--out",
                                      str(out)], catch_exceptions=False)
    assert result.exit_code == 0 and "residuals" in result.output
    about = yaml.safe_load(out.read_text())["calibration_of_accelerometer"]["ros__parameters"]
    assert len(about["covariance"]) == 144 and about["method"] and about["date"]
    _, made = estimate(by_hand, ["orientation_estimator"], (out,), keep=["imu/data"])
    log = attitude_log(made["imu/data"])
    rest = slice(20, 140)
    assert np.linalg.norm(log.acc[rest].mean(axis=0)) == pytest.approx(GRAVITY, abs=0.01)
    smoother, _ = parameters_for((SmoothingParams, SmootherNodeParams), "smoother", out)
    stream = SmootherStream(smoother)
    with open_bag(by_hand) as reader:
        stream.take({"imu/data_raw": [cdr for *_, cdr in reader.messages()][:200]})
        raw = read_log(reader, "imu/data_raw")
    stream.finish()
    ((_, values),) = stream._collected["imu/data_raw"][:1]
    matrix = np.reshape(smoother.calibration.acc_matrix, (3, 3))
    assert values[:, 3:] == pytest.approx(
        raw.acc[:len(values)] @ matrix.T + smoother.calibration.acc_bias)
    assert values[:, :3] == pytest.approx(raw.gyr[:len(values)])
