"""States, models and transition matrices of all blocks at once, for tests of the kernels."""

import numpy as np

from imu_fusion.estimation.smoother import motion, state, transition
from imu_fusion.estimation.smoother.records import INTERVAL, MODEL, ROWS, STEP
from imu_fusion.estimation.smoother.state import ATT, StateBlocks, place_blocks

BLOCKS, SIZE = place_blocks(StateBlocks._fields)
SPIN = np.array([0.0, 5e-5, 5e-5])


def random_state(rng):
    """(SIZE + 1,), positions and velocities of 10 m and m/s."""
    x = 0.1 * rng.standard_normal(SIZE + 1)
    x[:ATT] = 10 * rng.standard_normal(6)
    x[ATT:ATT + 4] = rng.standard_normal(4)
    x[ATT:ATT + 4] /= np.linalg.norm(x[ATT:ATT + 4])
    return x


def perturbed(x, i, step):
    """The state moved by ``step`` along the error state i."""
    delta = np.zeros(SIZE)
    delta[i] = step
    y = x.copy()
    state.boxplus(y, delta)
    return y


def interval_of(rng, dt):
    """Record of INTERVAL with rates of 1 rad/s, forces of 10 m/s^2."""
    interval = np.zeros(1, INTERVAL)[0]
    interval["dt"] = dt
    interval["gyr"], interval["acc"] = rng.standard_normal(3), 10 * rng.standard_normal(3)
    return interval


def model_of_all(field, blocks=BLOCKS):
    """Record of MODEL: 9.8 m/s^2, all blocks constant."""
    model = np.zeros(1, MODEL)[0]
    model["gravity"], model["earth_rate"], model["magnetic_field"] = 9.8, SPIN, field
    model["blocks"] = tuple(blocks)
    columns = motion.columns_of(blocks)
    model["columns"][:len(columns)], model["n_columns"] = columns, len(columns)
    return model


def rows_of():
    """Record of ROWS, zeros."""
    return np.zeros(1, ROWS)[0]


def carried(x, interval, model, decay=None):
    """Record of STEP of the interval behind a state."""
    step = np.zeros(1, STEP)[0]
    step["decay"][:len(x) - 1] = 1.0 if decay is None else decay
    motion.carry(x, interval, model, step)
    return step


def transition_matrix(x, interval, model, decay):
    """F (SIZE, SIZE), of which the adjoint product is checked to be the transpose."""
    step, out, adjoint = carried(x, interval, model, decay), *np.empty((2, SIZE, SIZE))
    transition.propagate_rows(np.eye(SIZE), out, step, model)
    transition.adjoint_rows(np.eye(SIZE), adjoint, step, model)
    # The two accumulate in different orders.
    assert np.allclose(adjoint, out.T, rtol=0, atol=1e-12)
    return out
