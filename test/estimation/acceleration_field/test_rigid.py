"""The rigid-body filter and smoother: against dense algebra, and their uncertainty."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.maximum_likelihood import (
    fit_densities,
    log_likelihood,
)
from imu_fusion.estimation.acceleration_field.motion_model import motion_step
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
    Initial,
    Motion,
)
from imu_fusion.estimation.acceleration_field.rigid_body_filter import RigidBodyFilter
from imu_fusion.estimation.acceleration_field.rigid_body_smoother import smooth_once
from imu_fusion.estimation.acceleration_field.rows import SATURATED, field_at
from imu_fusion.estimation.acceleration_field.start import given_start
from imu_fusion.simulation.noise import ornstein_uhlenbeck
from imu_fusion.simulation.rigid_body_impact import (
    PAPER_AXES,
    PAPER_PARTICLE,
    PAPER_POSITIONS,
    simulate,
)
from imu_fusion.simulation.rigid_body_motion import draw_motion, ideal_readings

RATE, SD_ALPHA = 50.0, 100.0
# A Matern process of that rate and standard deviation of the angular acceleration.
PARAMS = AccelerationFieldParams(
    initial=Initial(mode="given", angular_velocity=(5.0, 5.0, 5.0), angular_velocity_sd=0.1,
                    orientation_sd=0.002),
    motion=Motion(rate=RATE, jerk_density=2 * SD_ALPHA * RATE ** 1.5,
                  acceleration_rate_density=300.0))
# For impacts: less is known of what comes, and the start is exact.
IMPACT = PARAMS.replace(
    initial=PARAMS.initial.replace(angular_velocity_sd=1e-6),
    motion=Motion(rate=0.0, jerk_density=5e4, acceleration_rate_density=3e3), gravity=9.8)


def sensors(noise_density=1e-2, bias_sd=0.3, reports="specific_force", bias_walk=0.0,
            position_sd=0.0, axes_sd=0.0, scale_sd=0.0):
    return [AccelerometerParams(position=tuple(p), axes=tuple(a.ravel()), reports=reports,
                                noise_density=noise_density, bias_sd=bias_sd, bias_walk=bias_walk,
                                position_sd=position_sd, axes_sd=axes_sd, scale_sd=scale_sd)
            for p, a in zip(PAPER_POSITIONS, PAPER_AXES)]


@pytest.mark.parametrize("rate, dt", [(0.0, 1e-3), (40.0, 1e-3), (300.0, 0.016), (300.0, 0.5)])
def test_motion_step_is_the_exact_discretisation(rate, dt):
    # Van Loan 1978: transition and covariance from one matrix exponential.
    a = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0, 0, -rate ** 2, -2 * rate]])
    block = np.zeros((8, 8))
    block[:4, :4], block[4:, 4:], block[3, 7] = -a, a.T, 1.0
    big = expm(block * dt)
    step, noise = motion_step(dt, rate)
    assert np.allclose(step, big[4:, 4:].T, rtol=1e-10, atol=1e-13)
    if rate * dt < 10:  # beyond, the exponential of -a overwhelms Van Loan's digits
        assert np.allclose(noise, big[4:, 4:].T @ big[:4, 4:], rtol=1e-6, atol=1e-18)
    if rate > 0 and rate * dt > 100:  # stationary Matern process
        assert noise[2, 2] == pytest.approx(1 / (4 * rate ** 3))
        assert noise[3, 3] == pytest.approx(1 / (4 * rate))


def test_smoother_equals_dense_least_squares():
    """Few samples, linearised at fixed rates: the posterior by dense algebra is the oracle."""
    random = np.random.default_rng(4)
    estimator = AccelerationFieldEstimator(PARAMS, sensors(bias_walk=0.5))
    array, samples, h = estimator.array, 5, 1e-3
    start = given_start(PARAMS, array)
    stamp = np.arange(samples, dtype=np.int64) * 1_000_000
    xs, _ = draw_motion(PARAMS, start, samples, random)
    readings = ideal_readings(array, xs) + random.normal(0, 0.3, (samples, 12))
    readings[2, 5] = np.nan
    at = xs[:, 3:6] + random.normal(0, 0.1, (samples, 3))
    where = np.zeros((samples, 30))    # all else of the model is linear
    where[:, 3:6] = at
    mean, cov, used, _ = smooth_once(PARAMS, array, start, stamp, readings, where)
    assert np.array_equal(used, np.isfinite(readings))
    # Dense: unknowns are omega .. biases of all samples (27 each); theta is not measured.
    size = 27
    step, noise = motion_step(h, RATE)
    f = np.eye(size)
    q = np.zeros((size, size))
    for i in range(3):
        own = [i, 3 + i, 6 + i]
        f[np.ix_(own, own)] = step[1:, 1:]
        q[np.ix_(own, own)] = PARAMS.motion.jerk_density ** 2 * noise[1:, 1:]
        own = [9 + i, 12 + i]
        f[9 + i, 12 + i] = h
        q[np.ix_(own, own)] = 300.0 ** 2 * np.array([[h ** 3 / 3, h ** 2 / 2], [h ** 2 / 2, h]])
    q[15:, 15:] = np.eye(12) * 0.25 * h
    prior = np.zeros((samples * size,) * 2)
    center = np.zeros(samples * size)
    blocks = [start[1][3:, 3:]]
    center[:size] = start[0][3:]
    for n in range(1, samples):
        blocks.append(f @ blocks[-1] @ f.T + q)
        center[n * size:(n + 1) * size] = f @ center[(n - 1) * size:n * size]
    for n in range(samples):
        for k in range(n, samples):
            c = np.linalg.matrix_power(f, k - n) @ blocks[n]
            prior[k * size:(k + 1) * size, n * size:(n + 1) * size] = c
            prior[n * size:(n + 1) * size, k * size:(k + 1) * size] = c.T
    rows, target = [], []
    for n in range(samples):
        for c in range(12):
            if np.isnan(readings[n, c]):
                continue
            u, r, w = *(array.channels[s][c] for s in ("direction", "lever")), at[n]
            row = np.zeros(samples * size)
            part = row[n * size:(n + 1) * size]
            gradient = u * (r @ w) + r * (u @ w) - 2 * (u @ r) * w
            part[0:3], part[3:6], part[9:12] = gradient, np.cross(r, u), u
            part[15 + c] = 1
            rows.append(row)
            target.append(readings[n, c] - u @ np.cross(w, np.cross(w, r)) + gradient @ w)
    rows, target = np.array(rows), np.array(target)
    total = rows @ prior @ rows.T + np.eye(len(rows)) * 1e-4 * 1000
    gain = np.linalg.solve(total, rows @ prior).T
    expected = (center + gain @ (target - rows @ center)).reshape(samples, size)
    spread = prior - gain @ rows @ prior
    for n in range(samples):
        exact = spread[n * size:(n + 1) * size, n * size:(n + 1) * size][:15, :15]
        sd = np.sqrt(np.diag(exact))
        # Different algebra of matrices with condition numbers about 1e10.
        assert np.all(np.abs(mean[n, 3:18] - expected[n, :15]) < 1e-6 * sd)
        assert np.abs((cov[n, 3:, 3:] - exact) / np.outer(sd, sd)).max() < 1e-6


def _normalised_errors(params, realisations, samples, seed, **mounting):
    random = np.random.default_rng(seed)
    total = []
    for _ in range(realisations):
        estimator = AccelerationFieldEstimator(params, sensors(**mounting))
        array = estimator.array
        xs, quats = draw_motion(params, given_start(params, array), samples, random)
        readings = ideal_readings(array, xs) + random.normal(0, 1e-2 * 1000 ** 0.5,
                                                              (samples, 12))
        row = estimator.run(np.arange(samples) * 1_000_000,
                            readings.reshape(-1, 4, 3))[samples // 2]
        w, alpha, a = xs[samples // 2, 3:6], xs[samples // 2, 6:9], xs[samples // 2, 12:15]
        force = a - np.cross(alpha, array.reference) - np.cross(w, np.cross(w, array.reference))
        turn = Rotation.from_quat(quats[samples // 2])
        errors = {"cov_attitude": (Rotation.from_quat(row["quat"]).inv() * turn).as_rotvec(),
                  "cov_omega": w - row["omega"], "cov_alpha": alpha - row["alpha"],
                  "cov_specific_force": force - row["specific_force"],
                  "cov_acceleration_world": turn.apply(force) - [0, 0, params.gravity]
                  - row["acceleration_world"]}
        total.append([e @ np.linalg.solve(row[name], e) for name, e in errors.items()])
    return np.mean(total, axis=0)


@pytest.mark.parametrize("mode", ["causal", "smoothed"])
@pytest.mark.parametrize("mounting", [{}, {"position_sd": 1e-3, "axes_sd": 0.035,
                                           "scale_sd": 0.01}])
def test_uncertainty_is_honest(mode, mounting):
    realisations = 60
    params = PARAMS.replace(mode=mode)
    if mounting:
        # Accelerations of 400 m/s^2 from the first sample on would make 2 deg a matter of second
        # order: here they begin with 40.
        params = params.replace(**{"motion.acceleration_rate_density": 30.0, "gravity": 1.0})
    found = _normalised_errors(params, realisations, 60, seed=8, **mounting)
    # 95 % of chi-square, divided among the five quantities (Bonferroni).
    low, high = chi2.ppf([0.005, 0.995], 3 * realisations) / realisations
    assert np.all((low < found) & (found < high)), found


@pytest.fixture(scope="module")
def impact():
    return simulate(duration=1.0)


@pytest.mark.parametrize("mode, limits", [("causal", (10.0, 14.0)), ("smoothed", (5.5, 6.5))])
def test_impact_with_independent_noise(impact, mode, limits):
    # Issue 4, must show 3, row sigma 10, here with few realisations (the benchmark has 100).
    random = np.random.default_rng(1)
    params = IMPACT.replace(**{"mode": mode, "initial.orientation_sd": 0.0,
                               "motion.jerk_density": 4.8e4})
    clean = impact.readings(PAPER_POSITIONS, PAPER_AXES, "acceleration")
    truth = impact.acceleration_world(PAPER_PARTICLE)
    found = []
    for _ in range(8):
        noise = ornstein_uhlenbeck(clean.shape, 1e-3, 1e3, 10.0, random)
        rows = AccelerationFieldEstimator(
            params, sensors(1e-2, 0.0, "acceleration")).run(impact.stamp, clean + noise)
        error = field_at(rows, PAPER_PARTICLE, 9.8)[2][:, 0] - truth
        found.append([np.linalg.norm(error) / np.linalg.norm(truth),
                      np.linalg.norm(error, axis=1).max() / np.linalg.norm(truth, axis=1).max()])
    assert np.all(1e3 * np.mean(found, axis=0) < limits)


def test_biases_are_found_while_turning(impact):
    random = np.random.default_rng(2)
    bias = random.normal(0, 0.5, (4, 3))
    readings = impact.readings(PAPER_POSITIONS, PAPER_AXES, "acceleration") + bias
    readings += random.normal(0, 0.02, readings.shape)
    with_bias, without = (AccelerationFieldEstimator(
        IMPACT, sensors(1e-3, sd, "acceleration")).run(impact.stamp, readings)
        for sd in (0.5, 0.0))
    turn = Rotation.from_quat(impact.quat[-1]).inv()
    angle = [(turn * Rotation.from_quat(rows["quat"][-1])).magnitude()
             for rows in (with_bias, without)]
    assert angle[0] < np.radians(1.0) < angle[1]


def test_clipped_gyroscope_is_filled_in_by_the_accelerometers(impact):
    random = np.random.default_rng(5)
    limit = 10.0
    gyr = impact.omega + random.normal(0, 0.01, impact.omega.shape)
    clipped = np.abs(gyr) >= limit
    readings = impact.readings(PAPER_POSITIONS, PAPER_AXES)
    readings += random.normal(0, 0.3, readings.shape)
    params = IMPACT.replace(**{
        "mode": "smoothed", "initial.angular_velocity_sd": 0.1, "use_gyro": True,
        "sensor.gyro_noise_density": 3e-4, "sensor.gyro_range": (limit,),
        "sensor.gyro_axes_sd": 0.0, "sensor.gyro_scale_sd": 0.0})
    rows = AccelerationFieldEstimator(params, sensors(1e-2, 0.1)).run(
        impact.stamp, readings, np.clip(gyr, -limit, limit))
    assert np.array_equal(rows["flags"] & SATURATED > 0, clipped.any(axis=1))
    error = (rows["omega"] - impact.omega)[clipped]
    sd = np.sqrt(np.einsum("nii->ni", rows["cov_omega"]))[clipped]
    assert clipped.sum() > 500 and np.sqrt(np.mean(error ** 2)) < 0.1
    assert 0.3 < np.sqrt(np.mean((error / sd) ** 2)) < 2


def test_maximum_likelihood_finds_what_made_the_motion():
    random = np.random.default_rng(6)
    estimator = AccelerationFieldEstimator(PARAMS, sensors())
    array = estimator.array
    xs, _ = draw_motion(PARAMS, given_start(PARAMS, array), 600, random)
    readings = ideal_readings(array, xs) + random.normal(0, 1e-2 * 1000 ** 0.5, (600, 12))
    stamp = np.arange(600, dtype=np.int64) * 1_000_000
    wrong = PARAMS.replace(**{
        "mode": "smoothed", "motion.jerk_density": PARAMS.motion.jerk_density / 5,
        "motion.acceleration_rate_density": 1000.0, "noise_scale": 2.0,
        "maximum_likelihood": "motion_and_noise"})

    def make_start(params):
        return given_start(params, array)

    found = fit_densities(wrong, array, make_start, stamp, readings)
    # 600 samples of three axes give densities to about a tenth, the noise to a hundredth; rate
    # and jerk density are strongly correlated.
    assert found.noise_scale == pytest.approx(1.0, rel=0.05)
    assert found.motion.acceleration_rate_density == pytest.approx(300, rel=0.3)
    sd_alpha = found.motion.jerk_density / (2 * found.motion.rate ** 1.5)
    assert sd_alpha == pytest.approx(SD_ALPHA, rel=0.4)
    better = log_likelihood(found, array, make_start(found), stamp, readings)
    assert better >= log_likelihood(PARAMS, array, make_start(PARAMS), stamp, readings) - 1
    with pytest.raises(EstimationError, match="too few"):
        fit_densities(wrong, array, make_start, stamp[:5], readings[:5])


def test_iterations_and_chunks_do_not_change_the_filter(impact):
    # The smoother filters chunk by chunk again from checkpoints: the last smoothed sample is the
    # last filtered one.
    readings = impact.readings(PAPER_POSITIONS, PAPER_AXES)[:600]
    readings = readings + np.random.default_rng(7).normal(0, 0.1, readings.shape)
    once = PARAMS.replace(**{"mode": "smoothed", "iteration.max": 1})
    causal, smoothed = (AccelerationFieldEstimator(params, sensors()).run(
        impact.stamp[:600], readings) for params in (PARAMS, once))
    for name in ("omega", "alpha", "specific_force", "cov_omega"):
        assert np.allclose(smoothed[name][-1], causal[name][-1], rtol=1e-9, atol=1e-12)
    assert np.trace(smoothed["cov_alpha"][300]) < 0.5 * np.trace(causal["cov_alpha"][300])


def test_filter_object_needs_no_estimator():
    estimator = AccelerationFieldEstimator(PARAMS, sensors())
    start = given_start(PARAMS, estimator.array)
    rows = RigidBodyFilter(PARAMS, estimator.array, start).process(
        np.array([0, 1_000_000]), np.zeros((2, 12)))
    assert rows["stamp"].tolist() == [0, 1_000_000] and not rows["flags"].any()


def spinning(rate, duration, omega, alpha):
    """(stamp, omega, alpha) of a body that turns about one axis; functions of s give rad/s and
    rad/s^2."""
    t = np.arange(int(duration * rate)) / rate
    axis = np.array([0.2, -0.1, 0.97]) / np.linalg.norm([0.2, -0.1, 0.97])
    return np.round(t * 1e9).astype(np.int64), omega(t)[:, None] * axis, alpha(t)[:, None] * axis


def felt_at_centre(omega, alpha, random, noise):
    """Readings (n, 4, 3) of :func:`sensors` of a body that turns about their common centre, which
    is not accelerated, without gravity."""
    places = PAPER_POSITIONS - PAPER_POSITIONS.mean(axis=0)
    field = np.array([np.cross(alpha, p) + np.cross(omega, np.cross(omega, p)) for p in places])
    return np.einsum("kij,knj->nki", PAPER_AXES, field) + random.normal(
        0, noise, (len(omega), 4, 3))


@pytest.mark.parametrize("rate", [20.0, 50.0])
def test_slow_samples_of_a_fast_turn_do_not_diverge(rate):
    """The densities let omega change by many rad/s between samples: what one sample tells of its
    products must hold it."""
    stamp, omega, alpha = spinning(
        rate, 12.0, lambda t: 17.0 * np.sin(0.8 * t) ** 2, lambda t: 13.6 * np.sin(1.6 * t))
    params = AccelerationFieldParams(
        sample_rate=rate, gravity=0.0, initial=Initial(mode="given", orientation_sd=1e-3))
    estimator = AccelerationFieldEstimator(
        params, sensors(noise_density=0.1 / rate ** 0.5, bias_sd=0.0, reports="acceleration"))
    rows = estimator.run(stamp, felt_at_centre(omega, alpha, np.random.default_rng(1), 0.1))
    error = np.linalg.norm(rows["omega"] - omega, axis=1)
    sd = np.sqrt(np.trace(rows["cov_omega"], axis1=1, axis2=2))
    assert np.all(error < 4.0 * sd + 1e-6)
    # Of one sign or the other, never more than the body turns.
    assert sd[5:].max() < 2.0 * 17.0
    fast = np.linalg.norm(omega, axis=1) > 8.0
    # Whatever its sign, |omega|^2 is in every sample: minus half of the gradient's trace.
    square = -0.5 * np.trace(rows["gradient"], axis1=1, axis2=2)
    assert np.median(np.abs(square / np.sum(omega ** 2 + 1e-9, axis=1) - 1.0)[fast]) < 0.05


def test_the_sign_of_an_unknown_rate_is_open_until_it_changes():
    stamp, omega, alpha = spinning(
        1000.0, 0.6, lambda t: 10.0 + np.where(t > 0.2, 60.0 * (t - 0.2) ** 2, 0.0),
        lambda t: np.where(t > 0.2, 120.0 * (t - 0.2), 0.0))
    params = AccelerationFieldParams(gravity=0.0, initial=Initial(
        mode="given", angular_velocity_sd=20.0))
    estimator = AccelerationFieldEstimator(
        params, sensors(noise_density=0.02 / 1000 ** 0.5, bias_sd=0.0, reports="acceleration"))
    rows = estimator.run(stamp, felt_at_centre(omega, alpha, np.random.default_rng(2), 0.02))
    error = np.linalg.norm(rows["omega"] - omega, axis=1)
    sd = np.sqrt(np.trace(rows["cov_omega"], axis1=1, axis2=2))
    assert 3.0 < sd[2] < 15.0    # both signs
    assert np.all(error < 3.0 * sd)
    assert error[-1] < 0.5 and sd[-1] < 0.5


def test_a_body_that_hardly_turns_says_nothing_of_the_mounting():
    """Noise must not pass for motion: at rest no reading tells how the sensors sit as a whole."""
    params = AccelerationFieldParams(initial=Initial(mode="rest", duration=0.2))
    estimator = AccelerationFieldEstimator(params, sensors(noise_density=3e-3, position_sd=1e-3,
                                                           axes_sd=0.035, scale_sd=0.01))
    up = np.einsum("kij,j->ki", PAPER_AXES, [0.0, 0.0, 9.80665])
    readings = up + np.random.default_rng(3).normal(0, 0.1, (1500, 4, 3))
    estimator.run(np.arange(1500, dtype=np.int64) * 1_000_000, readings)
    for fit in estimator.sensor_fits():
        assert np.all(np.abs(fit.position_error) < fit.position_error_sd)
        assert np.allclose(fit.position_error_sd, np.sqrt(0.75) * 1e-3, rtol=0.01)
    assert estimator.remarks() == []
