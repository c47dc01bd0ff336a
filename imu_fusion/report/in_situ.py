"""The accelerometer before and after its calibration by the terrain: Winkler 2025, section 5."""

from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from imu_fusion.estimation.avalanche.dead_reckoning import BallSamples, dead_reckon
from imu_fusion.estimation.avalanche.in_situ import (
    Constraint,
    InSituCalibration,
    calibrate_in_situ,
    sweep,
)
from imu_fusion.report import figures as fig
from imu_fusion.report.html import Block, Figure, Table
from imu_fusion.report.overview import number

_RHOS = np.logspace(-3.0, 1.0, 17)


@dataclass(frozen=True, eq=False)
class Reckoned:
    """Dead reckoning of ``samples`` in the slope frame ``axes`` (3, 3): positions (n, 3) m with the
    forces as recorded (``before``) and as the terrain calibrates them (``after``)."""

    samples: BallSamples
    axes: np.ndarray
    constraint: Constraint
    calibration: InSituCalibration
    before: np.ndarray
    after: np.ndarray


def reckon(samples: BallSamples, axes: np.ndarray, gravity: float, at_rest: float) -> Reckoned:
    """Reckoned.

    Args:
        samples: from rest on, with forces as recorded. axes: (3, 3), columns longitudinal, lateral,
            transverse. gravity: m/s^2, of the place; at_rest: norm of the force at rest, which is
            what is taken off before the calibration.

    Raises:
        CalibrationError: too few samples.
    """
    constraint = Constraint(axes[:, 2], gravity)
    found = calibrate_in_situ(samples, constraint)
    return Reckoned(samples, axes, constraint, found, dead_reckon(samples, at_rest).position @ axes,
                    dead_reckon(found.apply(samples), gravity).position @ axes)


def in_situ_blocks(reckoned: Reckoned) -> list[Block]:
    """What the calibration found, and what regularisation does to it."""
    found = reckoned.calibration
    off = [float(np.sqrt(np.mean(place[:, 2] ** 2))) for place in (reckoned.before, reckoned.after)]
    rows = [*((f"A, row {axis}", ", ".join(f"{v:.4f}" for v in row))
              for axis, row in zip("xyz", found.matrix)),
            ("b, m/s\u00b2", ", ".join(f"{v:.3f}" for v in found.bias)),
            ("off the slope before, after, RMS", f"{number(off[0], 2)} m, {number(off[1], 2)} m"),
            ("condition", number(found.condition, 0))]
    return [Table(("accelerometer, a = A a~ + b", ""), tuple(rows), "Calibrated by the terrain "
                  "alone: the position along its normal is kept small, as the paper has it (model "
                  f"2, \u03c1 = {reckoned.constraint.rho:g}, up to the first gap). The smoothed "
                  "trajectory does not use it: it has the same parameters as states."),
            Figure(_sweep(reckoned), "The same over the regularisation \u03c1: what is minimised "
                   "and how far the track leaves the slope, both of which never fall with \u03c1, "
                   "and the condition of the equations.", linked=False)]


def _sweep(reckoned):
    found = sweep(reckoned.samples, reckoned.constraint, list(_RHOS))
    figure = make_subplots(rows=3, cols=1, shared_xaxes=True, vertical_spacing=0.05)
    for row, (name, label, color) in enumerate((
            ("objective", "objective, m\u00b2", fig.ESTIMATE),
            ("violation", "off slope, m", fig.HIGHLIGHT),
            ("condition", "condition", fig.REFERENCE)), 1):
        figure.add_trace(go.Scatter(
            x=np.float32(_RHOS), y=np.float32(np.array([getattr(f, name) for f in found])),
            name=name, mode="lines+markers", line=dict(color=color, width=1.5)), row=row, col=1)
        figure.update_yaxes(title_text=label, row=row, col=1)
    fig.style(figure, height=520)
    figure.update_layout(showlegend=False)
    figure.update_xaxes(type="log")
    figure.update_xaxes(title_text="\u03c1", row=3, col=1)
    figure.update_yaxes(type="log")
    return figure
