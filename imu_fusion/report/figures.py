"""Figures over time in one style: panels below each other on one time axis.

A panel is a list of :class:`Line` and :class:`Band`; colours mean the same in
every figure of a report.
"""

import html
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from imu_fusion.report.decimate import decimate, envelope

# Okabe and Ito's palette: told apart with any colour vision.
AXES = {"x": "#D55E00", "y": "#009E73", "z": "#0072B2"}
ESTIMATE = "#0072B2"
REFERENCE = "#1f2933"
BAND = "#56B4E9"
LIGHT = "#a9cfe8"
HIGHLIGHT = "#D55E00"
SECONDARY = "#CC79A7"
NEUTRAL = "#7b8794"
SERIES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7b8794")
_INK, _GRID = "#39444f", "#e8ecf1"


@dataclass(frozen=True, eq=False)
class Line:
    """A signal: ``time`` (n,) s, ``values`` (n,) in the panel's unit, NaN for breaks."""

    name: str
    time: np.ndarray
    values: np.ndarray
    color: str
    dash: str = "solid"
    width: float = 1.4
    markers: bool = False


@dataclass(frozen=True, eq=False)
class Band:
    """An area between ``low`` and ``high`` (n,)."""

    name: str
    time: np.ndarray
    low: np.ndarray
    high: np.ndarray
    color: str = BAND
    opacity: float = 0.35


@dataclass(frozen=True)
class Panel:
    """What stands over one vertical axis; ``label`` names quantity and unit."""

    label: str
    items: tuple
    log: bool = False
    from_zero: bool = False


def plain(text):
    """Text from outside for plotly, which reads a subset of HTML in names and labels."""
    return html.escape(str(text), quote=False)


def time_figure(panels, shaded=(), shaded_name="", panel_height=205):
    """Panels below each other over one time axis in seconds.

    Args:
        panels: list of Panel.
        shaded: list of (start, end) s to be marked in every panel.
        shaded_name: what they mean, for the legend.
        panel_height: pixels of one panel.
    """
    figure = make_subplots(rows=len(panels), cols=1, shared_xaxes=True,
                           vertical_spacing=0.12 / max(len(panels), 3))
    named = set()
    for row, panel in enumerate(panels, start=1):
        for item in panel.items:
            for trace in _traces(item, named):
                figure.add_trace(trace, row=row, col=1)
        figure.update_yaxes(type="log" if panel.log else "linear",
                            rangemode="tozero" if panel.from_zero else "normal", row=row, col=1)
        # Axis titles would stand at a distance that depends on their tick labels.
        figure.add_annotation(text=panel.label, textangle=-90, showarrow=False, xref="paper", x=0,
                              xshift=-62, yref=f"y{row if row > 1 else ''} domain", y=0.5,
                              xanchor="center", yanchor="middle", font=dict(size=13))
    if len(shaded):
        _shade(figure, shaded, shaded_name)
    figure.update_layout(
        height=int(95 + panel_height * len(panels)),
        margin=dict(l=84, r=18, t=52, b=48), template="none", hovermode="x unified",
        font=dict(family="system-ui, Segoe UI, Roboto, Helvetica, Arial, sans-serif", size=13,
                  color=_INK),
        legend=dict(orientation="h", x=0, xanchor="left", y=1, yref="container", yanchor="top",
                    font=dict(size=13), itemsizing="constant"),
        hoverlabel=dict(font=dict(size=12)))
    figure.update_xaxes(gridcolor=_GRID, zeroline=False, linecolor="#c5ced8", showline=True,
                        ticks="outside", tickcolor="#c5ced8", hoverformat=".3f", matches="x")
    figure.update_yaxes(gridcolor=_GRID, zerolinecolor="#c5ced8", zerolinewidth=1,
                        linecolor="#c5ced8", showline=True, nticks=6)
    figure.update_xaxes(title=dict(text="time since start in s", font=dict(size=13), standoff=6),
                        row=len(panels), col=1)
    return figure


def intervals(time, mask):
    """The stretches [(start, end)] s over which ``mask`` (n,) bool at ``time`` (n,) is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    last = len(time) - 1
    return [(float(time[a]), float(time[min(b, last)])) for a, b in zip(edges[::2], edges[1::2])]


def break_wraps(angle_deg):
    """Angles (n,) with NaN where they jump by more than half a turn, so that no line is drawn."""
    result = np.array(angle_deg, dtype=np.float64)
    result[1:][np.abs(np.diff(result)) > 180.0] = np.nan
    return result


def _traces(item, named):
    first = item.name not in named
    named.add(item.name)
    common = dict(name=plain(item.name), legendgroup=item.name, showlegend=first)
    if isinstance(item, Band):
        time, low, high = envelope(item.time, item.low, item.high)
        if len(time) == 0:
            return []
        red, green, blue = (int(item.color[i:i + 2], 16) for i in (1, 3, 5))
        return [go.Scatter(
            x=_compact(np.concatenate([time, time[::-1]])),
            y=_compact(np.concatenate([high, low[::-1]])), mode="lines", line=dict(width=0),
            fill="toself", fillcolor=f"rgba({red},{green},{blue},{item.opacity})",
            hoverinfo="skip", **common)]
    time, values = decimate(item.time, item.values)
    return [go.Scatter(
        x=_compact(time), y=_compact(values), mode="markers" if item.markers else "lines",
        line=dict(color=item.color, width=item.width, dash=item.dash, simplify=False),
        marker=dict(color=item.color, size=4), hovertemplate="%{y:.4g}", **common)]


def _shade(figure, shaded, name):
    # One trace draws the legend entry, shapes the areas: shapes span the panels at any zoom.
    for start, end in shaded[:200]:
        figure.add_vrect(x0=start, x1=end, fillcolor=NEUTRAL, opacity=0.11, line_width=0,
                         layer="below", row="all", col=1)
    figure.add_trace(go.Scatter(
        x=[None], y=[None], mode="markers", name=name,
        marker=dict(symbol="square", size=12, color="rgba(123,135,148,0.3)")), row=1, col=1)


def _compact(values):
    """float32 is exact to a hundredth of a pixel and half the size."""
    return np.asarray(values, dtype=np.float32)
