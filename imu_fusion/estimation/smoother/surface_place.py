"""How well a surface is placed in the world: by what is stated of it, and by what fixes say.

Rows of a surface average out as if each had an error of its own; an error of its origin or datum is
one for all of them. Positions are as wrong as that.
"""

from collections.abc import Sequence

import numpy as np

from imu_fusion.surfaces.constraint import Constraint

_LOSS = 6.0       # standard deviations at which a fix lets go, as in the smoother
_CHANCE = 1.645   # standard deviations of an offset: one in ten by chance


def fixes_beside(residuals: np.ndarray, wander: float) -> tuple[np.ndarray, float]:
    """Robust mean (3,) of the residuals (n, 3) of fixes and its standard deviation, in those of a
    fix, where their means over seconds are larger than white noise leaves them by ``wander``."""
    weight = 1.0 / (1.0 + np.square(residuals / _LOSS))
    return (np.sum(weight * residuals, axis=0) / weight.sum(axis=0),
            wander / np.sqrt(max(len(residuals), 1)))


def widen_place(samples: np.ndarray, constraints: Sequence[Constraint], factor: float,
                offset: np.ndarray, offset_sd: np.ndarray) -> None:
    """Add the error that is common to all rows of a surface to the covariances of positions: its
    sigma in height, unless fixes know the height better; and the offset of the fixes from it, where
    that is hardly chance.

    Args:
        samples: of a SmootherResult, in place. constraints: of the surface. factor: of its
            sigma.
        offset, offset_sd: (3,) m, of the fixes from the trajectory that it holds.
    """
    sigmas = [factor * c.sigma for c in constraints if c.height]
    if not sigmas:
        return
    common = np.where(np.abs(offset) > _CHANCE * offset_sd, offset ** 2, 0.0)
    common[2] += 1.0 / (1.0 / max(sigmas) ** 2 + 1.0 / offset_sd[2] ** 2)
    samples["cov_position"] += np.diag(common)
