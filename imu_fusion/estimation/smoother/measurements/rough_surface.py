"""A surface that bends within what the position is unsure by: statistical linearisation.

The tangent at one place says where on an undulating slope the body is, as if no other place fitted
as well: from ten metres off the trajectory settles on the wrong undulation, sure of it. What is
linear in the height over all places at which the body may be is what counts, and what is left over
is noise (posterior linearisation: Garcia-Fernandez, Svensson, Morelande, Sarkka 2015). As the
position becomes known, that turns into the tangent; where it does not, nothing is claimed.
"""

from collections.abc import Callable

import numpy as np

#: m, the spread of the position before anything is known of it, and the most that is looked at.
WIDEST = 30.0
# Unscented transform in the two horizontal directions: the middle counts 1/3, four places around
# it 1/6 each.
_REACH = np.sqrt(3.0)    # standard deviations


def linearise(evaluate: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
              position: np.ndarray, cov: np.ndarray | None
              ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What is linear in a residual where the position is spread over some places.

    Args:
        evaluate: of a Constraint. position: (n, 3) m.
        cov: (n, 3, 3) m^2, of the position; None: :data:`WIDEST`.

    Returns:
        residual (n,) m, its mean, nan where it does not apply; gradient (n, 3); variance (n,) m^2
        of what is not linear. Towards places without a surface it is taken to go on as it is.
    """
    middle, gradient = evaluate(position)
    level = np.broadcast_to(WIDEST ** 2 * np.eye(2), (len(position), 2, 2)) if cov is None \
        else cov[:, :2, :2]
    variance, axes = np.linalg.eigh(level)
    spread = np.clip(np.sqrt(np.maximum(variance, 0.0)), 1e-3, WIDEST)
    # Residuals (n, 2, 2) beside the middle: along each axis, ahead and behind.
    beside = np.empty((len(position), 2, 2))
    for k in range(2):
        aside = np.zeros_like(position)
        aside[:, :2] = _REACH * spread[:, k, None] * axes[:, :, k]
        along = np.einsum("ni,ni->n", gradient, aside)
        for j, sign in enumerate((1.0, -1.0)):
            there = evaluate(position + sign * aside)[0]
            beside[:, k, j] = np.where(np.isfinite(there), there, middle + sign * along)
    mean = (middle + 0.5 * beside.sum(axis=(1, 2))) / 3.0
    slope = (beside[:, :, 0] - beside[:, :, 1]) / (2.0 * _REACH)     # per standard deviation
    bent = beside - mean[:, None, None] - _REACH * slope[:, :, None] * [1.0, -1.0]
    left = ((middle - mean) ** 2 + 0.5 * np.sum(bent ** 2, axis=(1, 2))) / 3.0
    gradient = gradient.copy()
    gradient[:, :2] = np.einsum("nik,nk->ni", axes, slope / spread)
    return mean, gradient, left
