"""Runs of samples that repeat a value: of a sensor that is stuck, at rest or at its limit."""

import numpy as np


def equal_runs(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number of the first sample and length, (k,) int each, of the k runs of samples that are equal
    in all of values (n, ...)."""
    changes = (values[1:] != values[:-1]).any(axis=tuple(range(1, values.ndim)))
    first = np.flatnonzero(np.append(True, changes)[:len(values)])
    return first, np.diff(np.append(first, len(values)))
