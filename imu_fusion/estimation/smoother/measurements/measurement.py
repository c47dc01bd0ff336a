"""What every measurement has in common."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.records import READING
from imu_fusion.geometry.geodesy import LocalFrame


@dataclass(frozen=True)
class Readings:
    """Readings of one measurement: stamps (m,) ns, values (m, k), lower roots of their covariances
    (m, k, k), and the squared scale of their Cauchy loss (inf: squared loss)."""

    stamp: np.ndarray
    value: np.ndarray
    root: np.ndarray
    loss: float

    def records(self, kind: int) -> np.ndarray:
        """Records (m,) of READING. Whitening by the inverse of the root keeps the rows of one
        reading independent."""
        width = self.value.shape[1]
        records = np.zeros(len(self.stamp), READING)
        records["stamp"], records["kind"], records["loss"] = self.stamp, kind, self.loss
        records["value"][:, :width] = self.value
        records["whiten"][:, :width, :width] = np.tril(np.linalg.inv(self.root))
        return records


@dataclass(frozen=True)
class Measurement:
    """One kind of measurement.

    ``name`` of its log in Smoother.run, its innovations and its misfit. ``title`` and
    ``components`` are for reports. ``prepare(log, frame, params)`` makes Readings of those
    readings that are fit for use. ``delays``: names of the states, whose sum (s) its stamps are
    late. ``advice``: what may be wrong when readings do not fit.
    """

    name: str
    title: str
    components: Sequence[str]
    prepare: Callable[[Any, LocalFrame, SmootherParams], Readings]
    advice: str
    delays: Sequence[str] = ()


def squared_scale(of: Any) -> float:
    """Readings.loss of a group of parameters with ``loss`` and ``loss_scale``."""
    return of.loss_scale ** 2 if of.loss == "cauchy" else np.inf
