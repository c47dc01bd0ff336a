"""Derivatives of the model by differences; the linear solver against dense algebra."""

import numpy as np
import pytest

from imu_fusion.estimation.smoother import kernel, model, transition
from imu_fusion.estimation.smoother.inputs import lever_gradient, surface_points
from imu_fusion.geometry.rotation import skew

LAYOUT, SIZE = model.make_layout([name for name, _ in model.BLOCKS])
SPIN = np.array([0.0, 5e-5, 5e-5])


def random_state(rng):
    x = 0.1 * rng.standard_normal(SIZE + 1)
    x[0:6] = 10 * rng.standard_normal(6)
    x[6:10] = rng.standard_normal(4)
    x[6:10] /= np.linalg.norm(x[6:10])
    return x


def carry(x, gyr, acc, dt, decay):
    f_vel, f_att = np.zeros((3, SIZE)), np.zeros((3, SIZE))
    x_next, rate, force = np.empty(SIZE + 1), np.empty(3), np.empty(3)
    rotation, _ = model.interval(x, gyr, acc, dt, 9.8, SPIN, decay, LAYOUT, f_vel, f_att, x_next,
                                 rate, force)
    return x_next, f_vel, f_att, rate, force, rotation


def perturbed(x, i, step):
    delta = np.zeros(SIZE)
    delta[i] = step
    y = x.copy()
    transition.boxplus(y, delta)
    return y


COLUMNS = np.array([*range(6, 15), *range(LAYOUT[model.ACC_MATRIX], LAYOUT[model.ACC_MATRIX] + 9),
                    *range(LAYOUT[model.GYR_SCALE], LAYOUT[model.GYR_SCALE] + 3)])


def transition_matrix(x, gyr, acc, dt, decay):
    _, f_vel, f_att, *_ = carry(x, gyr, acc, dt, decay)
    out = np.empty((SIZE, SIZE))
    transition.propagate_rows(np.eye(SIZE), out, dt, decay, f_vel, f_att, COLUMNS)
    adjoint = np.empty((SIZE, SIZE))
    transition.adjoint_rows(np.eye(SIZE), adjoint, dt, decay, f_vel, f_att, COLUMNS)
    # The two accumulate in different orders.
    assert np.allclose(adjoint, out.T, rtol=0, atol=1e-12)
    return out


def test_transition_matches_differences():
    rng = np.random.default_rng(0)
    x, gyr, acc = random_state(rng), rng.standard_normal(3), 10 * rng.standard_normal(3)
    dt, decay = 0.02, np.ones(SIZE)
    decay[LAYOUT[model.GNSS_ERROR]:LAYOUT[model.GNSS_ERROR] + 3] = 0.9
    f = transition_matrix(x, gyr, acc, dt, decay)
    numeric, out = np.empty((SIZE, SIZE)), np.empty(SIZE)
    for i in range(SIZE):
        up, down = (carry(perturbed(x, i, s), gyr, acc, dt, decay)[0] for s in (1e-5, -1e-5))
        transition.boxminus(up, down, out)
        numeric[:, i] = out / 2e-5
    # Left out on purpose: gravity's, Coriolis' and Earth rate's own derivatives (dt * 1e-4),
    # and the Jacobian of half a turn (dt^2 / 4 times rate and force).
    assert np.abs(numeric - f).max() < 3e-5
    assert np.abs(f).max() > 0.1


def test_covariance_is_carried_as_by_the_whole_matrix():
    rng = np.random.default_rng(3)
    x, gyr, acc = random_state(rng), rng.standard_normal(3), 10 * rng.standard_normal(3)
    decay = np.ones(SIZE)
    decay[9:] = rng.uniform(0.5, 1.0, SIZE - 9)
    _, f_vel, f_att, *_ = carry(x, gyr, acc, 0.3, decay)
    f = transition_matrix(x, gyr, acc, 0.3, decay)
    root = rng.standard_normal((SIZE, SIZE))
    cov = root @ root.T
    expected = f @ cov @ f.T
    transition.propagate_cov(cov, np.empty((SIZE, SIZE)), 0.3, decay, f_vel, f_att, COLUMNS)
    # Sums of some 40 products: a few hundred roundings.
    assert np.allclose(cov, expected, rtol=0, atol=1e-13 * np.abs(expected).max())
    assert (cov == cov.T).all()


@pytest.mark.parametrize("tau", [0.0, 0.007])
@pytest.mark.parametrize("kind", ["fix", "velocity", "mag"])
def test_measurement_rows_match_differences(kind, tau):
    rng = np.random.default_rng(1)
    x, gyr, acc = random_state(rng), rng.standard_normal(3), 10 * rng.standard_normal(3)
    dt, field = 0.01, np.array([1.0, 20.0, -43.0])

    def predict(x, h, late=0.0):
        _, f_vel, _, rate, force, rotation = carry(x, gyr, acc, dt, np.ones(SIZE))
        i = LAYOUT[model.LEVER_ARM] + 1
        lever = x[i:i + 3].copy()
        if kind == "fix":
            return model.predict_fix(x, tau - late, rate, force, rotation, lever, LAYOUT, h)
        if kind == "velocity":
            return model.predict_velocity(x, tau - late, dt, rate, force, rotation, f_vel,
                                          COLUMNS, lever, LAYOUT, h)
        return model.predict_mag(x, tau, rate, rotation, field, LAYOUT, h)

    h, scrap = np.zeros((3, SIZE)), np.zeros((3, SIZE))
    predict(x, h)
    numeric = np.empty((3, SIZE))
    offsets = (LAYOUT[model.TIME_OFFSET], LAYOUT[model.VELOCITY_OFFSET])
    for i in range(SIZE):
        if i in offsets:
            used = kind == "velocity" or (kind == "fix" and i == offsets[0])
            late = 1e-5 if used else 0.0
            numeric[:, i] = (predict(x, scrap, late) - predict(x, scrap, -late)) / 2e-5
        else:
            numeric[:, i] = (predict(perturbed(x, i, 1e-5), scrap)
                             - predict(perturbed(x, i, -1e-5), scrap)) / 2e-5
    # The two terms that the rows leave out on purpose, by their own formulas.
    _, f_vel, _, _, _, rotation = carry(x, gyr, acc, dt, np.ones(SIZE))
    scale = slice(LAYOUT[model.GYR_SCALE], LAYOUT[model.GYR_SCALE] + 3)
    if kind == "fix":
        h += 0.5 * tau ** 2 / dt * f_vel
    elif kind == "mag":
        gain = 1.0 + x[LAYOUT[model.MAG_SCALE] + 1:][:3]
        turn = -tau * gain[:, None] * skew(rotation.T @ field)
        h[:, 9:12] += turn
        h[:, scale] -= turn * gyr
        assert np.abs(turn).max() < 0.5  # uT per rad/s, as the docstring says
    # Neglected besides: what the attitude changes of the Earth's rate, 7e-5 rad/s times a lever of
    # 0.1 m, or 47 uT times tau; the Coriolis force is as small.
    assert np.abs(numeric - h).max() < (2.4e-5 if kind == "mag" else 1e-5)
    assert np.abs(h[:, [0, 1, 2] if kind == "fix" else [3, 4, 5] if kind == "velocity"
                    else [6, 7, 8]]).max() >= 1.0


def test_rows_of_a_surface_match_differences():
    """A point at a lever arm, on a curved surface."""
    rng = np.random.default_rng(6)
    states = np.stack([random_state(rng) for _ in range(3)])
    at = slice(LAYOUT[model.SURFACE_ARM] + 1, LAYOUT[model.SURFACE_ARM] + 4)
    start = np.array([0, 1, 1, 3])  # rows of samples 0, 2 and 2

    def residual(states):
        p = surface_points(states[:, 0:3], states[:, 6:10], states[:, at])[[0, 2, 2]]
        return p[:, 2] - 0.05 * p[:, 0] ** 2 + np.array([0.0, 0.3, -0.2]) * p[:, 1]

    p = surface_points(states[:, 0:3], states[:, 6:10], states[:, at])[[0, 2, 2]]
    gradient = np.stack([-0.1 * p[:, 0], [0.0, 0.3, -0.2], np.ones(3)], axis=1)
    turned, along = lever_gradient(start, gradient, states[:, 6:10], states[:, at])
    rows = np.zeros((3, SIZE))
    rows[:, 0:3], rows[:, 6:9], rows[:, at.start - 1:at.stop - 1] = gradient, turned, along
    for i in range(SIZE):
        up, down = (residual(np.stack([perturbed(x, i, step) for x in states]))
                    for step in (1e-5, -1e-5))
        # Differences of values near 100 by 2e-5.
        assert np.allclose((up - down) / 2e-5, rows[:, i], rtol=0, atol=1e-7), i
    fixed = lever_gradient(start, gradient, states[:, 6:10], states[0, at])[0]
    assert np.array_equal(fixed[0], turned[0]) and not np.allclose(fixed[1:], turned[1:])


def test_solver_agrees_with_dense_algebra():
    """Posterior of a short linearised problem by stacking all noises and inverting."""
    rng = np.random.default_rng(2)
    count, n = 7, SIZE
    x = np.stack([random_state(rng)] * count)
    dt, decay_rate = np.full(count - 1, 0.02), np.zeros(n)
    decay_rate[LAYOUT[model.GNSS_ERROR]:LAYOUT[model.GNSS_ERROR] + 3] = 2.0
    decay_rate[LAYOUT[model.GNSS_VELOCITY_ERROR]:] = 5.0
    walk = np.zeros(n)
    walk[9:15] = 0.01
    walk[LAYOUT[model.GNSS_ERROR]:LAYOUT[model.GNSS_ERROR] + 3] = 0.5
    inputs = np.concatenate([rng.standard_normal((count - 1, 3)),
                             10 * rng.standard_normal((count - 1, 3))], axis=1)
    noise = rng.uniform(0.1, 0.5, (count - 1, 6))
    gravity, lever = 9.8, np.zeros(3)
    for k in range(count - 1):  # a trajectory with small gaps
        x[k + 1] = carry(x[k], inputs[k, :3], inputs[k, 3:], 0.02,
                         np.exp(-decay_rate * 0.02))[0]
        transition.boxplus(x[k + 1], 0.01 * rng.standard_normal(n))
    field = np.array([1.0, 20.0, -43.0])
    motion = (dt, inputs, noise, gravity, SPIN, decay_rate, walk, LAYOUT, COLUMNS, field, lever)
    kinds = np.array([0, 1, 2, 0, 2])
    sample = np.array([1, 1, 2, 4, 4])
    tau = np.full(5, 0.005)
    values, whiten = rng.standard_normal((5, 3)), np.tril(rng.uniform(0.5, 1.5, (5, 3, 3)))
    start = np.searchsorted(sample, np.arange(count + 1))
    measured = (start, kinds, tau, values, whiten, np.full(5, np.inf))
    row_sample = np.array([0, 3, 3, 6])
    rows = (np.searchsorted(row_sample, np.arange(count + 1)), rng.standard_normal(4),
            rng.standard_normal((4, 9)), np.full(4, 0.7), np.array([True, False, True, True]))
    prior_delta, prior_sd = 0.1 * rng.standard_normal(n), rng.uniform(0.2, 1.0, n)

    # Dense: every delta_k is linear in (delta_0, w_0, ...), so are all residuals.
    width = n + (count - 1) * (6 + n - 9)
    maps, means = [np.eye(n, width)], [prior_delta]
    spread = [prior_sd ** 2]
    for k in range(count - 1):
        decay = np.exp(-decay_rate * 0.02)
        x_next, *_, = carry(x[k], inputs[k, :3], inputs[k, 3:], 0.02, decay)
        f = transition_matrix(x[k], inputs[k, :3], inputs[k, 3:], 0.02, decay)
        defect = np.empty(n)
        transition.boxminus(x_next, x[k + 1], defect)
        g = np.zeros((n, width))
        at = n + k * (6 + n - 9)
        _, f_vel, *_ = carry(x[k], inputs[k, :3], inputs[k, 3:], 0.02, decay)
        middle = -f_vel[:, 12:15] / 0.02
        g[6:9, at:at + 3] = np.eye(3)
        g[3:6, at + 3:at + 6], g[0:3, at + 3:at + 6] = middle, 0.01 * middle
        g[9:, at + 6:at + 6 + n - 9] = np.eye(n - 9)
        maps.append(f @ maps[-1] + g)
        means.append(f @ means[-1] + defect)
        slow = np.where(decay_rate > 0, walk / np.maximum(2 * decay_rate, 1e-30)
                        * (1 - decay ** 2), walk * 0.02)[9:]
        spread.append(np.concatenate([noise[k] * 0.02, slow]))
    h_all, r_all = [], []
    for m, k in enumerate(sample):
        h = np.zeros((3, n))
        _, f_vel, _, rate, force, rotation = carry(x[k], inputs[k, :3], inputs[k, 3:], 0.02,
                                                   np.ones(n))
        arm = x[k, LAYOUT[model.LEVER_ARM] + 1:][:3].copy()
        predicted = [lambda: model.predict_fix(x[k], 0.005, rate, force, rotation, arm, LAYOUT, h),
                     lambda: model.predict_velocity(x[k], 0.005, 0.02, rate, force, rotation,
                                                    f_vel, COLUMNS, arm, LAYOUT, h),
                     lambda: model.predict_mag(x[k], 0.005, rate, rotation, field, LAYOUT, h)
                     ][kinds[m]]()
        h_all.append(whiten[m] @ h @ maps[k])
        r_all.append(whiten[m] @ (values[m] - predicted - h @ means[k]))
    for c, k in enumerate(row_sample):
        h = np.zeros(n)
        h[0:3], h[6:9] = rows[2][c, 0:3], rows[2][c, 3:6]
        h[LAYOUT[model.SURFACE_ARM]:LAYOUT[model.SURFACE_ARM] + 3] = rows[2][c, 6:9]
        gap = -rows[1][c]
        if rows[4][c]:
            h[LAYOUT[model.BODY_HEIGHT]] = -1.0
            gap += x[k, LAYOUT[model.BODY_HEIGHT] + 1]
        h_all.append((h @ maps[k] / 0.7)[None])
        r_all.append([(gap - h @ means[k]) / 0.7])
    h_all, r_all = np.vstack(h_all), np.concatenate(r_all)
    variance = np.concatenate(spread)
    variance[:n] = prior_sd ** 2
    prior = np.diag(variance)
    gain = prior @ h_all.T @ np.linalg.inv(h_all @ prior @ h_all.T + np.eye(len(h_all)))
    noises = gain @ r_all
    posterior = prior - gain @ h_all @ prior
    expected = np.stack([means[k] + maps[k] @ noises for k in range(count)])

    moved = x.copy()
    cov_out, var_out = np.empty((count, 3, 3, 3)), np.zeros((count, n - 9))
    _, process, largest = kernel.solve_linear(
        moved, prior_delta.copy(), np.diag(prior_sd ** 2), motion, measured, rows,
        np.zeros((5, 3)), True, cov_out, var_out)
    for k in range(count):
        target = x[k].copy()
        transition.boxplus(target, expected[k])
        assert np.allclose(moved[k], target, rtol=0, atol=1e-9), k
        full = maps[k] @ posterior @ maps[k].T
        for block in range(3):
            inner = slice(3 * block, 3 * block + 3)
            assert np.allclose(cov_out[k, block], full[inner, inner], rtol=1e-8, atol=1e-10)
    assert np.allclose(var_out[0], np.diag(maps[0] @ posterior @ maps[0].T)[9:], atol=1e-10)
    positive = variance[n:] > 0
    assert np.isclose(process, np.sum(noises[n:][positive] ** 2 / variance[n:][positive]))
    assert np.isclose(largest[0], np.linalg.norm(expected[:, :3], axis=1).max())


def test_segments_change_nothing():
    """Longer than a segment, the checkpoints reproduce the pass without them."""
    rng = np.random.default_rng(5)
    count = 2 * kernel.SEGMENT + 17
    x = np.zeros((count, 16))
    x[:, 9] = 1.0
    layout, n = model.make_layout([])
    motion = (np.full(count - 1, 0.01), np.tile([0.01, 0, 0, 0, 0.1, 9.8], (count - 1, 1)),
              np.full((count - 1, 6), 1e-4), 9.8, SPIN, np.zeros(n), np.zeros(n), layout,
              np.arange(6, 15), np.zeros(3), np.zeros(3))
    m = np.arange(0, count - 1, 10)
    measured = (np.searchsorted(m, np.arange(count + 1)), np.zeros(len(m), np.int64),
                np.zeros(len(m)), rng.standard_normal((len(m), 3)),
                np.tile(np.eye(3), (len(m), 1, 1)), np.full(len(m), np.inf))
    rows = (np.zeros(count + 1, np.int64), np.empty(0), np.empty((0, 3)), np.empty(0),
            np.empty(0, bool))
    moved = x.copy()
    kernel.solve_linear(moved, np.zeros(n), np.eye(n), motion, measured, rows,
                        np.zeros((len(m), 3)), False, np.empty((0, 3, 3, 3)),
                        np.empty((0, n - 9)))
    # One segment as long as the whole.
    storage = kernel.make_storage(count, 3 * len(m), n)
    delta, cov, step = np.zeros(n), np.eye(n), np.empty((count, n))
    kernel.filter_segment(0, count, False, x, delta, cov, motion, measured, rows,
                          np.zeros((len(m), 3)), storage)
    kernel.smooth_segment(0, count, x, np.zeros(n), np.zeros((n, n)), motion, storage, False,
                          step, np.empty((0, 3, 3, 3)), np.empty((0, n - 9)))
    transition.apply_step(x, step, np.zeros(3))
    assert np.array_equal(moved, x)
