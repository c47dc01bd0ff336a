"""What holds of every estimator that takes samples as they come, whatever it estimates.

As the common tests of manif (groups) and navlie (measurement models): one set of checks, run
over all. The smoother takes whole recordings: of these checks none is about it.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
)
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.samples.logs import ImuLog, MagLog
from imu_fusion.simulation.rigid_body_impact import PAPER_AXES, PAPER_POSITIONS
from imu_fusion.simulation.rigid_body_impact import simulate as simulate_impact
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate

TURN = Rotation.from_euler("xyz", [40.0, -25.0, 110.0], degrees=True)
YAW = 33.0   # degrees


class Orientation:
    """An orientation estimator and a tumbling body. ``turn``: body axes to those of the sensor;
    ``yaw``: of the world about the vertical, degrees."""

    quat, covariances = "quat_world_imu", ("cov_attitude",)
    _logs = None

    def __init__(self, turn=None, yaw=0.0, noise=1.0, **values):
        # The axes keep the same parameters when they are turned: nothing is estimated of scales.
        self._params = OrientationParams.from_mapping({
            "declination_deg": -yaw, "sensor.gyro_noise_density": 2e-4 * noise,
            "sensor.mag_noise_sd": 3e-7 * noise, **values})
        if Orientation._logs is None:
            Orientation._logs = simulate(
                Tumbling(seed=3), 8.0, rate=100.0, seed=5,
                sensors=Sensors(gyr_density=2e-4, acc_density=2e-3, mag_sd=3e-7))[:2]
        imu, mag = Orientation._logs
        if turn is not None:
            imu = ImuLog(imu.stamp, turn.apply(imu.gyr), turn.apply(imu.acc), imu.frame_id)
            mag = MagLog(mag.stamp, turn.apply(mag.mag), mag.frame_id)
        # Of one stamp the magnetometer first, as run() takes them.
        self.samples = sorted(
            [("mag", mag, i) for i in range(len(mag))] + [("imu", imu, i) for i in range(len(imu))],
            key=lambda sample: sample[1].stamp[sample[2]])
        self._whole = imu, mag

    def make(self):
        return OrientationEstimator(self._params)

    def run(self):
        return self.make().run(*self._whole)

    @staticmethod
    def add(estimator, sample):
        kind, log, i = sample
        if kind == "mag":
            return estimator.add_mag(int(log.stamp[i]), log.mag[i])
        return estimator.add_imu(int(log.stamp[i]), log.gyr[i], log.acc[i])


class Field:
    """An acceleration field and the impacts of the paper; arguments as of Orientation."""

    quat = "quat"
    covariances = ("cov_attitude", "cov_omega", "cov_alpha", "cov_specific_force",
                   "cov_acceleration_world")
    _motion = None

    def __init__(self, turn=None, yaw=0.0, noise=1.0, **values):
        turn = Rotation.identity() if turn is None else turn
        start = Rotation.from_euler("z", yaw, degrees=True) * turn.inv()
        self._params = AccelerationFieldParams.from_mapping({
            "initial.mode": "given", "initial.orientation": start.as_quat().tolist(),
            "initial.angular_velocity": turn.apply([5.0, 5.0, 5.0]).tolist(), "gravity": 9.8,
            "initial.orientation_sd": 0.01 * noise, "sensor.acc_noise_density": 1e-2 * noise,
            "sensor.acc_bias_sd": 0.1 * noise, **values})
        self._sensors = [
            AccelerometerParams(position=tuple(turn.apply(p)),
                                axes=tuple(turn.apply(a).ravel()))
            for p, a in zip(PAPER_POSITIONS, PAPER_AXES)]
        if Field._motion is None:
            Field._motion = simulate_impact(duration=0.4)
        motion = Field._motion
        readings = motion.readings(PAPER_POSITIONS, PAPER_AXES)
        readings = readings + np.random.default_rng(0).normal(0.0, 0.3, readings.shape)
        self.samples = list(zip(motion.stamp.tolist(), readings))
        self._whole = motion.stamp, readings

    def make(self):
        return AccelerationFieldEstimator(self._params, self._sensors)

    def run(self):
        return self.make().run(*self._whole)

    @staticmethod
    def add(estimator, sample):
        return estimator.add(*sample)


ESTIMATORS = {
    "fusion": (Orientation, {}),
    "gyro_mag": (Orientation, {"method": "gyro_mag"}),
    "gyro_mag as printed": (Orientation, {"method": "gyro_mag", "gyro_mag.as_printed": True}),
    "rigid_body": (Field, {}),
    "ao": (Field, {"method": "ao"}),
    "sqrt_ao": (Field, {"method": "sqrt_ao"}),
}


@pytest.fixture(params=ESTIMATORS)
def case(request):
    """Makes a case of one estimator."""
    kind, values = ESTIMATORS[request.param]
    return lambda **changes: kind(**changes, **values)


def test_splitting_a_run_and_going_on_from_a_snapshot_change_nothing(case):
    it = case()
    whole = it.run()
    first, second = it.make(), it.make()
    cut = len(it.samples) // 2
    rows = [it.add(first, sample) for sample in it.samples[:cut]]
    second.set_state(first.get_state())
    it.add(first, it.samples[cut])   # must not disturb what was taken from it
    rows += [it.add(second, sample) for sample in it.samples[cut:]]
    rows = np.concatenate([*rows, second.finish()])
    assert len(whole) and rows.tobytes() == whole.tobytes()


def test_covariances_are_symmetric_and_not_negative(case):
    it = case()
    rows = it.run()
    for name in it.covariances:
        cov = rows[name]
        size = np.trace(cov, axis1=1, axis2=2)
        assert np.all(size > 0.0), name
        # Rounding: the first samples come out of a prior that is 1e6 times as wide.
        asymmetry = np.abs(cov - cov.transpose(0, 2, 1)).max(axis=(1, 2))
        assert np.all(asymmetry <= 1e-10 * size), name
        assert np.all(np.linalg.eigvalsh(cov)[:, 0] >= -1e-10 * size), name


def test_more_noise_is_more_uncertainty(case):
    it = case()
    little, much = it.run(), case(noise=3.0).run()
    for name in it.covariances:
        assert np.trace(much[name][-1]) > np.trace(little[name][-1]), name


def test_turning_the_body_axes_turns_the_estimate(case):
    it = case()
    plain, turned = it.run(), case(turn=TURN).run()
    back = Rotation.from_quat(turned[it.quat]) * TURN
    error = (back.inv() * Rotation.from_quat(plain[it.quat])).magnitude()
    sd = np.sqrt(np.trace(plain["cov_attitude"], axis1=1, axis2=2))
    assert len(plain) == len(turned) and np.all(error < 0.05 * sd)
    assert np.trace(turned["cov_attitude"][-1]) == pytest.approx(
        np.trace(plain["cov_attitude"][-1]), rel=0.05)


def test_turning_the_world_about_the_vertical_turns_the_estimate(case):
    it = case()
    plain, turned = it.run(), case(yaw=YAW).run()
    expected = Rotation.from_euler("z", YAW, degrees=True) * Rotation.from_quat(plain[it.quat])
    error = (expected.inv() * Rotation.from_quat(turned[it.quat])).magnitude()
    sd = np.sqrt(np.trace(plain["cov_attitude"], axis1=1, axis2=2))
    assert len(plain) == len(turned) and np.all(error < 1e-3 * sd)
