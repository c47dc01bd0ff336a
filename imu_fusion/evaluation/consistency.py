"""Whether errors are as large as their covariances say."""

import numpy as np


def nees(error: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Normalised estimation error squared: ``e' P^-1 e`` of each sample.

    Args:
        error: (n, k). cov: (n, k, k) in the same units, squared.

    Returns:
        (n,), k in the mean where the covariances are right (Bar-Shalom et al. 2001, 5.4.2).
    """
    return np.einsum("ni,ni->n", error, np.linalg.solve(cov, error[..., None])[..., 0])
