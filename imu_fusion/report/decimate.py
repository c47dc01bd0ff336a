"""Long signals made short for plotting, with every extreme kept."""

import numpy as np

# Points of one line: more than a screen has columns, few enough for a browser and a file.
POINTS = 3000


def decimate(time, values, points=POINTS):
    """The least and the greatest sample of every stretch of a signal, in order.

    Args:
        time: (n,) increasing.
        values: (n,), NaN where there is nothing; a stretch of NaN stays a break in the line.
        points: what comes back has at most this many.

    Returns:
        (time, values): a subset of the samples.
    """
    time, values = np.asarray(time), np.asarray(values)
    n = len(values)
    if n <= points:
        return time, values
    length = -(-n // (points // 2))
    bins = -(-n // length)
    padded = np.full(bins * length, np.nan)
    padded[:n] = values
    blocks = padded.reshape(bins, length)
    absent = np.isnan(blocks)
    empty = absent.all(axis=1)
    low = np.argmin(np.where(absent, np.inf, blocks), axis=1)
    high = np.argmax(np.where(absent, -np.inf, blocks), axis=1)
    pair = np.sort(np.column_stack([low, high]), axis=1) + np.arange(bins)[:, None] * length
    # A stretch of NaN has one point: that is enough to break the line.
    pair[empty, 1] = pair[empty, 0]
    index = np.unique(pair)
    return time[index], values[index]


def envelope(time, low, high, points=POINTS):
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
