"""Figures for papers: each one of a report, as wide as a column, with what the report's shows."""

import re

import numpy as np
import plotly.graph_objects as go
import pytest
from matplotlib import rc_context

from imu_fusion.errors import ImuFusionError
from imu_fusion.report.figures import Band, Line, Panel, Shade, style, time_figure
from imu_fusion.report.html import Figure, Section, Text
from imu_fusion.report.paper import COLUMN_WIDTH, SETTINGS, draw, write_figures

T = np.linspace(0.0, 9.0, 400)


def over_time():
    gap = np.where((T > 3.0) & (T < 4.0), np.nan, np.sin(T))
    return time_figure([
        Panel("a in m", (Band("±1σ", T, gap - 0.1, gap + 0.1),
                         Line("price in $", T, gap, "#0072B2"),
                         Line("fixes", T, np.cos(T), "#D55E00", markers=True))),
        Panel("b in s", (Line("other", T, T, "#009E73", dash="dot"),), title="<raw>",
              from_zero=True)], [Shade("in the air", ((2.0, 5.0),))])


def in_space():
    figure = go.Figure([
        go.Surface(x=[[0, 1], [0, 1]], y=[[0, 0], [1, 1]], z=[[0, 0], [0, 0]],
                   colorscale=[[0, "#c9d3dc"], [1, "#c9d3dc"]], name="surface"),
        go.Scatter3d(x=T, y=T, z=T, mode="markers", name="fixes", marker=dict(color="#D55E00")),
        go.Scatter3d(x=T, y=-T, z=T, mode="lines", name="hidden", visible=False),
        go.Scatter3d(x=T, y=T, z=T, mode="lines", name="path", line=dict(
            color=T, colorscale="Viridis", colorbar=dict(title=dict(text="speed in m/s"))))])
    style(figure, 300)
    figure.update_layout(scene=dict(xaxis=dict(title="east in m")))
    return figure


def test_panels_have_the_lines_bands_spans_and_labels_of_the_report():
    canvas = draw(over_time())
    upper, lower = canvas.axes
    assert canvas.get_figwidth() == COLUMN_WIDTH
    assert (upper.get_ylabel(), lower.get_ylabel()) == ("a in m", "b in s")
    assert lower.get_xlabel() == "time since start in s" and lower.get_ylim()[0] == 0.0
    assert [text.get_text() for text in lower.texts] == ["<raw>"]
    (line,) = [found for found in upper.lines if found.get_label() == "price in $"]
    y = line.get_ydata()
    assert np.isnan(y).any() and np.nanmax(np.abs(y - np.sin(line.get_xdata()))) < 1e-6
    (entries,) = canvas.legends
    assert {text.get_text() for text in entries.get_texts()} == {
        "±1σ", "price in $", "fixes", "other", "in the air"}
    bands = [p for p in upper.patches if p.get_label() == "±1σ" or len(p.get_xy()) > 5]
    assert len(bands) == 2    # on both sides of the gap


@pytest.mark.parametrize("names, columns", [
    (["a", "b", "c", "d"], 3),
    (["σ of the specific force", "σ of the acceleration", "c"], 2),
    (["σ of the kinematic acceleration in the axes of the body", "a" * 90], 1)])
def test_a_legend_is_read_in_rows_and_no_wider_than_the_column(names, columns):
    with rc_context(SETTINGS):
        canvas = draw(time_figure([Panel("a", tuple(
            Line(name, T, T, "#0072B2") for name in names))]))
        canvas.draw_without_rendering()
    (legend,) = canvas.legends
    assert legend._ncols == columns
    box = legend.get_window_extent()
    assert box.x0 >= 0.0 and box.x1 <= canvas.bbox.width
    rows: dict[int, list] = {}
    for text in legend.get_texts():
        rows.setdefault(round(-text.get_window_extent().y0 / 5), []).append(text)
    read = [text.get_text().replace("\n", "") for _, row in sorted(rows.items())
            for text in sorted(row, key=lambda text: text.get_window_extent().x0)]
    assert [text.replace(" ", "") for text in read] == [name.replace(" ", "") for name in names]


def test_a_map_keeps_one_scale_and_space_its_colours():
    track = go.Figure(go.Scatter(x=T, y=2 * T, mode="lines+markers", name="smoothed", marker=dict(
        color=T, colorbar=dict(title=dict(text="speed in m/s")))))
    style(track, 300)
    track.update_yaxes(title_text="north in m", scaleanchor="x", scaleratio=1)
    panel, bar = draw(track).axes
    assert panel.get_aspect() == 1.0 and bar.get_ylabel() == "speed in m/s"
    panel, bar = draw(in_space()).axes
    assert panel.get_xlabel() == "east in m" and bar.get_ylabel() == "speed in m/s"
    assert len(panel.collections) == 3    # surface, fixes and path; what is hidden is not drawn


@pytest.mark.parametrize("form, begin", [("svg", b"<?xml"), ("pdf", b"%PDF"), ("png", b"\x89PNG")])
def test_every_figure_becomes_a_file(tmp_path, form, begin):
    sections = [Section("Where it went", (Figure(over_time()), Text("words"), Figure(in_space()))),
                Section("Nothing", (Text("no figure"),)), Section("One", (Figure(over_time()),))]
    files = write_figures(sections, tmp_path / "new" / "figures", form)
    assert [f.name for f in files] == [f"where_it_went_1.{form}", f"where_it_went_2.{form}",
                                       f"one.{form}"]
    assert all(file.read_bytes().startswith(begin) for file in files)
    if form == "svg":    # 3.5 inches of 72 points, and text that stays text
        text = files[2].read_text()
        assert re.search(r'width="252(\.0+)?pt"', text) and "price in $" in text


def test_a_folder_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ImuFusionError, match="figures cannot be written"):
        write_figures([], tmp_path / "file" / "figures")
