"""Whether innovations are as white as the covariances take them to be.

Their size alone may fit while they wander: a step of the height datum, multipath, biases that
drift faster than stated. Means over seconds then are larger than white noise leaves them, and all
that rests on averaging is less certain by as much.
"""

import numpy as np
import scipy  # its parts are loaded where they are first used

_BLOCK = 5_000_000_000   # ns, the shortest time over which innovations are averaged
_FEWEST = 3              # innovations in a block, and blocks
_LARGEST = 6.0           # standard deviations, to which single ones are cut: outliers are no drift
_EXCESS = 1.6            # simulated jumps and drives with the right noise: up to 1.4
_CORRELATED = 0.3        # neighbours; simulated jumps and drives with the right noise: up to 0.2
_CHANCE = 1e-3           # of white noise to be called wandering


def wandering(stamp: np.ndarray, innovations: np.ndarray) -> float:
    """RMS of the means over some time by what white noise leaves, of the component that wanders
    most, over the time from 5 s to a third of the recording for which it is largest; 1 where that
    may be chance. Errors that last a minute hardly show in means over seconds, and yet a smoothed
    position is off by them.

    Args:
        stamp: (n,) ns. innovations: (n, k), normalised.
    """
    cut = np.clip(innovations, -_LARGEST, _LARGEST)
    times, time = [], _BLOCK
    while len(stamp) and stamp[-1] - stamp[0] >= (_FEWEST - 1) * time:
        times.append(time)
        time *= 2
    return max((_excess((stamp - stamp[0]) // time, cut, len(times)) for time in times),
               default=1.0)


def _excess(block, values, tries):
    """RMS of the means in blocks, of the component in which it is largest; 1 by chance, which has
    a number of tries."""
    block = np.unique(block, return_inverse=True)[1]
    count = np.bincount(block)
    means = np.column_stack([np.bincount(block, c) / np.sqrt(count) for c in values.T])
    means = means[count >= _FEWEST]
    n = len(means)
    if n < _FEWEST:
        return 1.0
    excess = float(np.sqrt(np.mean(means ** 2, axis=0).max()))
    by_chance = np.sqrt(scipy.stats.chi2.isf(_CHANCE / (tries * values.shape[1]), n) / n)
    return excess if excess > max(_EXCESS, by_chance) else 1.0


def correlation(innovations: np.ndarray) -> float:
    """Autocorrelation of neighbours, of the component for which it is largest; 0 where that may be
    chance.

    It does not depend on what is stated: a receiver that states metres, is better in each fix, and
    errs the same way for a minute, leaves innovations that are small, and a trajectory that is
    surer than its fixes allow. Those that are smaller than the mean of all is sure do no harm.

    Args:
        innovations: (n, k), normalised.
    """
    n = len(innovations)
    cut = np.clip(innovations, -_LARGEST, _LARGEST)
    products = np.sum(cut[1:] * cut[:-1], axis=0)
    squares = np.sum(cut ** 2, axis=0)
    largest = float(np.max(products / np.maximum(squares, 1.0), initial=0.0, where=squares > 1.0))
    by_chance = scipy.stats.norm.isf(_CHANCE) / np.sqrt(max(n, 1))
    return largest if largest > max(_CORRELATED, by_chance) else 0.0


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
