"""Figures over time in one style: panels below each other on one time axis.

A panel is a list of :class:`Line` and :class:`Band`; colours mean the same in
every figure of a report.
"""

import html
from collections.abc import Iterable, Sequence
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
_INK, _GRID, _AXIS = "#39444f", "#e8ecf1", "#c5ced8"


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
    """An area between ``low`` and ``high`` (n,), left out where it is wider than ``widest`` or
    jumps by more: what wraps around or is not determined has no band."""

    name: str
    time: np.ndarray
    low: np.ndarray
    high: np.ndarray
    color: str = BAND
    opacity: float = 0.35
    widest: float = np.inf


@dataclass(frozen=True)
class Panel:
    """What stands over one vertical axis; ``label`` names quantity and unit, ``title`` (text
    from outside) stands in the lower left corner."""

    label: str
    items: tuple[Line | Band, ...]
    title: str = ""
    from_zero: bool = False


@dataclass(frozen=True)
class Shade:
    """Spans [(start, end)] s that are marked in every panel; ``name`` is for the legend."""

    name: str
    spans: tuple[tuple[float, float], ...]
    color: str = NEUTRAL
    opacity: float = 0.11


def plain(text: object) -> str:
    """Text from outside for plotly, which reads a subset of HTML in names and labels."""
    return html.escape(str(text), quote=False)


def time_figure(panels: Sequence[Panel], shades: Sequence[Shade] = (), panel_height: int = 205
                ) -> go.Figure:
    """Panels below each other over one time axis in seconds.

    Args:
        panels: list of Panel.
        shades: sequence of Shade.
        panel_height: pixels of one panel.
    """
    figure = make_subplots(rows=len(panels), cols=1, shared_xaxes=True,
                           vertical_spacing=0.12 / max(len(panels), 3))
    named: set[str] = set()
    for row, panel in enumerate(panels, start=1):
        for item in panel.items:
            for trace in _traces(item, named):
                figure.add_trace(trace, row=row, col=1)
        figure.update_yaxes(rangemode="tozero" if panel.from_zero else "normal", row=row, col=1)
        # Axis titles would stand at a distance that depends on their tick labels.
        figure.add_annotation(text=panel.label, textangle=-90, showarrow=False, xref="paper", x=0,
                              xshift=-62, yref=f"y{row if row > 1 else ''} domain", y=0.5,
                              xanchor="center", yanchor="middle", font=dict(size=13))
        if panel.title:
            figure.add_annotation(text=plain(panel.title), showarrow=False, xref="paper", x=0,
                                  xshift=6, yref=f"y{row if row > 1 else ''} domain", y=0.04,
                                  xanchor="left", yanchor="bottom", font=dict(size=12),
                                  bgcolor="rgba(255,255,255,0.75)")
    for shade in shades:
        _shade(figure, shade, _duration(panels))
    style(figure, height=int(95 + panel_height * len(panels)))
    figure.update_layout(
        hovermode="x unified", hoverlabel=dict(font=dict(size=12)),
        # Above the panels, at the same distance in pixels however many there are.
        legend=dict(orientation="h", x=0, xanchor="left", yanchor="bottom",
                    y=1 + 12 / (panel_height * len(panels) - 5), font=dict(size=13),
                    itemsizing="constant"))
    figure.update_xaxes(zeroline=False, hoverformat=".3f", matches="x")
    figure.layout.xaxis.matches = None    # the one that the others match
    figure.update_yaxes(nticks=6)
    figure.update_xaxes(title=dict(text="time since start in s", font=dict(size=13), standoff=6),
                        row=len(panels), col=1)
    return figure


def style(figure: go.Figure, height: int) -> None:
    """Fonts, margins, grid and axes that all figures share. height: pixels."""
    figure.update_layout(
        height=height, margin=dict(l=84, r=18, t=52, b=48), template="none",
        font=dict(family="system-ui, Segoe UI, Roboto, Helvetica, Arial, sans-serif", size=13,
                  color=_INK))
    line = dict(gridcolor=_GRID, linecolor=_AXIS, showline=True, zerolinecolor=_AXIS,
                zerolinewidth=1, title_font=dict(size=13))
    figure.update_xaxes(ticks="outside", tickcolor=_AXIS, **line)
    figure.update_yaxes(**line)


def intervals(time: np.ndarray, mask: np.ndarray) -> list[tuple[float, float]]:
    """The stretches [(start, end)] s over which ``mask`` (n,) bool at ``time`` (n,) is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    last = len(time) - 1
    return [(float(time[a]), float(time[min(b, last)])) for a, b in zip(edges[::2], edges[1::2])]


def break_wraps(angle_deg: np.ndarray) -> np.ndarray:
    """Angles (n,) with NaN where they jump by more than half a turn, so that no line is drawn."""
    result = np.array(angle_deg, dtype=np.float64)
    result[1:][np.abs(np.diff(result)) > 180.0] = np.nan
    return result


def break_gaps(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A signal with NaN put into its gaps: intervals of more than ten usual ones."""
    step = np.diff(time)
    if len(step) == 0:
        return time, values
    gaps = np.flatnonzero(step > 10 * np.median(step)) + 1
    if len(gaps) == 0:
        return time, values
    return (np.insert(np.asarray(time, dtype=np.float64), gaps, time[gaps - 1]),
            np.insert(np.asarray(values, dtype=np.float64), gaps, np.nan))


def _traces(item, named):
    first = item.name not in named
    named.add(item.name)
    common = dict(name=plain(item.name), legendgroup=item.name, showlegend=first)
    if isinstance(item, Band):
        x, y = _outline(*envelope(item.time, item.low, item.high), item.widest)
        if len(x) == 0:
            return []
        red, green, blue = _rgb(item.color)
        return [go.Scatter(
            x=_compact(x), y=_compact(y), mode="lines", line=dict(width=0),
            fill="toself", fillcolor=f"rgba({red},{green},{blue},{item.opacity})",
            hoverinfo="skip", **common)]
    time, values = decimate(*break_gaps(item.time, item.values))
    return [go.Scatter(
        x=_compact(time), y=_compact(values), mode="markers" if item.markers else "lines",
        line=dict(color=item.color, width=item.width, dash=item.dash, simplify=False),
        marker=dict(color=item.color, size=4), hovertemplate="%{y:.4g}", **common)]


def _outline(time, low, high, widest):
    """(x, y) of the outlines around a band, one for each stretch, with NaN between them."""
    keep = high - low <= widest
    time, low, high = time[keep], low[keep], high[keep]
    if len(time) < 2:
        return time[:0], low[:0]
    step = np.diff(time)
    jump = np.abs(np.diff(low + high)) / 2
    breaks = np.flatnonzero((step > 10 * np.median(step)) | (jump > widest)) + 1
    x, y = [], []
    for part in np.split(np.arange(len(time)), breaks):
        back = part[::-1]
        x += [time[part], time[back], [np.nan]]
        y += [high[part], low[back], [np.nan]]
    return np.concatenate(x), np.concatenate(y)


def _duration(panels):
    """Length of the time axis, s."""
    times = [item.time for panel in panels for item in panel.items if len(item.time)]
    return max(float(t[-1]) for t in times) - min(float(t[0]) for t in times) if times else 0.0


def merged(spans: Iterable[tuple[float, float]], resolution: float
           ) -> list[tuple[float, float]]:
    """Spans in order, those less than ``resolution`` (s) apart as one, each at least as long."""
    result: list[tuple[float, float]] = []
    for start, end in sorted(spans):
        end = max(end, start + resolution)
        if result and start - result[-1][1] < resolution:
            result[-1] = (result[-1][0], max(end, result[-1][1]))
        else:
            result.append((start, end))
    return result


def _shade(figure, shade, duration):
    # One trace draws the legend entry, shapes the areas: shapes span the panels at any zoom.
    # A thousandth of the axis is about a pixel.
    spans = merged(shade.spans, duration / 1000.0)
    if not spans:
        return
    shapes = [dict(type="rect", xref="x", yref="paper", x0=start, x1=end, y0=0, y1=1,
                   fillcolor=shade.color, opacity=shade.opacity, line=dict(width=0),
                   layer="below") for start, end in spans]
    figure.update_layout(shapes=[*(figure.layout.shapes or ()), *shapes])
    red, green, blue = _rgb(shade.color)
    figure.add_trace(go.Scatter(
        x=[None], y=[None], mode="markers", name=shade.name,
        marker=dict(symbol="square", size=12, color=f"rgba({red},{green},{blue},0.35)")),
        row=1, col=1)


def _rgb(color):
    return tuple(int(color[i:i + 2], 16) for i in (1, 3, 5))


def _compact(values):
    """float32 is exact to a hundredth of a pixel and half the size."""
    return np.asarray(values, dtype=np.float32)
