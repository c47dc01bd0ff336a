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
_ROUNDS = 4          # the other axes are mixed, too
_TRIMS = 6


@dataclass(frozen=True)
class Unmixed:
    """``matrix`` (3, 3), A with a diagonal of ones; ``known`` (3,) bool, the rows of it that the
    tops tell; ``seen`` (n, 3) rad/s, what the axes saw; ``clipped`` (n, 3) bool."""

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
        for i, tops in enumerate(found):
            if tops is not None:
                matrix[i], known[i] = tops[0], True
        seen = gyr @ np.linalg.inv(matrix).T
    for i, tops in enumerate(found):
        if tops is not None:
            level = np.median(np.abs(seen[tops[1], i]))
            clipped[:, i] = tops[1] | (np.abs(seen[:, i]) >= (1.0 - band) * level)
    return Unmixed(matrix, known, seen, clipped)


def _row(gyr, seen, i, limit):
    """Row i of the matrix and the mask of its clipped samples; None where the tops do not tell."""
    near = np.flatnonzero(np.abs(seen[:, i]) > (1.0 - _AWAY) * limit)
    if len(near) < _FEWEST:
        return None
    j, k = (i + 1) % 3, (i + 2) % 3
    columns = np.column_stack([np.ones(len(near)), np.sign(seen[near, i]), seen[near][:, (j, k)]])
    kept = np.ones(len(near), bool)
    for _ in range(_TRIMS):
        # Samples just below the limit are among them: most are tops, and those fit exactly.
        fit = np.linalg.lstsq(columns[kept], gyr[near[kept], i], rcond=None)[0]
        off = np.abs(gyr[near, i] - columns @ fit)
        kept = off <= max(3.0 * float(np.median(off)), 0.1 * _EXACT * limit)
    exact = off <= _EXACT * limit
    if exact.sum() < max(_FEWEST, len(near) // 2) or np.abs(fit[2:]).max() > _MOST:
        return None
    scatter = max(float(np.sqrt(np.mean(off[exact] ** 2))), 0.05 * _EXACT * limit)
    spread = np.linalg.pinv(np.cov(columns[exact][:, 2:].T)).diagonal() / exact.sum()
    if not (scatter * np.sqrt(spread) < _PRECISE).all():
        return None
    row = np.zeros(3)
    row[[i, j, k]] = 1.0, fit[2], fit[3]
    clipped = np.zeros(len(gyr), bool)
    clipped[near[exact]] = True
    return row, clipped
