"""The property that every measurement has to have: its rows are its derivatives. So for the motion
and for surfaces."""

import numpy as np
import pytest

from imu_fusion.estimation.smoother import motion, transition
from imu_fusion.estimation.smoother.measurements import registry
from imu_fusion.estimation.smoother.measurements.surface_contact import (
    put_lever_derivatives,
    put_row,
    surface_points,
)
from imu_fusion.estimation.smoother.records import CONTACT
from imu_fusion.estimation.smoother.state import ATT, GYR_BIAS, POS, SLOW, boxminus, slow_states
from imu_fusion.geometry.rotation import skew
from test.estimation.smoother.linear import (
    BLOCKS,
    SIZE,
    carried,
    interval_of,
    model_of_all,
    perturbed,
    random_state,
    rows_of,
    transition_matrix,
)

STEP = 1e-5   # of the central differences
FIELD = np.array([1.0, 20.0, -43.0])

#: Largest deviation that is left out on purpose, for rates of 1 rad/s and forces of 10 m/s^2.
#: Readings: what the attitude changes of the Earth's rate, 7e-5 rad/s times a lever of 0.1 m or
#: 47 uT times tau; the Coriolis force is as small.
NEGLECTED = {"fix": 1e-5, "velocity": 1e-5, "mag": 2.4e-5, "moved_fix": 1e-5,
             "rest": 1e-5}


def left_out_of_fix(h, tau, step, interval, x):
    """The acceleration's derivatives times tau^2 / 2."""
    h += 0.5 * tau ** 2 / interval["dt"] * step["f_vel"][:, :SIZE]


def left_out_of_mag(h, tau, step, interval, x):
    """What the errors of the gyroscope turn the field by within tau."""
    gain = 1.0 + slow_states(x, BLOCKS.mag_scale, 3)
    axes = np.eye(3) + skew(slow_states(x, BLOCKS.mag_axes, 3))
    turn = -tau * gain[:, None] * (axes @ skew(step["rotation"].T @ FIELD))
    h[:, GYR_BIAS:GYR_BIAS + 3] += turn
    h[:, BLOCKS.gyr_scale:BLOCKS.gyr_scale + 3] -= turn * interval["gyr"]
    assert np.abs(turn).max() < 0.5  # uT per rad/s, as the docstring says


#: What the rows say they leave out, by their own formulas.
LEFT_OUT = {"fix": left_out_of_fix, "mag": left_out_of_mag, "moved_fix": left_out_of_fix}


@pytest.mark.parametrize("tau", [0.0, 0.007])
@pytest.mark.parametrize("kind", range(len(registry.MEASUREMENTS)),
                         ids=[m.name for m in registry.MEASUREMENTS])
def test_rows_of_a_measurement_are_its_derivatives(kind, tau):
    rng = np.random.default_rng(1)
    measurement = registry.MEASUREMENTS[kind]
    x, interval = random_state(rng), interval_of(rng, 0.01)
    model = model_of_all(FIELD)

    def predict(x, late=0.0):
        step, rows = carried(x, interval, model), rows_of()
        step["lever_arm"] = slow_states(x, BLOCKS.gnss_lever_arm, 3)
        registry.predict(kind, x, tau - late, step, model, rows)
        return rows["predicted"].copy(), rows["h"][:, :SIZE].copy(), step

    h, step = predict(x)[1:]
    numeric = np.empty((3, SIZE))
    delays = {getattr(BLOCKS, name): name for name in registry.DELAYS}
    for i in range(SIZE):
        if i in delays:
            late = STEP if delays[i] in measurement.delays else 0.0
            up, down = predict(x, late)[0], predict(x, -late)[0]
        else:
            up, down = (predict(perturbed(x, i, s))[0] for s in (STEP, -STEP))
        numeric[:, i] = (up - down) / (2 * STEP)
    if measurement.name in LEFT_OUT:
        LEFT_OUT[measurement.name](h, tau, step, interval, x)
    used = len(measurement.components)
    assert np.abs(numeric - h)[:used].max() < NEGLECTED[measurement.name]
    assert np.all(np.abs(h[:used]).max(axis=1) > 0.5) and not h[used:].any()


def test_transition_is_the_derivative_of_the_motion():
    rng = np.random.default_rng(0)
    interval, x, model = interval_of(rng, 0.02), random_state(rng), model_of_all(FIELD)
    decay = np.ones(SIZE)
    decay[BLOCKS.gnss_position_error:BLOCKS.gnss_position_error + 3] = 0.9
    f = transition_matrix(x, interval, model, decay)
    numeric, out = np.empty((SIZE, SIZE)), np.empty(SIZE)
    for i in range(SIZE):
        up, down = (carried(perturbed(x, i, s), interval, model, decay)["x_next"][:SIZE + 1]
                    for s in (STEP, -STEP))
        boxminus(up.copy(), down.copy(), out)
        numeric[:, i] = out / (2 * STEP)
    # Left out on purpose: gravity's, Coriolis' and Earth rate's own derivatives (dt * 1e-4),
    # and the Jacobian of half a turn (dt^2 / 4 times rate and force).
    assert np.abs(numeric - f).max() < 3e-5
    assert np.abs(f).max() > 0.1


def test_rows_of_a_surface_are_its_derivatives():
    """A point at a lever arm, on a curved surface, with the height of the body."""
    rng = np.random.default_rng(6)
    states = np.stack([random_state(rng) for _ in range(3)])
    start = np.array([0, 1, 1, 3])  # rows of samples 0, 2 and 2
    sample, height = [0, 2, 2], np.array([True, True, False])

    def points(states):
        return surface_points(states[:, POS:POS + 3], states[:, ATT:ATT + 4],
                              slow_states(states, BLOCKS.surface_lever_arm, 3))[sample]

    def residual(states):
        p = points(states)
        above = p[:, 2] - 0.05 * p[:, 0] ** 2 + np.array([0.0, 0.3, -0.2]) * p[:, 1]
        return above - height * slow_states(states, BLOCKS.body_height, 1)[sample, 0]

    p = points(states)
    contacts = np.zeros(3, CONTACT)
    contacts["residual"] = residual(states) + height * slow_states(
        states, BLOCKS.body_height, 1)[sample, 0]
    contacts["position"] = np.stack([-0.1 * p[:, 0], [0.0, 0.3, -0.2], np.ones(3)], axis=1)
    contacts["sigma"], contacts["height"] = 0.5, height
    put_lever_derivatives(start, contacts, states[:, ATT:ATT + 4],
                          slow_states(states, BLOCKS.surface_lever_arm, 3))
    found, rows, model = np.zeros((3, SIZE)), rows_of(), model_of_all(FIELD)
    for c, k in enumerate(sample):
        assert np.isclose(-0.5 * put_row(contacts[c], states[k], model, rows),
                          residual(states)[c])
        count = rows["length"]
        found[c, rows["states"][:count]] = 0.5 * rows["entries"][:count]
    for i in range(SIZE):
        up, down = (residual(np.stack([perturbed(x, i, step) for x in states]))
                    for step in (STEP, -STEP))
        # Differences of values near 100 by 2e-5.
        assert np.allclose((up - down) / (2 * STEP), found[:, i], rtol=0, atol=1e-7), i
    fixed = contacts.copy()
    put_lever_derivatives(start, fixed, states[:, ATT:ATT + 4],
                          slow_states(states[0], BLOCKS.surface_lever_arm, 3))
    assert np.array_equal(fixed["attitude"][0], contacts["attitude"][0])
    assert not np.allclose(fixed["attitude"][1:], contacts["attitude"][1:])


def test_covariance_is_carried_as_by_the_whole_matrix():
    rng = np.random.default_rng(3)
    x, interval, model = random_state(rng), interval_of(rng, 0.3), model_of_all(FIELD)
    decay = np.ones(SIZE)
    decay[SLOW:] = rng.uniform(0.5, 1.0, SIZE - SLOW)
    f = transition_matrix(x, interval, model, decay)
    root = rng.standard_normal((SIZE, SIZE))
    cov = root @ root.T
    expected = f @ cov @ f.T
    transition.propagate_cov(cov, np.empty((SIZE, SIZE)), carried(x, interval, model, decay), model)
    # Sums of some 40 products: a few hundred roundings.
    assert np.allclose(cov, expected, rtol=0, atol=1e-13 * np.abs(expected).max())
    assert (cov == cov.T).all()


def test_decay_follows_the_rate():
    model = model_of_all(FIELD)
    step = carried(random_state(np.random.default_rng(7)), interval_of(
        np.random.default_rng(8), 0.1), model)
    model["decay_rate"][SLOW + 1] = 2.0
    motion.put_decay(0.1, model, step, SIZE)
    assert step["decay"][SLOW] == 1.0 and step["decay"][SLOW + 1] == pytest.approx(np.exp(-0.2))
