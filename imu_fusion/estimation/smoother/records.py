"""What the kernels of the smoother pass around, by name.

One-element structured arrays and their records hold what has a fixed size, rows of all possible
states included: :data:`.state.MOST` entries, of which the first n are in use.
"""

from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.smoother.state import MOST, StateBlocks
from imu_fusion.kernels import njit

#: Motion between two samples: s, mean rate (rad/s) and force (m/s^2), their variance densities.
INTERVAL = np.dtype([("dt", "f8"), ("gyr", "f8", 3), ("acc", "f8", 3), ("gyr_noise", "f8", 3),
                     ("acc_noise", "f8", 3)], align=True)

#: One reading: ns; its kind, an index of registry.MEASUREMENTS; ``tau`` s after the sample that
#: it is bound to; value; whitening matrix (lower); squared scale of the Cauchy loss, inf: squared
#: loss. Fewer than three components leave the last rows and values zero.
READING = np.dtype([("stamp", "i8"), ("kind", "i8"), ("tau", "f8"), ("value", "f8", 3),
                    ("whiten", "f8", (3, 3)), ("loss", "f8")], align=True)

#: What the filter makes of one reading, component by component: normalised innovation; whitened
#: residual at the nominal trajectory, by which the loss is judged.
FIT = np.dtype([("innovation", "f8", 3), ("residual", "f8", 3)], align=True)

#: One row of a surface: m above it, its derivatives, sigma (m); whether it is a height.
CONTACT = np.dtype([("residual", "f8"), ("position", "f8", 3), ("attitude", "f8", 3),
                    ("lever_arm", "f8", 3), ("sigma", "f8"), ("height", "?")], align=True)

#: What stays the same over a recording: gravity at the origin (m/s^2), rate of the Earth (rad/s)
#: and magnetic field (microtesla) in the world, antenna in the imu frame (m); first error index of
#: each optional block, -1: absent; decay rate (1/s) and variance density of the walk of each error
#: state; the ``n_columns`` error indices that velocity and attitude of the next sample depend on,
#: besides the velocity.
MODEL = np.dtype([("gravity", "f8"), ("earth_rate", "f8", 3), ("magnetic_field", "f8", 3),
                  ("lever_arm", "f8", 3),
                  ("blocks", [(name, "i8") for name in StateBlocks._fields]),
                  ("decay_rate", "f8", MOST), ("walk", "f8", MOST), ("columns", "i8", MOST),
                  ("n_columns", "i8")], align=True)

#: One interval, linearised about the state at its beginning. s; rate against the world and specific
#: force in the imu frame, acceleration in the world; rotation vector of the interval, matrices
#: R_world_imu at its beginning and in its middle; ``lever``: what an error of the attitude there
#: adds to the velocity; antenna in the imu frame (m). ``f_vel``, ``f_att``: rows of the transition
#: matrix F, f_vel without the identity of the velocity itself; ``decay``: factors of the slow
#: states; ``spread``: covariance of the velocity step in world axes; ``x_next``: the state carried
#: to the next sample.
STEP = np.dtype([("dt", "f8"), ("rate", "f8", 3), ("force", "f8", 3), ("acc_world", "f8", 3),
                 ("turn", "f8", 3), ("rotation", "f8", (3, 3)), ("middle", "f8", (3, 3)),
                 ("lever", "f8", (3, 3)), ("lever_arm", "f8", 3), ("f_vel", "f8", (3, MOST)),
                 ("f_att", "f8", (3, MOST)), ("decay", "f8", MOST), ("spread", "f8", (3, 3)),
                 ("x_next", "f8", MOST + 1)], align=True)

#: Rows of a measurement: what is predicted, its derivative, and the residual, whitened in time; one
#: row of ``length`` entries that are not zero, their error indices, and its gain divided by the
#: standard deviation of the innovation.
ROWS = np.dtype([("predicted", "f8", 3), ("h", "f8", (3, MOST)), ("residual", "f8", 3),
                 ("length", "i8"), ("entries", "f8", MOST), ("states", "i8", MOST),
                 ("gain", "f8", MOST)], align=True)


class Recording(NamedTuple):
    """N samples: ``model`` (1,) of MODEL; ``intervals`` (N - 1,) of INTERVAL; ``readings`` (M,) of
    READING and ``contacts`` (r,) of CONTACT, sorted by sample, those of sample k from
    ``*_start[k]`` to ``*_start[k + 1]``."""

    model: np.ndarray
    intervals: np.ndarray
    readings: np.ndarray
    reading_start: np.ndarray
    contacts: np.ndarray
    contact_start: np.ndarray


class Scratch(NamedTuple):
    """Memory of the passes: ``step`` and ``rows`` (1,) of STEP and ROWS; ``matrix``, ``transposed``
    (n, n); ``column``, ``carried`` (n, 1); ``vector`` (n,).

    A record does not keep the array alive that it is of: so whoever calls a pass holds this.
    """

    step: np.ndarray
    rows: np.ndarray
    matrix: np.ndarray
    transposed: np.ndarray
    column: np.ndarray
    carried: np.ndarray
    vector: np.ndarray


@njit
def make_scratch(n: int) -> Scratch:
    """Scratch for n error states."""
    return Scratch(np.zeros(1, STEP), np.zeros(1, ROWS), np.empty((n, n)), np.empty((n, n)),
                   np.empty((n, 1)), np.empty((n, 1)), np.empty(n))
