"""Methods of the acceleration field against exact motions; interface of the estimator."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.errors import EstimationError, LayoutError, SampleError
from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
    Initial,
)
from imu_fusion.estimation.acceleration_field.rows import GAP, HELD, MISSING, SATURATED, field_at
from imu_fusion.estimation.acceleration_field.sensor_array import (
    make_sensor_array,
)
from imu_fusion.simulation.rigid_body_impact import (
    PAPER_AXES,
    PAPER_PARTICLE,
    PAPER_POSITIONS,
    ImpactScene,
    simulate,
)

GIVEN = AccelerationFieldParams(
    initial=Initial(mode="given", angular_velocity=(5.0, 5.0, 5.0), angular_velocity_sd=1e-6),
    gravity=9.8)
EXACT = {"position_sd": 0.0, "axes_sd": 0.0, "scale_sd": 0.0}
METHODS = [{"method": "ao"}, {"method": "sqrt_ao"}, {"method": "rigid_body"},
           {"method": "rigid_body", "mode": "smoothed"}]


def sensors(positions=PAPER_POSITIONS, axes=PAPER_AXES, **common):
    common = {"noise_density": 1e-6, "bias_sd": 0.0, **EXACT, **common}
    return [AccelerometerParams(position=tuple(p), axes=tuple(np.ravel(a)), **common)
            for p, a in zip(positions, axes)]


@pytest.fixture(scope="module")
def motion():
    return simulate(duration=1.0)


def errors(motion, rows, point=PAPER_PARTICLE):
    """eq. (4.2), x1e-3, with the square that the print misses."""
    truth = motion.acceleration_world(point)
    error = field_at(rows, point, motion.gravity)[2][:, 0] - truth
    return (1e3 * np.linalg.norm(error) / np.linalg.norm(truth),
            1e3 * np.linalg.norm(error, axis=1).max() / np.linalg.norm(truth, axis=1).max())


# Issue 4, must show 2: the limits without noise.
@pytest.mark.parametrize("change, limit", [
    ({"method": "ao"}, 0.1), ({"method": "ao", "integration": "high_order"}, 0.02),
    ({"method": "sqrt_ao", "integration": "high_order"}, 0.02),
    ({"method": "rigid_body"}, 0.02), ({"method": "rigid_body", "mode": "smoothed"}, 0.02)])
@pytest.mark.parametrize("reports", ["specific_force", "acceleration"])
def test_noise_free_field_is_exact(motion, change, limit, reports):
    readings = motion.readings(PAPER_POSITIONS, PAPER_AXES, reports)
    estimator = AccelerationFieldEstimator(GIVEN.replace(**change), sensors(reports=reports))
    rows = estimator.run(motion.stamp, readings)
    assert max(errors(motion, rows)) < limit
    # The trapezoid of the paper: h^2 / 12 times the jump of the jerk, 0.008 rad/s here.
    assert np.abs(rows["omega"] - motion.omega).max() < (
        1e-3 if change.get("integration") or change["method"] == "rigid_body" else 1e-2)
    at_origin = motion.specific_force_body([0, 0, 0])
    assert np.abs(rows["specific_force"] - at_origin).max() < 1e-3 * np.abs(at_origin).max()
    alpha_error = np.abs(rows["alpha"] - motion.alpha).max()
    # The smooth prior of the rigid-body model rounds the onset of contact a little.
    assert alpha_error < (1e-6 if change["method"] != "rigid_body" else 0.5)


def test_magnitude_of_the_field_needs_no_orientation(motion):
    # eq. (2.13): turn the given orientation, and nothing but directions changes.
    readings = motion.readings(PAPER_POSITIONS, PAPER_AXES)
    turned = tuple(Rotation.from_rotvec([0.3, -1.0, 2.0]).as_quat())
    plain, other = (AccelerationFieldEstimator(
        GIVEN.replace(**{"method": "ao", "initial.orientation": q}), sensors()).run(
            motion.stamp, readings)
        for q in ((0, 0, 0, 1), turned))
    assert np.array_equal(plain["specific_force"], other["specific_force"])
    force = field_at(plain, PAPER_PARTICLE, 9.8)[0][:, 0]
    assert np.allclose(np.linalg.norm(force, axis=1), np.linalg.norm(
        motion.specific_force_body(PAPER_PARTICLE), axis=1), rtol=1e-9, atol=1e-9)


def test_gradient_worked_by_hand():
    # Body turning at 2 rad/s about z with 3 rad/s^2, its origin accelerating by (1, 0, 0):
    # at (x, y, z) the acceleration is (1 - 4 x - 3 y, 3 x - 4 y, 0).
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    readings = np.array([[1, 0, 0], [-3, 3, 0], [-2, -4, 0], [1, 0, 0.0]])
    params = GIVEN.replace(**{"method": "ao", "initial.angular_velocity": (0.0, 0.0, 2.0)})
    row = AccelerationFieldEstimator(params, sensors(positions, [np.eye(3)] * 4,
                                                     reports="acceleration")).add(0, readings)[0]
    assert np.allclose(row["gradient"], [[-4, -3, 0], [3, -4, 0], [0, 0, 0]], atol=1e-12)
    assert np.allclose(row["alpha"], [0, 0, 3], atol=1e-12)
    assert np.allclose(row["acceleration_world"], [1, 0, 0], atol=1e-12)
    assert np.allclose(row["specific_force"], [1, 0, 9.8], atol=1e-12)


def _some_axes(positions, measured, axes=None):
    axes = [np.eye(3)] * len(positions) if axes is None else axes
    return [AccelerometerParams(position=tuple(p), axes=tuple(np.ravel(a)), measured_axes=m,
                                noise_density=1e-6, bias_sd=0.0, **EXACT)
            for p, m, a in zip(positions, measured, axes)]


def _nine_accelerometer_package(arm, **common):
    """Padgaonkar et al. 1975: three axes at the centre, two across each of three arms (m)."""
    sensors = [AccelerometerParams(position=(0.0, 0.0, 0.0), **common)]
    for axis in range(3):
        across = tuple(name for i, name in enumerate("xyz") if i != axis)
        sensors.append(AccelerometerParams(position=tuple(arm * np.eye(3)[axis]),
                                           measured_axes=across, **common))
    return sensors


def _layouts():
    random = np.random.default_rng(5)
    spread = random.uniform(-0.1, 0.1, (12, 3))
    turned = Rotation.random(12, random_state=1).as_matrix()
    return {
        "seven tri-axial, own axes": _some_axes(spread[:7], [("x", "y", "z")] * 7, turned),
        "six bi-axial": _some_axes(spread[:6], [("x", "y"), ("y", "z"), ("x", "z")] * 2, turned),
        "twelve uni-axial": _some_axes(spread, [("x",)] * 12, turned),
        "nine-accelerometer package": _nine_accelerometer_package(
            0.1, noise_density=1e-6, bias_sd=0.0, **EXACT),
    }


@pytest.mark.parametrize("name", list(_layouts()))
@pytest.mark.parametrize("method", ["ao", "rigid_body"])
def test_other_layouts(motion, name, method):
    layout = _layouts()[name]
    positions = np.array([s.position for s in layout])
    axes = np.array([s.axes for s in layout]).reshape(-1, 3, 3)
    readings = motion.readings(positions, axes)
    for k, sensor in enumerate(layout):
        for axis, letter in enumerate("xyz"):
            if letter not in sensor.measured_axes:
                readings[:, k, axis] = np.nan
    params = GIVEN.replace(method=method, max_condition=1e4)
    if method == "ao":
        params = params.replace(integration="high_order")
    rows = AccelerationFieldEstimator(params, layout).run(motion.stamp, readings)
    assert max(errors(motion, rows, [0.02, 0.01, 0.03])) < 0.1
    assert np.all(rows["flags"] == 0)


def test_three_coplanar_accelerometers_suffice_for_the_rigid_model(motion):
    positions = [[0.1, 0, 0.7], [0, 0.1, 0.7], [-0.1, -0.1, 0.7]]
    layout = sensors(positions, PAPER_AXES[:3])
    with pytest.raises(LayoutError, match="coplanar.*rigid_body"):
        AccelerationFieldEstimator(GIVEN.replace(method="ao"), layout)
    rows = AccelerationFieldEstimator(GIVEN, layout).run(
        motion.stamp, motion.readings(positions, PAPER_AXES[:3]))
    assert max(errors(motion, rows)) < 0.1


@pytest.mark.parametrize("positions, method, word", [
    ([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]], "rigid_body", "collinear"),
    ([[1, 1, 1]] * 4, "rigid_body", "coincide"),
    ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], "ao", "coplanar"),
    ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1e-5]], "sqrt_ao", "condition number")])
def test_degenerate_layouts_are_refused(positions, method, word):
    layout = sensors(positions, [np.eye(3)] * 4)
    with pytest.raises(LayoutError, match=word):
        AccelerationFieldEstimator(GIVEN.replace(method=method), layout)


def test_bad_sensors_are_refused():
    with pytest.raises(LayoutError, match="not orthonormal"):
        make_sensor_array([AccelerometerParams(axes=(1, 0, 0, 0.1, 1, 0, 0, 0, 1))])
    with pytest.raises(LayoutError, match="specific force"):
        make_sensor_array([AccelerometerParams(), AccelerometerParams(reports="acceleration")])
    with pytest.raises(LayoutError, match="twice"):
        make_sensor_array([AccelerometerParams(measured_axes=("x", "x"))])
    with pytest.raises(LayoutError, match="accelerometers.names"):
        make_sensor_array([])


@pytest.mark.parametrize("change", METHODS, ids=lambda c: "-".join(c.values()))
def test_live_batch_and_interrupted_runs_agree_bit_for_bit(motion, change):
    readings = motion.readings(PAPER_POSITIONS, PAPER_AXES)[:300]
    readings += np.random.default_rng(0).normal(0, 0.3, readings.shape)
    readings[40, 2] = np.nan
    stamp = motion.stamp[:300]
    params = GIVEN.replace(**change)

    def make():
        return AccelerationFieldEstimator(params, sensors(noise_density=1e-2, bias_sd=0.1))

    batch = make().run(stamp, readings)
    live = make()
    rows = [live.add(s, r) for s, r in zip(stamp[:120], readings[:120])]
    resumed = make()
    resumed.set_state(live.get_state())
    live.add(stamp[120], readings[120])  # must not disturb the saved state
    rows += [resumed.add(s, r) for s, r in zip(stamp[120:], readings[120:])]
    rows = np.concatenate([*rows, resumed.finish()])
    assert rows.tobytes() == batch.tobytes()
    assert len(batch) == 300


@pytest.mark.parametrize("change", METHODS, ids=lambda c: "-".join(c.values()))
def test_missing_and_saturated_channels_are_left_out(motion, change):
    positions = np.vstack([PAPER_POSITIONS, [[0.0, -0.1, 0.7], [0.05, 0.05, 0.66]]])
    axes = np.concatenate([PAPER_AXES, [np.eye(3)] * 2])
    readings = motion.readings(positions, axes)
    clean = AccelerationFieldEstimator(GIVEN.replace(**change), sensors(positions, axes)).run(
        motion.stamp, readings)
    readings[100:110, 4] = np.nan
    limit = 0.9 * np.abs(readings[:, 5]).max()
    clipped = np.any(np.abs(readings[:, 5]) >= limit, axis=1)
    readings[:, 5] = np.clip(readings[:, 5], -limit, limit)
    layout = sensors(positions, axes)
    layout[5] = layout[5].replace(range=(limit,))
    rows = AccelerationFieldEstimator(GIVEN.replace(**change), layout).run(motion.stamp, readings)
    assert np.array_equal(rows["flags"] & SATURATED > 0, clipped)
    assert np.array_equal(np.flatnonzero(rows["flags"] & MISSING), np.arange(100, 110))
    # Exact readings remain: what is left determines the same field.
    assert np.abs(rows["specific_force"] - clean["specific_force"]).max() < 0.02


@pytest.mark.parametrize("method", ["ao", "rigid_body"])
def test_all_channels_lost(motion, method):
    readings = motion.readings(PAPER_POSITIONS, PAPER_AXES)
    readings[200:205] = np.nan
    rows = AccelerationFieldEstimator(GIVEN.replace(method=method), sensors()).run(
        motion.stamp, readings)
    assert np.array_equal(np.flatnonzero(rows["flags"] & HELD), np.arange(200, 205))
    assert np.all(np.isfinite(rows["acceleration_world"]))
    assert np.all(np.isnan(rows["residual_rms"][200:205]))
    if method == "rigid_body":
        assert rows["cov_omega"][204, 0, 0] > 10 * rows["cov_omega"][199, 0, 0]
        assert np.abs(rows["omega"][250] - motion.omega[250]).max() < 1e-3


@pytest.mark.parametrize("change", METHODS, ids=lambda c: "-".join(c.values()))
def test_gaps_are_flagged(motion, change):
    keep = np.r_[0:100, 250:400]
    rows = AccelerationFieldEstimator(GIVEN.replace(**change), sensors()).run(
        motion.stamp[keep], motion.readings(PAPER_POSITIONS, PAPER_AXES)[keep])
    assert np.flatnonzero(rows["flags"] & GAP).tolist() == [100]


@pytest.mark.parametrize("change", METHODS, ids=lambda c: "-".join(c.values()))
@pytest.mark.parametrize("seconds", [2, 3600])
def test_after_a_long_gap_the_field_is_found_again(motion, change, seconds):
    keep = np.r_[0:100, 250:400]
    stamp = motion.stamp[keep] + np.where(keep > 200, seconds * 10**9, 0)
    rows = AccelerationFieldEstimator(GIVEN.replace(**change), sensors()).run(
        stamp, motion.readings(PAPER_POSITIONS, PAPER_AXES)[keep])
    for name in rows.dtype.names:
        if name != "residual_rms":
            assert np.all(np.isfinite(rows[name])), name
    # The fit of the readings knows nothing of the gap; alpha and the force do not depend on omega
    # but by the smooth model.
    assert np.abs(rows["alpha"] - motion.alpha[keep])[-50:].max() < 0.5


def test_time_going_backwards_and_wrong_shapes_are_refused(motion):
    estimator = AccelerationFieldEstimator(GIVEN, sensors())
    readings = motion.readings(PAPER_POSITIONS, PAPER_AXES)[:3]
    estimator.add(2000, readings[0])
    with pytest.raises(SampleError, match="1000 ns is not later than 2000"):
        estimator.add(1000, readings[1])
    with pytest.raises(SampleError, match="not later"):
        estimator.add(2000, readings[1])
    with pytest.raises(SampleError, match="expected \\(1, 4, 3\\)"):
        estimator.add(3000, readings[1, :3])
    assert len(estimator.add(3000, readings[1])) == 1


def test_rest_finds_tilt_and_biases(motion):
    random = np.random.default_rng(3)
    tilt = Rotation.from_euler("xyz", [20, -35, 0], degrees=True)
    felt = tilt.inv().apply([0, 0, 9.80665])
    bias = random.normal(0, 0.2, (4, 3))
    readings = np.einsum("kij,j->ki", PAPER_AXES, felt) + bias
    readings = readings + random.normal(0, 0.03, (800, 4, 3))
    stamp = np.arange(800) * 1_000_000
    params = AccelerationFieldParams()
    layout = sensors(noise_density=1e-3, bias_sd=0.2)
    rows = AccelerationFieldEstimator(params, layout).run(stamp, readings)
    assert np.array_equal(rows["stamp"], stamp)  # late, but all of them
    found = Rotation.from_quat(rows["quat"])
    up = found.inv().apply([0, 0, 1.0])
    # The mean bias of the four cannot be told from tilt: 0.2 / sqrt(4) / g = 10 mrad per axis.
    common = np.einsum("kij,ki->j", PAPER_AXES, bias) / 4
    angle = np.linalg.norm(np.cross(up, felt / np.linalg.norm(felt)), axis=1)
    assert angle[0] == pytest.approx(np.linalg.norm(np.cross(
        (felt + common) / np.linalg.norm(felt + common), felt / np.linalg.norm(felt))), abs=1e-3)
    assert np.abs(rows["omega"][-1]).max() < 0.05
    sd = np.sqrt(np.diagonal(rows["cov_acceleration_world"][-1]))
    assert np.all(np.abs(rows["acceleration_world"][-1]) < 4 * sd) and sd.max() < 0.5
    variance = np.linalg.eigvalsh(rows["cov_attitude"][0])
    assert abs(variance[0]) < 1e-12  # the heading is given
    assert np.sqrt(variance[1:]) == pytest.approx([0.0102, 0.0102], rel=0.05)


def test_strong_noise_does_not_hide_that_a_body_turns():
    # 1.7 rad/s about a level axis, then still: noise of 2 m/s^2 is more than what that changes.
    t = np.arange(800) / 62.5
    angle = 1.7 * np.minimum(t, 6.0)
    felt = 9.80665 * np.column_stack([0.0 * t, np.sin(angle), np.cos(angle)])
    readings = np.einsum("kij,nj->nki", PAPER_AXES, felt)
    readings += np.random.default_rng(0).normal(0.0, 2.0, readings.shape)
    params = AccelerationFieldParams(sample_rate=62.5, initial=Initial(duration=2.0))
    rows = AccelerationFieldEstimator(params, sensors(noise_density=2.0 / 62.5 ** 0.5)).run(
        np.round(t * 1e9).astype(np.int64), readings)
    assert 5.0 < rows["stamp"][0] * 1e-9 < 7.0


def test_rest_waits_until_the_body_is_still(motion):
    readings = np.tile(np.einsum("kij,j->ki", PAPER_AXES, [0, 0, 9.80665]), (1000, 1, 1))
    readings[:300] += 5 * np.sin(np.arange(300) / 9)[:, None, None]
    stamp = np.arange(1000) * 1_000_000
    rows = AccelerationFieldEstimator(AccelerationFieldParams(), sensors()).run(stamp, readings)
    # Still from 0.3 s on; windows of 0.5 s move on by a quarter.
    assert 300 <= rows["stamp"][0] / 1e6 < 430
    with pytest.raises(EstimationError, match="never still"):
        AccelerationFieldEstimator(AccelerationFieldParams(), sensors()).run(
            motion.stamp, motion.readings(PAPER_POSITIONS, PAPER_AXES))


def test_sphere_scene_keeps_a_constant_rate_forever():
    # A torque-free sphere turns steadily: an hour of orientation within the noise-free limits.
    scene = ImpactScene(semi_axes=(0.1, 0.1, 0.1), ground=-1e9, omega=(0.0, 0.0, 3.0),
                        velocity=(0, 0, 0))
    motion = simulate(scene, duration=2.0)
    params = GIVEN.replace(**{"method": "ao", "initial.angular_velocity": (0.0, 0.0, 3.0)})
    rows = AccelerationFieldEstimator(params, sensors()).run(
        motion.stamp, motion.readings(PAPER_POSITIONS, PAPER_AXES))
    angle = Rotation.from_quat(rows["quat"]).as_rotvec()
    assert np.allclose(angle[:1000, 2], 3.0 * motion.t[:1000], atol=1e-9)
