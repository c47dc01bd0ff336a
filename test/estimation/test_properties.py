"""What holds of every estimator, whatever it estimates.

As the common tests of manif (groups) and navlie (measurement models): one set of checks, run
over all. Whoever smooths takes whole recordings, which cannot be split.
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
from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.logs import FixLog, ImuLog, MagLog, VelocityLog
from imu_fusion.simulation.rigid_body_impact import PAPER_AXES, PAPER_POSITIONS
from imu_fusion.simulation.rigid_body_impact import simulate as simulate_impact
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate

TURN = Rotation.from_euler("xyz", [40.0, -25.0, 110.0], degrees=True)
YAW = 33.0   # degrees
FIELD = np.array([1e-6, 21e-6, -43e-6])


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


class WholeOrientation(Orientation):
    """In mode smoothed, which takes whole recordings."""

    def __init__(self, **values):
        super().__init__(**values)
        self.samples = None


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


class Trajectory:
    """The smoother and a body that turns about all axes on a curve; arguments as of Orientation."""

    quat, covariances = "quat_world_imu", ("cov_attitude", "cov_position", "cov_velocity")
    samples = None

    def __init__(self, turn=None, yaw=0.0, noise=1.0, **values):
        turn = Rotation.identity() if turn is None else turn
        world = Rotation.from_euler("z", yaw, degrees=True)
        field = world.apply(FIELD)
        self._params = SmootherParams.from_mapping({
            "gravity": 9.8, "gnss.covariances": False, "gnss.fix_sd": [1.0 * noise] * 3,
            "gnss.velocity_sd": [0.1 * noise] * 3,
            "sensor.gyro_noise_density": 1e-3 * noise, "sensor.acc_noise_density": 1e-2 * noise,
            **{name: field.tolist() if value is FIELD else value
               for name, value in values.items()}})
        rng = np.random.default_rng(8)
        t = np.arange(0.0, 10.0, 0.02)
        stamp = 1_600_000_000_000_000_000 + np.round(t * 1e9).astype(np.int64)
        # place = r (cos wt, sin wt, cos(2wt) / 4); the body turns about fixed axes one by one.
        w, r, zero = 0.9, 12.0, np.zeros_like(t)
        place = r * np.stack([np.cos(w * t), np.sin(w * t), np.cos(2 * w * t) / 4], axis=1)
        vel = r * w * np.stack([-np.sin(w * t), np.cos(w * t), -np.sin(2 * w * t) / 2], axis=1)
        acc = -r * w * w * np.stack([np.cos(w * t), np.sin(w * t), np.cos(2 * w * t)], axis=1)
        attitude = (Rotation.from_rotvec(np.stack([zero, zero, w * t], axis=1))
                    * Rotation.from_rotvec(np.stack([0.5 * np.sin(t), zero, zero], axis=1)))
        rate = (Rotation.from_rotvec(np.stack([0.5 * np.sin(t), zero, zero], axis=1)).inv()
                .apply([0.0, 0.0, w]) + np.stack([0.5 * np.cos(t), zero, zero], axis=1))
        noises = rng.standard_normal((len(t), 9))
        gyr = rate + 7e-3 * noises[:, :3]
        force = attitude.inv().apply(acc + [0, 0, 9.8]) + 0.07 * noises[:, 3:6]
        mag = attitude.inv().apply(FIELD) + 1e-6 * noises[:, 6:]
        k = np.arange(0, len(t), 10)
        place, vel = (world.apply(x[k] + sd * rng.standard_normal((len(k), 3)))
                      for x, sd in ((place, 1.0), (vel, 0.1)))
        unknown = np.full((len(k), 3, 3), np.nan)
        self._whole = (
            ImuLog(stamp, turn.apply(gyr), turn.apply(force), "imu"),
            MagLog(stamp, turn.apply(mag), "imu"),
            # Near a pole the rate of the Earth is the same when the world turns.
            FixLog(stamp[k], *LocalFrame(89.8, 10.3, 900.0).to_geodetic(place), unknown,
                   np.zeros(len(k))),
            VelocityLog(stamp[k], vel, unknown))

    def run(self):
        return Smoother(self._params).run(*self._whole).samples


ESTIMATORS = {
    "fusion": (Orientation, {}),
    "fusion smoothed": (WholeOrientation, {"mode": "smoothed"}),
    "gyro_mag": (Orientation, {"method": "gyro_mag"}),
    "gyro_mag as printed": (Orientation, {"method": "gyro_mag", "gyro_mag.as_printed": True}),
    "rigid_body": (Field, {}),
    "rigid_body smoothed": (Field, {"mode": "smoothed"}),
    "ao": (Field, {"method": "ao"}),
    "sqrt_ao": (Field, {"method": "sqrt_ao"}),
    # Losses and scale factors are of single axes: they do not turn.
    "smoother": (Trajectory, {
        "magnetic_field": FIELD, "sensor.mag_noise_sd": 1e-6, "sensor.mag_scale_sd": 1e-6,
        "gnss.loss": "squared", "mag.loss": "squared"}),
}


@pytest.fixture(params=ESTIMATORS)
def case(request):
    """Makes a case of one estimator."""
    kind, values = ESTIMATORS[request.param]
    return lambda **changes: kind(**changes, **values)


def test_splitting_a_run_and_going_on_from_a_snapshot_change_nothing(case):
    it = case()
    if it.samples is None:
        pytest.skip("takes whole recordings")
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
        assert np.all(asymmetry <= 1e-9 * size), name
        assert np.all(np.linalg.eigvalsh(cov)[:, 0] >= -1e-9 * size), name


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
