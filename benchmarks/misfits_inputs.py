"""Situations of :mod:`benchmarks.misfits`: what the orientation estimator is given."""

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.scenarios import Outcome, Scenario
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.samples.checks import check_frames
from imu_fusion.samples.logs import ImuLog, MagLog
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate
from imu_fusion.streams.orientation import findings
from imu_fusion.streams.stream import IMU_TOPIC, MAG_TOPIC

REAL = Sensors(gyr_density=2e-4, acc_density=2e-3, mag_sd=3e-7, gyr_bias=(0.01, -0.02, 0.005))
LEVEL = (0.0, 0.0, 0.0, 1.0)    # as most sensors lie at the start
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
AK8963 = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def input_row(situation, before, spoil, with_mag=True, travel_sd=0.2, **params) -> Scenario:
    """Scenario of logs that spoil(imu, mag, rng) -> (imu, mag) has spoilt."""
    def run(seed):
        imu, mag, truth, _ = simulate(
            Tumbling(seed=seed, quat_start=LEVEL, travel_sd=travel_sd), 25.0, rate=100.0,
            sensors=REAL, seed=seed)
        imu, mag = spoil(imu, mag if with_mag else mag[:0], np.random.default_rng(seed))
        logs = {IMU_TOPIC: imu} | ({MAG_TOPIC: mag} if with_mag else {})
        found = findings(logs)
        rows = OrientationEstimator(
            OrientationParams(declination_deg=0.0).replace(**params)).run(imu, mag)
        # By number: stamps may be what is wrong.
        stamps = imu.stamp if len(imu) == len(truth) else truth.stamp
        at = np.searchsorted(stamps, rows["stamp"])
        error = (Rotation.from_quat(rows["quat_world_imu"]).inv()
                 * Rotation.from_quat(truth.quat_world_imu[at]))
        if not with_mag:    # heading is arbitrary
            up = [0.0, 0.0, 1.0]
            angle = np.linalg.norm(
                Rotation.from_quat(rows["quat_world_imu"]).inv().apply(up)
                - Rotation.from_quat(truth.quat_world_imu[at]).inv().apply(up), axis=1)
            sd = np.sqrt(np.mean(np.linalg.eigvalsh(rows["cov_attitude"])[:, :2].sum(axis=1)))
            nees = np.mean(angle ** 2) / sd ** 2 * 3.0
        else:
            vector = error.as_rotvec()
            angle = error.magnitude()
            nees = np.mean(np.einsum("ni,nij,nj->n", vector, np.linalg.inv(
                rows["cov_attitude"] + 1e-12 * np.eye(3)), vector))
            sd = np.sqrt(np.mean(np.trace(rows["cov_attitude"], axis1=1, axis2=2)))
        return Outcome(np.degrees(np.sqrt(np.mean(angle ** 2))), np.degrees(sd), "deg", nees,
                       np.mean(angle <= 3.0 * sd), [f.text for f in found],
                       any(f.unusable for f in found))
    return Scenario("Orientation's inputs", situation, before, run)


def with_imu(imu, gyr=None, acc=None):
    return ImuLog(imu.stamp, imu.gyr if gyr is None else gyr, imu.acc if acc is None else acc,
                  imu.frame_id)


def late(imu, mag, rng):
    t = (imu.stamp - imu.stamp[0]) * 1e-9
    return with_imu(imu, np.column_stack([np.interp(t - 0.1, t, rate) for rate in imu.gyr.T])), mag


def of_another_body(imu, mag, rng):
    other = Tumbling(seed=int(rng.integers(1000, 9999)), quat_start=LEVEL)
    return with_imu(imu, simulate(other, 25.0, rate=100.0, sensors=REAL)[0].gyr), mag


def sticks(axes):
    def spoil(imu, mag, rng):
        gyr = imu.gyr.copy()
        gyr[len(gyr) // 2:, axes] = gyr[len(gyr) // 2, axes]
        return with_imu(imu, gyr), mag
    return spoil


def half_filled(imu, mag, rng):
    first = (np.arange(len(imu)) % 2 == 0)[:, None]
    return with_imu(imu, imu.gyr * first, imu.acc * ~first), mag


def one_wild_force(imu, mag, rng):
    acc = imu.acc.copy()
    acc[rng.integers(1000, 2000)] = 1000.0 * rng.standard_normal(3)
    return with_imu(imu, acc=acc), mag


def constant(imu, mag, rng):
    return with_imu(imu, acc=imu.acc + [1.0, 0.0, 0.0]), mag


def feels(imu, mag, rng):
    return with_imu(imu, imu.gyr + 0.01 * imu.acc), mag


def frames(seed):
    found = check_frames({"imu_left": None, "imu_right": None}, IMU_TOPIC)
    return Outcome(said=[f.text for f in found], refused=any(f.unusable for f in found))


INPUT_ROWS = [
    input_row("clean", "", lambda imu, mag, rng: (imu, mag)),
    input_row("clean, no magnetometer", "", lambda imu, mag, rng: (imu, mag), with_mag=False),
    input_row("rates in deg/s, no magnetometer", "133 deg, silent",
              lambda imu, mag, rng: (with_imu(imu, np.degrees(imu.gyr)), mag), with_mag=False),
    input_row("gyroscope a quarter turn from the accelerometer", "48 deg, stated 1",
              lambda imu, mag, rng: (with_imu(imu, imu.gyr @ QUARTER.T), mag), with_mag=False),
    input_row("rate exactly zero", "silent",
              lambda imu, mag, rng: (with_imu(imu, 0.0 * imu.gyr), mag)),
    input_row("rates half as large", "silent",
              lambda imu, mag, rng: (with_imu(imu, 0.5 * imu.gyr), mag)),
    input_row("rates in rpm", "silent",
              lambda imu, mag, rng: (with_imu(imu, imu.gyr * 30.0 / np.pi), mag)),
    input_row("gyroscope 0.1 s late", "silent", late),
    input_row("gyroscope 0.1 s late, turning in place", "silent", late, travel_sd=0.01),
    input_row("gyroscope 0.1 s late, no magnetometer", "silent", late, with_mag=False),
    input_row("gyroscope of another body", "silent", of_another_body),
    input_row("gyroscope sticks half way", "silent", sticks([0, 1, 2])),
    input_row("z of the gyroscope sticks half way", "silent", sticks([2])),
    input_row("z of the gyroscope is zero", "silent",
              lambda imu, mag, rng: (with_imu(imu, imu.gyr * [1.0, 1.0, 0.0]), mag)),
    input_row("alternate half-filled messages", "silent", half_filled),
    input_row("magnetometer a quarter turn off", "87 deg, stated 5",
              lambda imu, mag, rng: (imu, MagLog(mag.stamp, mag.mag @ QUARTER.T))),
    input_row("magnetometer reversed", "",
              lambda imu, mag, rng: (imu, MagLog(mag.stamp, -mag.mag))),
    input_row("an axis of the accelerometer off by 1 m/s^2", "", constant),
    input_row("the same, sensor.acc_bias_sd as the remark says", "", constant,
              **{"sensor.acc_bias_sd": 1.0}),
    input_row("gyroscope feels accelerations, 0.01 rad/s per m/s^2", "", feels),
    input_row("the same, sensor.gyro_bias_walk and gyro_bias_sd as the remark says", "", feels,
              **{"sensor.gyro_bias_walk": 0.1, "sensor.gyro_bias_sd": 0.1}),
    input_row("magnetometer in the axes of an AK8963", "34 deg",
              lambda imu, mag, rng: (imu, MagLog(mag.stamp, mag.mag @ AK8963.T))),
    input_row("magnetometer constant while turning", "silent",
              lambda imu, mag, rng: (imu, MagLog(mag.stamp, 0.0 * mag.mag + mag.mag[0]))),
    input_row("hard iron twice the field", "",
              lambda imu, mag, rng: (imu, MagLog(mag.stamp, mag.mag + [60e-6, -50e-6, 60e-6]))),
    input_row("specific force reversed, no magnetometer", "silent",
              lambda imu, mag, rng: (with_imu(imu, acc=-imu.acc), mag), with_mag=False),
    input_row("one wild force of 1000 m/s^2", "", one_wild_force),
    Scenario("Orientation's inputs", "two frames on one topic", "silent", frames),
]
