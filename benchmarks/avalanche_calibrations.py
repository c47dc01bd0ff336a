"""Calibrations of a simulated avalanche ball against what was drawn: for benchmarks.avalanche."""

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.sensors.accelerometer_calibration import calibrate_accelerometer
from imu_fusion.sensors.gyroscope_calibration import Turn, calibrate_gyroscope
from imu_fusion.simulation.ball_sensors import RATE, BallErrors

REST = 2.0            # s, of a pose on the table


def calibration_errors(ball):
    """Normalised errors of the magnetometer's offset (3,), and of what rests and turns by hand tell
    of an accelerometer and a gyroscope with the ball's errors (12,), (12,)."""
    sd = np.sqrt(ball.calibration.cov.diagonal()[:3])
    errors, rng = BallErrors(), ball.rng
    draw = lambda size: np.eye(3) + size * rng.standard_normal((3, 3))   # noqa: E731
    (acc, acc_bias), (gyr, gyr_bias) = (
        (draw(m), b * rng.standard_normal(3)) for m, b in (
            (errors.acc_matrix_sd, errors.acc_bias_sd), (errors.gyr_matrix_sd, errors.gyr_bias_sd)))
    mean = errors.acc_sd / np.sqrt(REST * RATE)
    felt = ball.avalanche.gravity * np.vstack([np.eye(3), -np.eye(3)])
    poses = felt @ acc.T + acc_bias + mean * rng.standard_normal(felt.shape)
    offset_sd = np.full(3, errors.gyr_sd / np.sqrt(10 * REST * RATE))
    offset = gyr_bias + offset_sd * rng.standard_normal(3)
    turns = [half_turn(axis, gyr, gyr_bias, mean, rng) for axis in rng.standard_normal((12, 3))]
    return [(ball.calibration.offset - ball.log.mag_offset) / sd,
            linear_error(calibrate_accelerometer(poses, ball.avalanche.gravity, mean), acc,
                         acc_bias),
            linear_error(calibrate_gyroscope(turns, offset, offset_sd, np.pi), gyr, gyr_bias)]


def linear_error(found, matrix, bias):
    """Normalised errors (12,) of a LinearCalibration of a sensor that reads matrix @ x + bias."""
    back = np.linalg.inv(matrix)
    return np.concatenate([(found.matrix - back).ravel(), found.bias + back @ bias]) / found.sd


def half_turn(axis, matrix, bias, mean, rng):
    """Turn by 180 deg about an axis (3,) in two seconds, from a random pose."""
    errors, axis = BallErrors(), axis / np.linalg.norm(axis)
    time = np.arange(int(2 * RATE) + 1) / RATE
    rate = 0.5 * np.pi * (1.0 - np.cos(np.pi * time))[:, None] * axis
    seen = rate @ matrix.T + bias + errors.gyr_sd * rng.standard_normal(rate.shape)
    before = Rotation.random(random_state=rng.integers(2 ** 31)).apply([0.0, 0.0, 9.8])
    after = Rotation.from_rotvec(-np.pi * axis).apply(before)
    return Turn(time, seen, *(v + mean * rng.standard_normal(3) for v in (before, after)))
