"""Lengths of jumps as estimated against lengths as measured: by video, or by the jury."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class JumpLengths:
    """n jumps: their ``names``, lengths ``estimated`` (n,), standard deviations ``sd`` (n,) and
    lengths ``measured`` (n,), all m."""

    names: tuple[str, ...]
    estimated: np.ndarray
    sd: np.ndarray
    measured: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """(n,) m, as in table 7 of Fang et al. 2020: estimated less measured."""
        return self.estimated - self.measured

    def rms(self, measuring_error: float = 0.0) -> float:
        """RMS of the errors, m (Fang et al. 2020, section 4.2); with the greatest error (m) that a
        measured length may have, the most that it can be."""
        return float(np.sqrt(np.mean((np.abs(self.error) + measuring_error) ** 2)))
