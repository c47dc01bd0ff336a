"""Gyroscope against gravity and field: what is wrong is named, and nothing where nothing is."""

import ast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.samples.field_turning import check_axes
from imu_fusion.samples.logs import ImuLog, MagLog
from imu_fusion.samples.turning import check_turning, signed_permutations
from test.samples.test_checks import recording

# The magnetometer of an AK8963 beside the gyroscope of its MPU-9250: x and y exchanged, z negated.
AK8963 = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def with_rates(imu, rates):
    return ImuLog(imu.stamp, rates, imu.acc)


def test_rates_in_degrees_are_told_by_gravity_alone():
    imu, _ = recording(acc_noise=0.5)
    assert check_turning(imu, "imu") == []
    (finding,) = check_turning(with_rates(imu, np.degrees(imu.gyr)), "imu")
    assert "deg/s" in finding.text and finding.unusable


@pytest.mark.parametrize("axes", signed_permutations()[1::5], ids=str)
def test_axes_of_gyroscope_and_accelerometer_that_differ_are_named(axes):
    imu, _ = recording()
    (finding,) = check_turning(with_rates(imu, imu.gyr @ axes.T), "imu")
    assert finding.kind == "axes" and finding.unusable
    # What is named brings the rates back.
    letters = finding.text.split("(")[1].split(")")[0].split(", ")
    named = np.array([(-1 if name[0] == "-" else 1) * np.eye(3)["xyz".index(name[-1])]
                      for name in letters])
    assert np.array_equal(named @ axes, np.eye(3))


def test_a_turned_accelerometer_is_told_with_its_angle():
    imu, _ = recording()
    turn = Rotation.from_euler("xyz", [30, 20, -35], degrees=True)
    (finding,) = check_turning(with_rates(imu, turn.apply(imu.gyr)), "imu")
    told = float(finding.text.split("turned by ")[1].split(" ")[0])
    assert told == pytest.approx(np.degrees(turn.magnitude()), abs=4)


def test_large_rates_at_rest_are_told_and_a_bias_is_not():
    imu, _ = recording()
    still = imu[:90]
    assert check_turning(with_rates(still, still.gyr + 0.1), "imu") == []
    (finding,) = check_turning(with_rates(still, still.gyr + [0.9, -0.7, 0.4]), "imu")
    assert "at rest" in finding.text and not finding.unusable


def test_a_turntable_is_no_finding():
    # 20 rad/s about the vertical: gravity stands still, and rightly so.
    imu, _ = recording(n=600)
    flat = np.tile([0.0, 0.0, 9.81], (600, 1)) + imu.acc * 1e-3
    spin = np.tile([0.0, 0.0, 20.0], (600, 1)) + 1e-3 * imu.gyr
    assert check_turning(ImuLog(imu.stamp, spin, flat), "imu") == []


def test_axes_of_the_magnetometer_are_named_with_the_parameter():
    imu, mag = recording()
    assert check_axes(imu, mag, "mag") == []
    (finding,) = check_axes(imu, MagLog(mag.stamp, mag.mag @ AK8963.T), "mag")
    assert "AK8963" in finding.text and finding.unusable
    matrix = np.array(ast.literal_eval(finding.text.split("mag_matrix: ")[1])).reshape(3, 3)
    assert np.array_equal(matrix @ AK8963, np.eye(3))
    # Iron as large as the field changes nothing of it.
    iron = mag.mag @ AK8963.T + [30e-6, -20e-6, 25e-6]
    (finding,) = check_axes(imu, MagLog(mag.stamp, iron), "mag")
    assert "AK8963" in finding.text
    assert check_axes(imu, MagLog(mag.stamp, mag.mag + [5e-6, -8e-6, 5e-6]), "mag") == []


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_one_reversed_axis_of_the_magnetometer_is_told_from_the_two_others(axis):
    """The reversed field stands still as well: that it points down tells which of them it is."""
    imu, mag = recording()
    mirrored = np.diag([-1.0 if i == axis else 1.0 for i in range(3)])
    (finding,) = check_axes(imu, MagLog(mag.stamp, mag.mag @ mirrored), "mag")
    matrix = np.array(ast.literal_eval(finding.text.split("mag_matrix: ")[1])).reshape(3, 3)
    assert np.array_equal(matrix, mirrored)


def test_a_magnetometer_that_stands_still_or_scatters_is_told():
    imu, mag = recording()
    (finding,) = check_axes(imu, MagLog(mag.stamp, mag.mag[:1] + 0 * mag.mag), "mag")
    assert finding.kind == "held" and finding.unusable
    assert check_axes(imu[:90], MagLog(mag.stamp, mag.mag[:1] + 0 * mag.mag)[:90], "mag") == []
    (finding,) = check_axes(imu, MagLog(mag.stamp, mag.mag + [0.0, 60e-6, 60e-6]), "mag")
    assert finding.kind == "unit" and "scatters" in finding.text
