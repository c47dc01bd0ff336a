"""Long signals made short for plotting, with every extreme kept."""

import numpy as np

# Points of one line: two for each column of a figure, few enough for a browser and a file of 2 MB.
POINTS = 2400


def decimate(time: np.ndarray, values: np.ndarray, points: int = POINTS
             ) -> tuple[np.ndarray, np.ndarray]:
    """The least and the greatest sample of every stretch of a signal, in order.

    Args:
        time: (n,) increasing.
        values: (n,), NaN where a line shall break.
        points: what comes back has at most this many.

    Returns:
        (time, values): a subset of the samples, with one NaN wherever some are left out.
    """
    time, values = np.asarray(time), np.asarray(values)
    n = len(values)
    if n <= points:
        return time, values
    length = -(-n // (points // 3))
    bins = -(-n // length)
    padded = np.full(bins * length, np.nan)
    padded[:n] = values
    blocks = padded.reshape(bins, length)
    absent = np.isnan(blocks)
    low = np.argmin(np.where(absent, np.inf, blocks), axis=1)
    high = np.argmax(np.where(absent, -np.inf, blocks), axis=1)
    pair = np.column_stack([low, high]) + np.arange(bins)[:, None] * length
    index = np.unique(pair[~absent.all(axis=1)])
    holes = np.flatnonzero(np.isnan(values))
    if len(holes) and len(index):
        # The first hole after each kept sample breaks the line to the next one.
        after = np.searchsorted(holes, index)
        after = holes[after[after < len(holes)]]
        index = np.unique(np.concatenate([index, after]))
    return time[index], values[index]


def envelope(time: np.ndarray, low: np.ndarray, high: np.ndarray, points: int = POINTS
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A band made short: the lowest ``low`` and highest ``high`` of every stretch.

    Args:
        time, low, high: (n,); rows with NaN are left out.
        points: what comes back has at most this many.

    Returns:
        (time, low, high)
    """
    time, low, high = (np.asarray(a, dtype=np.float64) for a in (time, low, high))
    keep = np.isfinite(low) & np.isfinite(high)
    time, low, high = time[keep], low[keep], high[keep]
    n = len(time)
    if n <= points:
        return time, low, high
    edges = np.arange(0, n, -(-n // points))
    middle = 0.5 * (time[edges] + time[np.append(edges[1:], n) - 1])
    return middle, np.minimum.reduceat(low, edges), np.maximum.reduceat(high, edges)
