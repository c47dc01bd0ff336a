"""The linear solver against dense algebra, and segments against one pass."""

import numpy as np

from imu_fusion.estimation.smoother.backward_pass import Adjoint, Smoothed, smooth_segment
from imu_fusion.estimation.smoother.forward_filter import filter_segment, make_storage
from imu_fusion.estimation.smoother.linear_solve import SEGMENT, solve_linear
from imu_fusion.estimation.smoother.measurements import registry
from imu_fusion.estimation.smoother.records import (
    CONTACT,
    FIT,
    INTERVAL,
    MODEL,
    READING,
    Recording,
    make_scratch,
)
from imu_fusion.estimation.smoother.state import (
    ACC_BIAS,
    ATT,
    POS,
    SLOW,
    VEL,
    boxminus,
    boxplus,
    place_blocks,
    slow_states,
)
from imu_fusion.estimation.smoother.transition import apply_step
from test.estimation.smoother.linear import (
    BLOCKS,
    SIZE,
    carried,
    model_of_all,
    random_state,
    rows_of,
    transition_matrix,
)

DT = 0.02
FIELD = np.array([1.0, 20.0, -43.0])


def as_array(record, dtype):
    """A record as the one-element array that kernels take."""
    array = np.empty(1, dtype)
    array[0] = record
    return array


def short_problem(rng, count=7):
    """Trajectory (count, n + 1) with small gaps, and a Recording with readings of all kinds, two
    at one sample, and contacts."""
    n, x = SIZE, np.stack([random_state(rng)] * count)
    model = model_of_all(FIELD)
    first = BLOCKS.gnss_position_error
    model["decay_rate"][first:first + 3] = 2.0
    model["decay_rate"][BLOCKS.gnss_velocity_error:n] = 5.0
    model["walk"][SLOW:ACC_BIAS + 3] = 0.01
    model["walk"][first:first + 3] = 0.5
    intervals = np.empty(count - 1, INTERVAL)
    intervals["dt"] = DT
    intervals["gyr"] = rng.standard_normal((count - 1, 3))
    intervals["acc"] = 10 * rng.standard_normal((count - 1, 3))
    for name in ("gyr_noise", "acc_noise"):
        intervals[name] = rng.uniform(0.1, 0.5, (count - 1, 3))
    for k in range(count - 1):
        x[k + 1] = carried(x[k], intervals[k], model, decay_of(model))["x_next"][:n + 1]
        boxplus(x[k + 1], 0.01 * rng.standard_normal(n))
    readings = np.zeros(5, READING)
    readings["kind"], readings["tau"] = [0, 1, 2, 0, 2], 0.005
    readings["value"], readings["loss"] = rng.standard_normal((5, 3)), np.inf
    readings["whiten"] = np.tril(rng.uniform(0.5, 1.5, (5, 3, 3)))
    contacts = np.zeros(4, CONTACT)
    contacts["residual"], contacts["sigma"] = rng.standard_normal(4), 0.7
    contacts["height"] = [True, False, True, True]
    for name in ("position", "attitude", "lever_arm"):
        contacts[name] = rng.standard_normal((4, 3))
    samples = np.arange(count + 1)
    return x, Recording(as_array(model, MODEL), intervals, readings,
                        np.searchsorted([1, 1, 2, 4, 4], samples), contacts,
                        np.searchsorted([0, 3, 3, 6], samples))


def decay_of(model):
    return np.exp(-model["decay_rate"][:SIZE] * DT)


def dense_motion(x, recording, prior_delta, prior_sd):
    """Every deviation is linear in (delta_0, w_0, ...): maps, means, and variances of all of
    these noises."""
    n, model, count = SIZE, recording.model[0], len(x)
    per_step = 6 + n - SLOW
    width = n + (count - 1) * per_step
    maps, means, spread = [np.eye(n, width)], [prior_delta], [prior_sd ** 2]
    decay, rate, walk = decay_of(model), model["decay_rate"][:n], model["walk"][:n]
    for k in range(count - 1):
        interval = recording.intervals[k]
        step = carried(x[k], interval, model, decay)
        f = transition_matrix(x[k], interval, model, decay)
        defect, g, at = np.empty(n), np.zeros((n, width)), n + k * per_step
        boxminus(step["x_next"][:n + 1].copy(), x[k + 1], defect)
        g[ATT:ATT + 3, at:at + 3] = np.eye(3)
        g[VEL:VEL + 3, at + 3:at + 6] = step["middle"]
        g[POS:POS + 3, at + 3:at + 6] = 0.5 * DT * step["middle"]
        g[SLOW:, at + 6:at + per_step] = np.eye(n - SLOW)
        maps.append(f @ maps[-1] + g)
        means.append(f @ means[-1] + defect)
        slow = np.where(rate > 0, walk / np.maximum(2 * rate, 1e-30) * (1 - decay ** 2), walk * DT)
        spread.append(np.concatenate([interval["gyr_noise"] * DT, interval["acc_noise"] * DT,
                                      slow[SLOW:]]))
    return maps, means, np.concatenate(spread)


def dense_rows(x, recording, maps, means):
    """Whitened derivatives of all rows to the noises, and residuals."""
    n, model, h_all, r_all = SIZE, recording.model[0], [], []
    sample = np.repeat(np.arange(len(x)), np.diff(recording.reading_start))
    for reading, k in zip(recording.readings, sample):
        step, rows = carried(x[k], recording.intervals[k], model), rows_of()
        step["lever_arm"] = slow_states(x[k], BLOCKS.gnss_lever_arm, 3)
        registry.predict(reading["kind"], x[k], reading["tau"], step, model, rows)
        h = rows["h"][:, :n]
        h_all.append(reading["whiten"] @ h @ maps[k])
        r_all.append(reading["whiten"] @ (reading["value"] - rows["predicted"] - h @ means[k]))
    sample = np.repeat(np.arange(len(x)), np.diff(recording.contact_start))
    for contact, k in zip(recording.contacts, sample):
        h, gap = np.zeros(n), -contact["residual"]
        h[POS:POS + 3], h[ATT:ATT + 3] = contact["position"], contact["attitude"]
        h[BLOCKS.surface_lever_arm:BLOCKS.surface_lever_arm + 3] = contact["lever_arm"]
        if contact["height"]:
            h[BLOCKS.body_height] = -1.0
            gap += slow_states(x[k], BLOCKS.body_height, 1)[0]
        h_all.append((h @ maps[k] / contact["sigma"])[None])
        r_all.append([(gap - h @ means[k]) / contact["sigma"]])
    return np.vstack(h_all), np.concatenate(r_all)


def test_solver_agrees_with_dense_algebra():
    """Posterior of a short linearised problem by stacking all noises and inverting."""
    rng = np.random.default_rng(2)
    x, recording = short_problem(rng)
    n, count = SIZE, len(x)
    prior_delta, prior_sd = 0.1 * rng.standard_normal(n), rng.uniform(0.2, 1.0, n)
    maps, means, variance = dense_motion(x, recording, prior_delta, prior_sd)
    h_all, r_all = dense_rows(x, recording, maps, means)
    prior = np.diag(variance)
    gain = prior @ h_all.T @ np.linalg.inv(h_all @ prior @ h_all.T + np.eye(len(h_all)))
    noises = gain @ r_all
    posterior = prior - gain @ h_all @ prior
    expected = np.stack([means[k] + maps[k] @ noises for k in range(count)])

    moved = x.copy()
    cov_out, var_out = np.empty((count, 3, 3, 3)), np.zeros((count, n - SLOW))
    _, surprise, process, largest = solve_linear(
        moved, prior_delta.copy(), np.diag(prior_sd ** 2), recording, np.zeros(5, FIT), cov_out,
        var_out)
    for k in range(count):
        target = x[k].copy()
        boxplus(target, expected[k])
        assert np.allclose(moved[k], target, rtol=0, atol=1e-9), k
        full = maps[k] @ posterior @ maps[k].T
        for block in range(3):
            inner = slice(3 * block, 3 * block + 3)
            assert np.allclose(cov_out[k, block], full[inner, inner], rtol=1e-8, atol=1e-10)
    assert np.allclose(var_out[0], np.diag(maps[0] @ posterior @ maps[0].T)[SLOW:], atol=1e-10)
    spread = h_all @ prior @ h_all.T + np.eye(len(h_all))
    assert np.isclose(surprise, 0.5 * (r_all @ np.linalg.solve(spread, r_all)
                                       + np.linalg.slogdet(spread)[1]))
    positive = variance[n:] > 0
    assert np.isclose(process, np.sum(noises[n:][positive] ** 2 / variance[n:][positive]))
    assert np.isclose(largest[0], np.linalg.norm(expected[:, :3], axis=1).max())


def long_problem(rng, count):
    """At rest, no optional blocks, a fix at every tenth sample."""
    blocks, n = place_blocks([])
    x = np.zeros((count, n + 1))
    x[:, ATT + 3] = 1.0
    intervals = np.zeros(count - 1, INTERVAL)
    intervals["dt"], intervals["gyr_noise"], intervals["acc_noise"] = 0.01, 1e-4, 1e-4
    intervals["gyr"], intervals["acc"] = [0.01, 0, 0], [0, 0.1, 9.8]
    m = np.arange(0, count - 1, 10)
    readings = np.zeros(len(m), READING)
    readings["value"] = rng.standard_normal((len(m), 3))
    readings["whiten"], readings["loss"] = np.eye(3), np.inf
    samples = np.arange(count + 1)
    return x, Recording(as_array(model_of_all(np.zeros(3), blocks), MODEL), intervals, readings,
                        np.searchsorted(m, samples), np.empty(0, CONTACT), np.zeros_like(samples))


def test_segments_change_nothing():
    """Longer than a segment, the checkpoints reproduce the pass without them."""
    x, recording = long_problem(np.random.default_rng(5), 2 * SEGMENT + 17)
    count, n, m = len(x), x.shape[1] - 1, len(recording.readings)
    moved, none = x.copy(), (np.empty((0, 3, 3, 3)), np.empty((0, n - SLOW)))
    solve_linear(moved, np.zeros(n), np.eye(n), recording, np.zeros(m, FIT), *none)
    # One segment as long as the whole.
    storage, scratch = make_storage(count, 3 * m, n), make_scratch(n)
    smoothed = Smoothed(np.empty((count, n)), *none)
    filter_segment(0, count, False, x, np.zeros(n), np.eye(n), recording, np.zeros(m, FIT), storage,
                   scratch)
    smooth_segment(0, count, Adjoint(np.zeros(n), np.zeros((n, n))), recording, storage, smoothed,
                   scratch)
    apply_step(x, smoothed.step, np.zeros(3))
    assert np.array_equal(moved, x)


def test_a_reading_of_one_component_is_one_row():
    """As a barometer's would be: the other rows are empty, and say nothing."""
    rng = np.random.default_rng(9)
    x, recording = long_problem(rng, 60)
    n, m, readings = x.shape[1] - 1, len(recording.readings), recording.readings.copy()
    for reading in readings:
        reading["whiten"], reading["value"] = np.diag([1.0, 0.0, 0.0]), [reading["value"][0], 7, 7]
    fit, none = np.zeros(m, FIT), (np.empty((0, 3, 3, 3)), np.empty((0, n - SLOW)))
    moved = x.copy()
    cost, _, _, _ = solve_linear(moved, np.zeros(n), np.eye(n),
                                 recording._replace(readings=readings), fit, *none)
    assert fit["innovation"][:, 0].all() and not fit["innovation"][:, 1:].any()
    assert np.isclose(cost, np.sum(readings["value"][:, 0] ** 2), rtol=1e-3)
    free = x.copy()
    solve_linear(free, np.zeros(n), np.eye(n), recording._replace(
        readings=readings[:0], reading_start=0 * recording.reading_start), np.zeros(0, FIT), *none)
    assert np.allclose(moved[:, 2], free[:, 2], rtol=0, atol=1e-3)
