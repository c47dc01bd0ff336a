"""Whether innovations are as white as the covariances take them to be.

Their size alone may fit while they wander: a step of the height datum, multipath, biases that
drift faster than stated. Means over seconds then are larger than white noise leaves them, and all
that rests on averaging is less certain by as much.
"""

import numpy as np
import scipy  # its parts are loaded where they are first used

_BLOCK = 5_000_000_000   # ns, over which innovations are averaged
_FEWEST = 3              # innovations in a block, and blocks
_LARGEST = 6.0           # standard deviations, to which single ones are cut: outliers are no drift
_EXCESS = 1.6            # simulated jumps and drives with the right noise: up to 1.4
_CHANCE = 1e-3           # of a component of white noise to be called wandering


def wandering(stamp: np.ndarray, innovations: np.ndarray) -> float:
    """RMS of the means over seconds by what white noise leaves, of the component that wanders
    most; 1 where that may be chance.

    Args:
        stamp: (n,) ns. innovations: (n, k), normalised.
    """
    if not len(stamp):
        return 1.0
    block = np.unique((stamp - stamp[0]) // _BLOCK, return_inverse=True)[1]
    count = np.bincount(block)
    cut = np.clip(innovations, -_LARGEST, _LARGEST)
    means = np.column_stack([np.bincount(block, c) / np.sqrt(count) for c in cut.T])
    means = means[count >= _FEWEST]
    n = len(means)
    if n < _FEWEST:
        return 1.0
    excess = float(np.sqrt(np.mean(means ** 2, axis=0).max()))
    by_chance = np.sqrt(scipy.stats.chi2.isf(_CHANCE, n) / n)
    return excess if excess > max(_EXCESS, by_chance) else 1.0


def widen(samples: np.ndarray, wander: dict[str, float]) -> None:
    """Make the standard deviations of smoothed samples as much larger as innovations wander, or
    deviations from a surface.

    What a receiver or a surface says bears on all. The field bears on headings: gravity tells the
    tilt.

    Args:
        samples: of a SmootherResult, in place. wander: name -> factor.
    """
    every = max((f for name, f in wander.items() if name != "mag"), default=1.0)
    for name in ("cov_position", "cov_velocity", "cov_attitude"):
        samples[name] *= every ** 2
    for name in ("acc_bias_sd", "gyr_bias_sd"):
        samples[name] *= every
    field = wander.get("mag", 1.0)
    if field > every:
        up = scipy.spatial.transform.Rotation.from_quat(samples["quat_world_imu"]).as_matrix()[:, 2]
        heading = np.einsum("ni,nij,nj->n", up, samples["cov_attitude"], up)
        more = ((field / every) ** 2 - 1.0) * heading
        samples["cov_attitude"] += more[:, None, None] * up[:, :, None] * up[:, None]
