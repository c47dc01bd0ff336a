"""Axes at the end of their range: rates that were lost there. Where that is, nobody given it,
:mod:`imu_fusion.samples.flat_tops` finds.

**Recovery** is Winkler 2025, appendix B: sample by sample and as the paper has it, fit for single
missing samples of a slow gyroscope beside a quiet magnetometer. Whole bursts are better solved at
once, by the orientation estimator's own saturation states (method ``fusion``).
"""

import numpy as np
from numpy.typing import ArrayLike

from imu_fusion.errors import SampleError
from imu_fusion.samples.flat_tops import LIMIT_TOLERANCE


def saturated_axes(gyr: np.ndarray, limit: ArrayLike) -> np.ndarray:
    """Mask (n, 3) of rates gyr (n, 3) rad/s at their limit, scalar or (3,) rad/s."""
    return np.asarray(np.abs(gyr) >= np.asarray(limit, dtype=float) * (1.0 - LIMIT_TOLERANCE))


def recover_rates(stamp: np.ndarray, gyr: np.ndarray, mag: np.ndarray,
                  missing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Missing rates from the change of the field in imu axes.

    The normalised field b obeys ``db/dt = b x omega`` (B.3, with [b]x and not its
    derivative as printed); with the rates of the axes that are not at their limit
    this is a least-squares problem per sample. Rotation about b changes nothing in b:
    a missing axis along the field stays poorly known.

    Args:
        stamp: (n,) int64 ns. gyr: (n, 3) rad/s, bias removed.
        mag: (n, 3) tesla, calibrated, at the same stamps (its delay removed).
        missing: (n, 3) bool, rates at their limit (:func:`saturated_axes`).

    Returns:
        rates (n, 3), and a mask (n,) of samples with all three axes missing, which stay
        as they were.

    Raises:
        SampleError: shapes differ, or fewer than two samples.
    """
    gyr, mag = np.asarray(gyr, dtype=float), np.asarray(mag, dtype=float)
    if (not gyr.shape == mag.shape == missing.shape == (len(stamp), 3)) or len(stamp) < 2:
        raise SampleError(f"recover_rates: stamps ({len(stamp)},), rates {gyr.shape}, field "
                          f"{mag.shape} and mask {missing.shape} must be (n,) and three times "
                          "(n, 3) with n of at least 2")
    b = mag / np.linalg.norm(mag, axis=1, keepdims=True)
    # Symmetric difference quotient, one-sided at the ends (B.4).
    n = len(stamp)
    after, before = np.minimum(np.arange(n) + 1, n - 1), np.maximum(np.arange(n) - 1, 0)
    change = (b[after] - b[before]) / ((stamp[after] - stamp[before]) * 1e-9)[:, None]
    rates = gyr.copy()
    lost = missing.all(axis=1)
    for i in np.flatnonzero(missing.any(axis=1) & ~lost):
        x, y, z = b[i]
        rows = np.vstack([[[0, -z, y], [z, 0, -x], [-y, x, 0]], np.eye(3)[~missing[i]]])
        rates[i] = np.linalg.lstsq(rows, np.concatenate([change[i], gyr[i][~missing[i]]]),
                                   rcond=None)[0]
    return rates, np.asarray(lost)
