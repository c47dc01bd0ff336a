"""A calibration that was applied to clipped rates, as their tops tell it.

A gyroscope's axes see ``u``, clipped at its range; recorded is ``A u + b``. Where axis i is
clipped, u_i stands still: what the recorded axis does there is what A mixes in of the others. That
tells A but for its diagonal, and with it which samples were clipped, however far their tops are
from flat.
"""

from dataclasses import dataclass

import numpy as np

_AWAY = 0.08         # of the limit: how far from it tops may lie that a calibration has mixed
_FEWEST = 60         # tops of an axis that tell what is mixed into it
_PRECISE = 2e-3      # standard deviation of an entry of the matrix that counts as told
_MOST = 0.1          # of an entry: no calibration mixes more
_EXACT = 2e-3        # of the limit: what a fit of tops that were clipped leaves
# What moves in a few tops alone tells whether they are tops, not how it mixes: of the limit, and in
# which share of them.
_MOVES, _SHARE = 0.01, 0.2
_ALONE = 0.1         # of a direction: the share of an axis that moves with another
_ROUNDS = 4          # the other axes are mixed, too
_TRIMS = 6


@dataclass(frozen=True)
class Unmixed:
    """``matrix`` (3, 3), A with a diagonal of ones; ``known`` (3,) bool, the rows of it that the
    tops tell, but for entries of an axis that stood still meanwhile, which are zero; ``seen``
    (n, 3) rad/s, what the axes saw; ``clipped`` (n, 3) bool."""

    matrix: np.ndarray
    known: np.ndarray
    seen: np.ndarray
    clipped: np.ndarray


def unmix(gyr: np.ndarray, limits: np.ndarray, band: float) -> Unmixed:
    """Undo the calibration of rates that were clipped before it.

    Args:
        gyr: (n, 3) rad/s, as recorded. limits: (3,) rad/s, about where the tops are; infinite for
            an axis without one. band: share of the limit within which samples count as
            clipped.
    """
    matrix, known = np.eye(3), np.zeros(3, bool)
    seen, clipped = gyr, np.abs(gyr) >= (1.0 - band) * limits
    for _ in range(_ROUNDS):
        found = [_row(gyr, seen, i, limits[i]) for i in range(3)]
        for i, (row, _) in enumerate(found):
            if row is not None:
                matrix[i], known[i] = row, True
        seen = gyr @ np.linalg.inv(matrix).T
    for i, (row, tops) in enumerate(found):
        clipped[:, i] |= tops
        if row is not None:
            level = np.median(np.abs(seen[tops, i]))
            clipped[:, i] = tops | (np.abs(seen[:, i]) >= (1.0 - band) * level)
    return Unmixed(matrix, known, seen, clipped)


def _row(gyr, seen, i, limit):
    """Row i of the matrix, None where the tops do not tell it, and the mask of its tops.

    An axis that is clipped all the while does not tell what is mixed in of it: its entry is zero.
    """
    tops = np.zeros(len(gyr), bool)
    near = np.flatnonzero(np.abs(seen[:, i]) > (1.0 - _AWAY) * limit)
    if len(near) < _FEWEST:
        return None, tops
    j, k = (i + 1) % 3, (i + 2) % 3
    sides, others = seen[near, i, None] * [1.0, -1.0] > 0.0, seen[near][:, (j, k)]
    kept = np.ones(len(near), bool)
    for _ in range(_TRIMS):
        # Samples just below the limit are among them: most are tops, and those fit exactly.
        inside = sides & kept[:, None]
        count = np.maximum(inside.sum(axis=0), 1)
        moved = others - sides @ (inside.T @ others / count[:, None])
        _, sizes, directions = np.linalg.svd(moved[kept], full_matrices=False)
        moves = sizes > _MOVES * limit * np.sqrt(kept.sum())
        along = moved @ directions[moves].T
        columns = np.column_stack([sides, along])
        fit = np.linalg.lstsq(columns[kept], gyr[near[kept], i], rcond=None)[0]
        off = np.abs(gyr[near, i] - columns @ fit)
        kept = off <= max(3.0 * float(np.median(off)), 0.1 * _EXACT * limit)
    exact, told = off <= _EXACT * limit, directions[moves]
    if (exact.sum() < max(_FEWEST, len(near) // 2) or not moves.any()
            or np.abs(fit[2:] @ told).max() > _MOST):
        return None, tops
    scatter = max(float(np.sqrt(np.mean(off[exact] ** 2))), 0.05 * _EXACT * limit)
    if not (scatter < _PRECISE * sizes[moves]).all():
        return None, tops
    tops[near[exact]] = True
    often = np.quantile(np.abs(along[exact]), 1.0 - _SHARE, axis=0) > _MOVES * limit
    told, fit = told[often], fit[2:][often]
    if not often.any() or (len(told) == 1 and np.abs(told).min() > _ALONE):
        return None, tops    # or two that move together
    row = np.zeros(3)
    row[[i, j, k]] = 1.0, *(fit @ told)
    return row, tops
