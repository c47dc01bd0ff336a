"""Sensors that are not as described: named, left out, and the rest as good as it can be."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.errors import EstimationError, LayoutError
from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
    Initial,
)
from imu_fusion.estimation.acceleration_field.rows import LEFT_OUT
from imu_fusion.estimation.acceleration_field.sensor_array import make_sensor_array
from imu_fusion.estimation.acceleration_field.standing_axes import StandingAxes
from imu_fusion.simulation.rigid_body_impact import (
    PAPER_AXES,
    PAPER_POSITIONS,
    ImpactScene,
    simulate,
)

CENTRE = np.array([0.0, 0.0, 0.75])
NAMES = ("top", "left", "front", "back")
NOISE = 0.3
PARAMS = AccelerationFieldParams(
    initial=Initial(mode="given", angular_velocity=(5.0, 5.0, 5.0), angular_velocity_sd=0.05,
                    orientation_sd=0.002), gravity=9.8)


@pytest.fixture(scope="module")
def impact():
    return simulate(duration=0.8)


def layout(**changes):
    return {name: AccelerometerParams(
        position=tuple(place - CENTRE), axes=tuple(axes.ravel()), bias_sd=0.1,
        noise_density=NOISE / 1000 ** 0.5, **changes)
        for name, place, axes in zip(NAMES, PAPER_POSITIONS, PAPER_AXES)}


def felt(impact, positions=PAPER_POSITIONS, seed=0):
    random = np.random.default_rng(seed)
    readings = impact.readings(positions, PAPER_AXES)
    return (readings + random.normal(0, 0.1, (1, 4, 3))
            + random.normal(0, NOISE, readings.shape))


def judged(impact, readings, accelerometers=None, **changes):
    """(rows, remarks, mean normalised error squared of the force, its relative error)."""
    estimator = AccelerationFieldEstimator(PARAMS.replace(**changes), accelerometers or layout())
    rows = estimator.run(impact.stamp, readings)
    error = (impact.specific_force_body(CENTRE) - rows["specific_force"])[50:]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(rows["cov_specific_force"][50:]), error)
    return (rows, estimator.remarks(), nees.mean(),
            np.linalg.norm(error) / np.linalg.norm(impact.specific_force_body(CENTRE)))


@pytest.mark.parametrize("mode", ["causal", "smoothed"])
def test_sound_sensors_are_used_and_nothing_is_said(impact, mode):
    rows, remarks, nees, error = judged(impact, felt(impact), mode=mode)
    assert remarks == [] and not rows["flags"].any() and nees < 4 and error < 0.02


def dead(readings):
    readings[300:, 1] = [0.1, 0.0, 0.0]


def backwards(readings):
    readings[:, 0] *= -1.0


def turned(readings):
    readings[:, 3] = readings[:, 3, [1, 2, 0]]


def in_g(readings):
    readings[:, 2] /= 9.80665


@pytest.mark.parametrize("spoil, name, words", [
    (dead, "left", "dead"), (backwards, "top", r"\(-x, -y, -z\)"),
    (turned, "back", r"\(y, z, x\)"), (in_g, "front", r"0\.10[123] times")])
@pytest.mark.parametrize("mode", ["causal", "smoothed"])
def test_a_sensor_that_contradicts_the_others_is_named_and_left_out(impact, spoil, name, words,
                                                                   mode):
    readings = felt(impact)
    spoil(readings)
    rows, remarks, nees, error = judged(impact, readings, mode=mode)
    (remark,) = remarks
    assert f"'{name}'" in remark and re.search(words, remark)
    assert np.sum(rows["flags"] & LEFT_OUT > 0) > 300 and nees < 6 and error < 0.05


def test_a_misplaced_sensor_is_named_with_its_place(impact):
    positions = PAPER_POSITIONS.copy()
    positions[2] += [-0.05, 0.03, 0.02]
    _, remarks, nees, _ = judged(impact, felt(impact, positions))
    (remark,) = remarks
    shift = [float(v) for v in remark.split("sit (")[1].split(")")[0].split(", ")]
    assert "'front'" in remark and np.abs(np.array(shift) - [-50, 30, 20]).max() < 5 and nees < 6


def test_two_that_are_exchanged_are_not_passed_over(impact):
    readings = felt(impact)
    readings[:, [0, 1]] = readings[:, [1, 0]]
    assert any("exchanged" in text for text in judged(impact, readings)[1])


def test_a_mounting_within_its_sd_is_found(impact):
    # 5 deg where 2 deg are expected: within what is plausible, so it is used and estimated.
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(5.0)])
    readings = felt(impact)
    readings[:, 2] = turn.inv().apply(readings[:, 2])
    estimator = AccelerationFieldEstimator(PARAMS, layout())
    estimator.run(impact.stamp, readings)
    fit = estimator.sensor_fits()[2]
    assert fit.left_out < 20
    assert fit.axes_error[2] == pytest.approx(np.radians(5.0), abs=4 * fit.axes_error_sd[2])


@pytest.mark.parametrize("mode", ["causal", "smoothed"])
@pytest.mark.parametrize("modulus", [1e6, 1e7])
def test_a_hard_impact_is_not_blamed_on_the_mounting(modulus, mode):
    # 55 and 135 g within 22 and 8 ms, far beyond the default densities, on an exact rig: the
    # motion prior must not teach mountings that are not there, nor may the stated sds ignore them.
    motion = simulate(ImpactScene(modulus=modulus, ground=0.6, velocity=(0.75, 0.0, -3.0),
                                  mass=4.5), duration=0.15, step=1e-5, every=100)
    normalised = []
    for seed in range(3):
        estimator = AccelerationFieldEstimator(PARAMS.replace(mode=mode), layout())
        rows = estimator.run(motion.stamp, felt(motion, seed=seed))
        error = (rows["omega"] - motion.omega)[20:]
        normalised.append(np.mean(np.einsum("ni,nij,nj->n", error,
                                            np.linalg.inv(rows["cov_omega"][20:]), error)))
        assert np.abs(error).max() < 0.6 and estimator.remarks() == []
    assert np.mean(normalised) < 4


def test_noise_that_alternates_does_not_hide_an_impact():
    # Chance makes it so now and then; the fall ends with 135 g within 8 ms.
    motion = simulate(ImpactScene(modulus=1e7, ground=0.6, velocity=(0.75, 0.0, -3.0), mass=4.5),
                      duration=0.1, step=1e-5, every=100)
    readings = motion.readings(PAPER_POSITIONS, PAPER_AXES)
    sizes = np.abs(np.random.default_rng(4).normal(0.0, NOISE, readings.shape[1:]))
    signs = np.where(np.arange(len(motion.t)) % 2 == 0, 1.0, -1.0)
    estimator = AccelerationFieldEstimator(PARAMS, layout())
    rows = estimator.run(motion.stamp, readings + signs[:, None, None] * sizes)
    error = (rows["omega"] - motion.omega)[20:]
    assert np.mean(np.einsum("ni,nij,nj->n", error, np.linalg.inv(rows["cov_omega"][20:]),
                             error)) < 4


def rig(motion, places, axes, measured, seed):
    """(AccelerometerParams of a rig as described, readings (n, N, 3) of it as it was built)."""
    random = np.random.default_rng(seed)
    rate = 1.0 / (motion.t[1] - motion.t[0])
    sensors = [AccelerometerParams(position=tuple(place), axes=tuple(own.ravel()), bias_sd=0.1,
                                   measured_axes=tuple(letters), noise_density=NOISE / rate ** 0.5)
               for place, own, letters in zip(places, axes, measured)]
    turns = Rotation.from_rotvec(0.035 * random.standard_normal(places.shape))
    readings = motion.readings(CENTRE + places + 1e-3 * random.standard_normal(places.shape),
                               (turns * Rotation.from_matrix(axes)).as_matrix())
    readings += random.normal(0.0, 0.1, (1, *readings.shape[1:]))
    return sensors, readings + random.normal(0.0, NOISE, readings.shape)


def test_a_blow_in_one_direction_is_as_wild_as_that():
    # Twelve single axes at 2 kHz: five components that fit must not hide the sixth.
    motion = simulate(ImpactScene(modulus=1e6, ground=0.6, velocity=(0.75, 0.0, -3.0), mass=4.5),
                      duration=0.15, step=1e-5, every=50)
    random = np.random.default_rng(0)
    random.uniform(size=18)
    places, axes = random.uniform(-0.12, 0.12, (12, 3)), Rotation.random(12, random_state=0)
    normalised = []
    for seed in range(3):
        sensors, readings = rig(motion, places, axes.as_matrix(), ["x"] * 12, seed)
        rows = AccelerationFieldEstimator(PARAMS.replace(sample_rate=2000.0), sensors).run(
            motion.stamp, readings)
        error = (rows["omega"] - motion.omega)[20:]
        normalised.append(np.mean(np.einsum(
            "ni,nij,nj->n", error, np.linalg.inv(rows["cov_omega"][20:]), error)))
    assert np.mean(normalised) < 9


def test_what_is_left_of_an_array_does_not_run_away():
    # Without the one that reads a tenth of what it should, seven channels do not tell the rate.
    motion = simulate(duration=1.0, step=2.5e-5, every=80)
    places = np.array([[0.0, 0.0, 0.08], [0.0, 0.1, 0.0], [0.15, 0.0, 0.0], [-0.15, 0.02, 0.03]])
    axes = np.vstack([Rotation.random(3, random_state=0).as_matrix(),
                      Rotation.random(1, random_state=0).as_matrix()])
    for seed in (4, 5):
        sensors, readings = rig(motion, places, axes, ["xyz", "xyz", "xyz", "x"], seed)
        readings[:, 1] *= 0.1
        readings[:, 3, 1:] = np.nan
        estimator = AccelerationFieldEstimator(PARAMS.replace(sample_rate=500.0), sensors)
        rows = estimator.run(motion.stamp, readings)
        assert np.abs(rows["omega"] - motion.omega).max() < 60.0
        assert any("accelerometer '1' contradicts" in text for text in estimator.remarks())


def test_scales_that_are_off_are_in_what_is_stated_or_told(impact):
    off = np.random.default_rng(0).standard_normal((1, 4, 3))
    for sd, told in ((0.01, False), (0.06, True)):
        _, remarks, nees, _ = judged(impact, felt(impact) * (1.0 + sd * off))
        assert any("scales that are off" in text for text in remarks) is told
        assert told or (remarks == [] and nees < 6)


def test_gyroscope_biases_beyond_their_sds_are_told(impact):
    rate = impact.omega + np.random.default_rng(0).normal(0.0, 0.02, impact.omega.shape)
    for bias, told in ((0.0, False), (0.3, True)):
        estimator = AccelerationFieldEstimator(PARAMS.replace(use_gyro=True), layout())
        estimator.run(impact.stamp, felt(impact), rate + [bias, 0.0, 0.0])
        assert any("gyro_bias_sd" in text for text in estimator.remarks()) is told


@pytest.mark.parametrize("mode", ["causal", "smoothed"])
def test_one_axis_that_stands_still_is_left_out(impact, mode):
    readings = felt(impact)
    readings[200:, 1, 2] = readings[200, 1, 2]
    rows, remarks, nees, error = judged(impact, readings, mode=mode)
    (remark,) = remarks
    assert "'left'" in remark and "(z)" in remark and "stuck" in remark
    assert np.all(rows["flags"][250:] & LEFT_OUT > 0) and nees < 6 and error < 0.05


@pytest.mark.parametrize("channels, found", [
    ([5], True), ([3, 4, 5], True), ([2, 9], True), ([2, 5, 8, 11], False), (range(12), False)])
@pytest.mark.parametrize("begin, late", [(500, 20), (0, 200)])
def test_few_axes_that_stand_still_are_judged_and_many_are_not(channels, found, begin, late):
    # Without noise, z of all sensors stands still where a body turns about z alone.
    array = make_sensor_array(list(layout().values()))
    readings = np.random.default_rng(0).standard_normal((1000, len(array.channels)))
    readings[begin:, channels] = readings[begin, channels]
    standing = StandingAxes(PARAMS, array)
    marked = np.concatenate([standing.mark(part.copy()) for part in np.array_split(readings, 7)])
    out = np.zeros(readings.shape, bool)
    out[begin + late:, channels] = found
    assert np.array_equal(np.isneginf(marked), out)
    assert bool(standing.texts([*NAMES])) is found


@pytest.mark.parametrize("jitter", ["own", "common"])
def test_jitter_that_no_stamp_tells_is_noticed(impact, jitter):
    random = np.random.default_rng(3)
    readings, t = felt(impact), impact.t
    for k in range(4):
        if k == 0 or jitter == "own":
            at = np.clip(t + random.normal(0, 2e-3, len(t)), 0, t[-1])
        readings[:, k] = np.column_stack([np.interp(at, t, readings[:, k, i]) for i in range(3)])
    _, remarks, nees, _ = judged(impact, readings)
    assert any("jitter" in text for text in remarks) and nees < 9


def test_what_does_not_tell_the_angular_velocity_is_refused():
    random = np.random.default_rng(1)
    sensors = [AccelerometerParams(position=tuple(random.uniform(-0.1, 0.1, 3)),
                                   measured_axes=(axis,)) for axis in "xyzxyz"]
    with pytest.raises(LayoutError, match="angular velocity.*use_gyro|condition"):
        AccelerationFieldEstimator(PARAMS, sensors)
    AccelerationFieldEstimator(PARAMS.replace(use_gyro=True, max_condition=1e4), sensors)


@pytest.mark.parametrize("step", [0.5, 1.0, 4.0])
def test_coarse_sensors_that_come_to_rest_are_not_taken_for_dead(impact, step):
    # Of steps that are wider than the noise, some axes stand still at rest while others do not.
    random = np.random.default_rng(0)
    readings = np.concatenate([felt(impact), np.tile(felt(impact)[-1], (2000, 1, 1))])
    readings[len(impact.t):] += random.normal(0.0, NOISE, (2000, 4, 3))
    standing = StandingAxes(PARAMS, make_sensor_array(list(layout().values())))
    marked = standing.mark(np.round(readings / step).reshape(-1, 12) * step)
    assert np.isfinite(marked).all()


def test_a_dead_sensor_does_not_spoil_the_start():
    readings = np.tile(np.einsum("kij,j->ki", PAPER_AXES, [0, 0, 9.80665]), (600, 1, 1))
    readings += np.random.default_rng(0).normal(0, 0.03, readings.shape)
    readings[:, 1] = 0.0
    rows = AccelerationFieldEstimator(AccelerationFieldParams(), layout()).run(
        np.arange(600) * 1_000_000, readings)
    tilt = 2 * np.linalg.norm(rows["quat"][0, :2])
    sd = np.sqrt(np.trace(rows["cov_attitude"][0]))
    assert tilt < 3 * sd < 0.15
    assert np.abs(rows["specific_force"][-1] - [0, 0, 9.80665]).max() < 1.0


def test_the_papers_method_says_what_it_leaves_out(impact):
    exact = layout(position_sd=0.0, axes_sd=0.0, scale_sd=0.0)
    for accelerometers, said in ((layout(), True), (exact, False)):
        estimator = AccelerationFieldEstimator(PARAMS.replace(method="ao"), accelerometers)
        assert bool(estimator.remarks()) is said


def test_a_bias_far_beyond_its_sd_is_named(impact):
    readings = felt(impact)
    assert judged(impact, readings)[1] == []
    readings[:, 1, 0] += 2.0
    assert any("'left' fits best with biases of (1." in text and "left.bias_sd" in text
               for text in judged(impact, readings)[1])


@pytest.mark.parametrize("seed", [8, 17])    # of twenty, those whose biases get the least far
def test_biases_that_drift_are_named(impact, seed):
    t = np.linspace(0.0, 1.0, len(impact.stamp))[:, None, None]
    end = np.random.default_rng(seed).choice([-1.0, 1.0], (1, 4, 3))
    remarks = judged(impact, felt(impact) + 0.8 * t * end)[1]
    assert any("biases" in text and "bias_walk" in text for text in remarks), remarks


@pytest.mark.parametrize("scale, turn, said", [(1.0, 0.0, None), (1.1, 0.0, "gyro_scale_sd"),
                                               (1.0, 20.0, "gyro_axes_sd")])
def test_a_gyroscope_whose_scale_or_axes_are_off_is_named(impact, scale, turn, said):
    axes = Rotation.from_rotvec(np.radians(turn) * np.array([0.6, 0.8, 0.0])).as_matrix()
    gyr = scale * impact.omega @ axes.T
    gyr = gyr + np.random.default_rng(1).normal(0.0, 0.02, gyr.shape)
    estimator = AccelerationFieldEstimator(PARAMS.replace(
        **{"use_gyro": True, "sensor.gyro_noise_density": 0.02 / 1000 ** 0.5}), layout())
    estimator.run(impact.stamp, felt(impact), gyr)
    remarks = [text for text in estimator.remarks() if "gyroscope fits best with" in text]
    assert bool(remarks) == bool(said)
    assert all(said in text for text in remarks)
    if scale != 1.0:
        found = [float(v) for v in re.findall(r"[\d.]+", remarks[0].split("(")[1].split(")")[0])]
        assert found == pytest.approx([10.0] * 3, abs=1.0)


@pytest.mark.parametrize("speed, axis, use_gyro", [
    (0.6, (1.0, 0.0, 0.0), False), (1.7, (1.0, 2.0, 3.0), False), (1.7, (0.0, 0.0, 1.0), True),
    (0.6, (0.0, 0.0, 1.0), True), (5.0, (0.0, 0.0, 1.0), True)])
def test_a_body_that_turns_steadily_from_the_first_sample_on_is_not_still(speed, axis, use_gyro):
    axis = np.array(axis) / np.linalg.norm(axis)
    t = np.arange(2000) * 1e-3
    random = np.random.default_rng(2)
    up = Rotation.from_rotvec(-np.outer(speed * t, axis)).apply([0.0, 0.0, 9.8])
    omega = np.tile(speed * axis, (len(t), 1))
    force = up[:, None] + np.cross(omega[0], np.cross(omega[0], PAPER_POSITIONS - CENTRE))
    readings = np.einsum("kij,nkj->nki", PAPER_AXES, force) + random.normal(0.0, NOISE,
                                                                            (len(t), 4, 3))
    params = PARAMS.replace(initial=Initial(), use_gyro=use_gyro, **(
        {"sensor.gyro_noise_density": 0.02 / 1000 ** 0.5} if use_gyro else {}))
    gyr = omega + random.normal(0.0, 0.02, omega.shape) if use_gyro else None
    with pytest.raises(EstimationError, match="never still"):
        AccelerationFieldEstimator(params, layout()).run((t * 1e9).astype(np.int64), readings, gyr)


def test_what_is_not_gravity_is_no_rest():
    """A body in free fall feels nothing, however steadily."""
    readings = np.random.default_rng(3).normal(0.0, NOISE, (1000, 4, 3))
    with pytest.raises(EstimationError, match="not gravity"):
        AccelerationFieldEstimator(PARAMS.replace(initial=Initial()), layout()).run(
            np.arange(1000) * 1_000_000, readings)


@pytest.mark.parametrize("speed, tumbles, said", [
    (1.7, False, r"do not tell rest, .* about the vertical by up to [23]"),
    (0.0, False, r"do not tell rest"), (0.0, True, None),
    (1.7, True, r"turned by some [12].* rad/s about the vertical where it was taken for still"),
    (-1.7, True, r"turned by some [123].* rad/s about the vertical where it was taken for still")])
def test_rest_and_a_steady_turn_about_the_vertical_are_told_apart_by_a_later_motion(speed, tumbles,
                                                                                    said):
    t = np.arange(1500) * 1e-3
    moving = tumbles * np.clip((t - 0.7) / 0.1, 0.0, 1.0)[:, None]
    rate = 8.0 * moving * np.sin(np.outer(t - 0.7, [9.0, 14.0, 11.0]) + [0.3, 0.0, 0.5])
    rate[:, 2] += speed
    quat, up = Rotation.identity(), np.empty((len(t), 3))
    for n in range(len(t)):
        up[n] = quat.inv().apply([0.0, 0.0, 9.8])
        quat = quat * Rotation.from_rotvec(1e-3 * rate[n])
    alpha = np.gradient(rate, 1e-3, axis=0)[:, None]
    places = PAPER_POSITIONS - CENTRE
    field = up[:, None] + np.cross(alpha, places) + np.cross(
        rate[:, None], np.cross(rate[:, None], places))
    random = np.random.default_rng(1)
    turned = PAPER_AXES @ Rotation.from_rotvec(0.035 * random.standard_normal((4, 3))).as_matrix()
    readings = np.einsum("kij,nkj->nki", turned, field)
    readings += random.normal(0, 0.1, (1, 4, 3)) + random.normal(0, NOISE, readings.shape)
    estimator = AccelerationFieldEstimator(AccelerationFieldParams(gravity=9.8), layout())
    rows = estimator.run(np.round(t * 1e9).astype(np.int64), readings)
    remarks = estimator.remarks()
    # What is said widens what is stated; once motion has told of rest, nothing does.
    off = np.abs(rate - rows["omega"])[:700]
    sd = np.sqrt(np.einsum("nii->ni", rows["cov_omega"]))
    assert np.all(off <= 3.0 * sd[:700])
    assert sd[600, 2] > 1.0 and sd[600, :2].max() < 0.2
    assert not (tumbles and speed == 0.0) or sd[-1].max() < 0.2
    if said is None:
        assert remarks == []
    else:
        assert any(re.search(said, text) for text in remarks), remarks


def test_a_given_rate_that_is_wrong_is_named_with_its_error(impact):
    initial = PARAMS.initial.replace(angular_velocity=(5.0, 4.0, 5.0))
    remarks = judged(impact, felt(impact), initial=initial)[1]
    (text,) = [text for text in remarks if "initial.angular_velocity" in text]
    off = [float(value) for value in re.search(r"\((.*)\) rad/s more", text)[1].split(",")]
    assert off == pytest.approx([0.0, 1.0, 0.0], abs=0.3)
    assert judged(impact, felt(impact))[1] == []
