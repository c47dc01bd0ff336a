"""Optional states of the smoother end to end: errors drawn in simulated jumps are found, within
the standard deviations that are stated for them."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.estimation.smoother.params import SurfaceContact
from imu_fusion.estimation.smoother.points import at_surface
from imu_fusion.estimation.smoother.result import SAMPLE
from imu_fusion.evaluation.consistency import nees
from imu_fusion.simulation.jump_sensors import EPOCH, GnssErrors, record
from imu_fusion.simulation.ski_jump import SkiJump
from imu_fusion.surfaces.file import load_surface

# A receiver good enough to tell what a logger's cannot.
SHARP = GnssErrors(position_sd=(0.05, 0.05, 0.1), velocity_sd=(0.05, 0.05, 0.1))


@pytest.fixture(scope="module")
def jump():
    return SkiJump(load_surface("oberstdorf_hs106"))


def check_normalised(z):
    """The mean square of normalised errors lies within what one in a thousand of as many draws
    exceeds, on either side: a standard deviation that is half as large again, or a third less,
    does not pass with 18."""
    low, high = chi2.ppf([0.001, 0.999], z.size) / z.size
    assert low < np.mean(z ** 2) < high, z


def run(jump, logs, params):
    result = Smoother(SmootherParams.from_mapping(params), jump.hill).run(*logs)
    assert result.converged
    return result


def test_errors_of_sensors_and_antenna_are_found(jump):
    """Accelerometer matrix, gyroscope scale and antenna, drawn from their priors, all at once."""
    prior = {"acc_matrix": 0.03, "gyr_scale": 0.03, "gnss_lever_arm": 0.5}
    errors, sds = ({name: [] for name in prior} for _ in range(2))
    for seed in range(6):
        r = record(jump.shaken(np.random.default_rng([seed, 1])), np.random.default_rng(seed),
                   gnss=SHARP)
        rng = np.random.default_rng([seed, 2])
        matrix, scale, lever = (sd * rng.standard_normal(n) for sd, n in zip(
            prior.values(), (9, 3, 3)))
        # The model: force = (I + C) acc - bias, rate = (1 + s) gyr - bias.
        acc = np.linalg.solve(np.eye(3) + matrix.reshape(3, 3), r.imu.acc.T).T
        imu = dataclasses.replace(r.imu, acc=acc, gyr=r.imu.gyr / (1.0 + scale))
        motion = jump.at((r.fix.stamp - r.imu.stamp[0]) * 1e-9)
        turn = Rotation.from_quat(motion.quat_world_imu)
        place = jump.hill.origin.to_enu(r.fix.latitude_deg, r.fix.longitude_deg, r.fix.height)
        geodetic = jump.hill.origin.to_geodetic(place + turn.apply(lever))
        fix = dataclasses.replace(r.fix, **dict(zip(
            ("latitude_deg", "longitude_deg", "height"), geodetic)))
        velocity = dataclasses.replace(r.velocity, vel_world=r.velocity.vel_world
                                       + turn.apply(np.cross(motion.omega_imu, lever)))
        states = run(jump, (imu, r.mag, fix, velocity), {
            "sensor.acc_matrix_sd": 0.03, "sensor.gyro_scale_sd": 0.03,
            "gnss.lever_arm_sd": 0.5}).states
        for name, true in zip(prior, (matrix, scale, lever)):
            errors[name].append(states[name][0][0] - true)
            sds[name].append(states[name][1][0])
    for name, sd in prior.items():
        error, stated = np.array(errors[name]), np.array(sds[name])
        check_normalised(error / stated)
        # All are seen: the jumper turns by more than a right angle, at up to several g.
        assert np.all(stated < 0.25 * sd), name
        assert np.all(np.sqrt(np.mean(error ** 2, axis=0)) < 0.4 * sd), name


class Carried:
    """A simulated jump whose sensor is not the point that follows the profile: that one is at
    ``lever_imu`` m from it, on the same rigid body."""

    def __init__(self, jump, lever_imu):
        self.jump, self.lever = jump, np.asarray(lever_imu)

    def __getattr__(self, name):
        return getattr(self.jump, name)

    def _arm(self, motion):
        """R l and its derivative R (w x l)."""
        turn = Rotation.from_quat(motion.quat_world_imu)
        return turn.apply(np.tile(self.lever, (len(motion.time), 1))), turn.apply(
            np.cross(motion.omega_imu, self.lever))

    def at(self, t):
        t = np.atleast_1d(t)
        motion = self.jump.at(t)
        # Half of the step between the values that make up a reading: their differences add up to
        # the change of velocity, though the rate has steps where the profile's curvature has.
        h = 5e-4
        after, before = (self._arm(self.jump.at(t + s))[1] for s in (h, -h))
        arm, speed = self._arm(motion)
        return dataclasses.replace(
            motion, position_world=motion.position_world - arm, vel_world=motion.vel_world - speed,
            acc_world=motion.acc_world - (after - before) / (2 * h))


LEVER = np.array([0.5, -0.3, 0.6])


def test_the_point_at_the_lever_arm_is_held(jump):
    r = record(Carried(jump, LEVER), np.random.default_rng(3))

    def judged(lever):
        result = run(jump, (r.imu, r.mag, r.fix, r.velocity), {"surface.lever_arm": tuple(lever)})
        error = result.samples["position_world"] - r.motion.position_world
        return (result, np.sqrt(np.mean(error ** 2, axis=0)),
                nees(error, result.samples["cov_position"]).mean())

    result, rms, ratio = judged(LEVER)
    # As where the sensor itself is held (BOUNDS of test_smoother); the length is that of the skis.
    assert np.all(rms < [0.25, 0.25, 0.12]) and ratio < 6.0
    assert abs(result.jump.length - jump.length) < 2 * result.jump.length_sd < 0.4
    assert abs(result.events.takeoff - EPOCH - jump.t_takeoff * 1e9) < 0.02e9
    assert result.remarks() == [] and all(f.excess < 1.2 for f in result.surface.values())
    # Without it, or on the other side, the trajectory is held where the sensor is not.
    for sign, height in ((0, 0.4), (-1, 0.8)):
        result, rms, ratio = judged(sign * LEVER)
        assert rms[2] > height and ratio > 6.0
        assert any("stands off the surface" in text for text in result.remarks())


def test_the_lever_arm_is_found(jump):
    z = []
    for seed in range(4):
        rng = np.random.default_rng([seed, 3])
        r = record(Carried(jump.shaken(rng), LEVER), rng, gnss=SHARP)
        result = run(jump, (r.imu, r.mag, r.fix, r.velocity), {"surface.lever_arm_sd": 1.0})
        value, sd = (v[0] for v in result.states["surface_lever_arm"])
        assert np.all(sd < 0.02)
        assert abs(result.jump.length - jump.length) < 0.2
        z.append((value - LEVER) / sd)
    check_normalised(np.array(z))


def test_samples_at_the_surface(jump):
    time = np.arange(2.0, 26.0, 0.5)
    carried, skis = Carried(jump, LEVER).at(time), jump.at(time)
    samples = np.zeros(len(time), SAMPLE)
    samples["position_world"], samples["vel_world"] = carried.position_world, carried.vel_world
    samples["quat_world_imu"], samples["gyr"] = carried.quat_world_imu, carried.omega_imu
    samples["cov_position"], samples["cov_attitude"] = 0.04 * np.eye(3), 0.01 * np.eye(3)
    samples["gyr_sd"] = 0.2
    params = SmootherParams(surface=SurfaceContact(lever_arm=tuple(LEVER)))
    given = at_surface(samples, {}, params)
    assert np.allclose(given["position_world"], skis.position_world, rtol=0, atol=1e-9)
    assert np.allclose(given["vel_world"], skis.vel_world, rtol=0, atol=1e-9)
    # An error of the attitude moves the point across the arm.
    arm = Rotation.from_quat(samples["quat_world_imu"]).apply(LEVER)
    along = np.einsum("ni,nij,nj->n", arm, given["cov_position"], arm) / (LEVER @ LEVER)
    assert np.allclose(along, 0.04)

    def total(samples, name):
        return np.trace(samples[name], axis1=1, axis2=2)

    swing = np.sum(np.cross(carried.omega_imu, LEVER) ** 2, axis=1)
    assert np.allclose(total(given, "cov_position"), 3 * 0.04 + 2 * 0.01 * LEVER @ LEVER)
    assert np.allclose(total(given, "cov_velocity"), 2 * 0.01 * swing + 2 * 0.04 * LEVER @ LEVER)
    sd = np.array([0.1, 0.2, 0.3])
    found = {"surface_lever_arm": (np.tile(LEVER, (len(time), 1)), np.tile(sd, (len(time), 1)))}
    state = at_surface(samples, found, SmootherParams())
    assert np.allclose(state["position_world"], given["position_world"], rtol=0, atol=1e-9)
    added = sum(np.sum(np.cross(carried.omega_imu, s * axis) ** 2, axis=1)
                for s, axis in zip(sd, np.eye(3)))
    assert np.allclose(total(state, "cov_position"), total(given, "cov_position") + 0.14)
    assert np.allclose(total(state, "cov_velocity"), total(given, "cov_velocity") + added)
    assert at_surface(samples, {}, SmootherParams()) is samples
