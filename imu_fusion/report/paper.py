"""The figures of a report for a paper: SVG, PDF or PNG, as wide as a column.

Each plotly figure is read and drawn anew by matplotlib, so that a section describes its figures
once. What is read is what the sections use: lines, markers, filled bands, shaded spans, surfaces.
"""

import html
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from imu_fusion.errors import ImuFusionError
from imu_fusion.recordings.targets import whole_file
from imu_fusion.report.html import Figure, Section

COLUMN_WIDTH = 3.5      # inches: 89 mm, a column of most journals
_PANEL, _REST = 0.95, 0.65    # inches of height: of a panel over time, of legend and labels
_POINTS = 6.5           # of the text
_LETTERS, _HANDLE = 58, 5     # that a column is wide, and that stand for a line in a legend
_LINE = 0.6             # points of a line for each of plotly's pixels
_STYLES = {"solid": "-", "dot": ":", "dash": "--", "dashdot": "-."}
SETTINGS: Any = {
    "font.size": _POINTS, "axes.linewidth": 0.5, "xtick.major.width": 0.5,
    "ytick.major.width": 0.5, "xtick.major.size": 2.0, "ytick.major.size": 2.0,
    "svg.fonttype": "none", "pdf.fonttype": 42, "text.parse_math": False, "savefig.dpi": 600}


def write_figures(sections: Sequence[Section], folder: str | Path, form: str = "svg"
                  ) -> list[Path]:
    """Write every figure of a report.

    Args:
        sections: of the report.
        folder: made if it is missing.
        form: ``svg``, ``pdf`` or ``png``.

    Returns:
        the files, named after their sections.

    Raises:
        ImuFusionError: a file cannot be written.
    """
    written = []
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ImuFusionError(f"{folder}: figures cannot be written ({error.strerror})") from None
    for section in sections:
        figures = [block.figure for block in section.blocks if isinstance(block, Figure)]
        stem = re.sub(r"[^a-z0-9]+", "_", section.title.lower()).strip("_")
        for number, figure in enumerate(figures, 1):
            file = Path(folder) / f"{stem}{f'_{number}' if len(figures) > 1 else ''}.{form}"
            with rc_context(SETTINGS), whole_file(file) as part:
                draw(figure).savefig(part)
            written.append(file)
    return written


def draw(figure: go.Figure) -> Canvas:
    """A matplotlib figure of a plotly one."""
    traces = [trace for trace in figure.data if trace.visible is not False]
    if any(trace.type in ("scatter3d", "surface") for trace in traces):
        return _draw_space(figure, traces)
    axes = [key.removeprefix("yaxis") for key in figure.layout.to_plotly_json()
            if re.fullmatch(r"yaxis\d*", key)]
    one_scale = figure.layout.yaxis.scaleanchor is not None
    height = COLUMN_WIDTH if one_scale else _REST + _PANEL * len(axes)
    canvas = Canvas((COLUMN_WIDTH, height), layout="constrained")
    panels = dict(zip(axes, np.ravel(canvas.subplots(len(axes), 1, sharex=True, squeeze=False))))
    for trace in traces:
        _draw_trace(canvas, panels[(trace.yaxis or "y").removeprefix("y")], trace)
    for number, panel in panels.items():
        _draw_frame(panel, figure, number, traces)
        if one_scale:
            panel.set_aspect("equal", "datalim")
    _draw_legend(canvas, list(panels.values()))
    return canvas


def _draw_trace(canvas: Canvas, panel: Axes, trace: Any) -> None:
    if trace.x is None or not len(trace.x) or trace.x[0] is None:    # a legend entry of a span
        return
    x, y = np.asarray(trace.x, float), np.asarray(trace.y, float)
    label = _text(trace.name) if trace.name and trace.showlegend is not False else None
    mode = trace.mode or "lines"
    if trace.fill == "toself":
        parts = np.split(np.arange(len(x)), np.flatnonzero(np.isnan(x)))
        colour, opacity = _rgba(trace.fillcolor)
        for part in parts:
            panel.fill(x[part], y[part], color=colour, alpha=opacity, linewidth=0.0, label=label)
            label = None
        return
    if "lines" in mode:
        panel.plot(x, y, color=trace.line.color, linewidth=_LINE * (trace.line.width or 1.4),
                   linestyle=_STYLES.get(trace.line.dash or "solid", "-"),
                   label=None if "markers" in mode else label)
    if "markers" in mode:
        _draw_markers(canvas, panel, trace, (x, y), label)
    for at_x, at_y, text in zip(x, y, trace.text or () if "text" in mode else ()):
        panel.annotate(_text(text), (at_x, at_y), xytext=(2, 3), textcoords="offset points")


def _draw_markers(canvas, panel, trace, places, label):
    """``places``: x, y and perhaps z, (n,) each."""
    marker = trace.marker
    of_speed = marker.color is not None and not isinstance(marker.color, str)
    size = float(np.clip(600.0 / max(len(places[0]), 1), 1.5, 6.0))    # few are to be seen, too
    shown = panel.scatter(
        *places, s=size, c=marker.color if marker.color is not None else trace.line.color,
        cmap="viridis" if of_speed else None, label=label, linewidths=0.0, rasterized=True,
        alpha=marker.opacity)
    if of_speed and marker.colorbar.title.text:
        canvas.colorbar(shown, ax=panel, label=marker.colorbar.title.text, shrink=0.8)


def _draw_frame(panel, figure, number, traces):
    """Labels, spans and grid of one panel."""
    layout = figure.layout
    reference = f"y{number} domain"
    for note in layout.annotations:
        if note.yref == reference and note.textangle == -90:
            panel.set_ylabel(_text(note.text))
        elif note.yref == reference:
            panel.text(0.01, 0.04, _text(note.text), transform=panel.transAxes)
    for axis, name in ((layout[f"xaxis{number}"], "x"), (layout[f"yaxis{number}"], "y")):
        if axis.title.text:
            panel.set(**{f"{name}label": _text(axis.title.text)})
        if axis.type == "log":
            panel.set(**{f"{name}scale": "log"})
    if layout[f"yaxis{number}"].rangemode == "tozero":
        panel.set_ylim(bottom=0.0)
    for shape in layout.shapes:
        panel.axvspan(shape.x0, shape.x1, color=shape.fillcolor, alpha=shape.opacity,
                      linewidth=0.0)
    for trace in traces:    # of spans, which have a colour and no place
        if trace.x is not None and len(trace.x) and trace.x[0] is None:
            colour, opacity = _rgba(trace.marker.color)
            panel.fill([], [], color=colour, alpha=opacity, label=_text(trace.name))
    panel.grid(color="#e8ecf1", linewidth=0.4)
    panel.set_axisbelow(True)
    panel.margins(x=0.0)


def _draw_legend(canvas, panels):
    entries: dict[str, Any] = {}
    for panel in panels:
        for handle, label in zip(*panel.get_legend_handles_labels()):
            entries.setdefault(label, handle)
    if entries:
        columns = _legend_columns(list(entries))
        # Columns are filled one by one; read they are in rows.
        order = [i for column in range(columns) for i in range(column, len(entries), columns)]
        labels = [textwrap.fill(label, _LETTERS - _HANDLE) for label in entries]
        canvas.legend(*([kind[i] for i in order] for kind in (list(entries.values()), labels)),
                      loc="outside upper center", ncols=columns, frameon=False, handlelength=1.4,
                      columnspacing=1.0, markerscale=2.0)


def _legend_columns(labels: list[str]) -> int:
    """As many columns as stand beside each other."""
    return next((columns for columns in (3, 2) if sum(
        _HANDLE + max(map(len, labels[column::columns]), default=0)
        for column in range(columns)) <= _LETTERS), 1)


def _draw_space(figure, traces):
    canvas = Canvas((COLUMN_WIDTH, COLUMN_WIDTH), layout="constrained")
    panel = canvas.add_subplot(projection="3d")
    for trace in traces:
        places = [np.asarray(getattr(trace, axis), float) for axis in "xyz"]
        label = _text(trace.name) if trace.name and trace.showlegend is not False else None
        if trace.type == "surface":
            panel.plot_surface(*places, color=trace.colorscale[0][1], alpha=0.5, linewidth=0.0)
            continue
        mode = trace.mode or "lines"
        colour = trace.line.color
        if "lines" in mode and isinstance(colour, str):
            panel.plot(*places, color=colour, linewidth=0.8, label=label)
        elif "lines" in mode:
            shown = panel.scatter(*places, s=1.0, c=colour, cmap="viridis", label=label)
            canvas.colorbar(shown, ax=panel, shrink=0.5, pad=0.2,
                            label=trace.line.colorbar.title.text)
        if mode.startswith("markers"):
            _draw_markers(canvas, panel, trace, places, label)
    scene = figure.layout.scene
    for axis in "xyz":
        title = scene[f"{axis}axis"].title.text
        panel.set(**{f"{axis}label": _text(title or axis)})
    ratio = scene.aspectratio
    if scene.aspectmode == "manual":
        panel.set_box_aspect([ratio.x, ratio.y, ratio.z])
    _draw_legend(canvas, [panel])
    return canvas


def _text(text):
    """Text as it is: plotly reads HTML."""
    return html.unescape(str(text))


def _rgba(colour):
    """(colour, opacity) of rgba(r,g,b,a)."""
    red, green, blue, opacity = (float(v) for v in re.findall(r"[\d.]+", colour))
    return (red / 255, green / 255, blue / 255), opacity
