"""Sections about an acceleration field: its picture, rates, residuals, impacts."""

from typing import Any

import numpy as np
import plotly.graph_objects as go

from imu_fusion.report import figures as fig
from imu_fusion.report.field_data import FieldData
from imu_fusion.report.figures import Band, Line, Panel, time_figure
from imu_fusion.report.html import Figure, Notes, Number, Numbers, Section, Table, Text
from imu_fusion.report.overview import number
from imu_fusion.samples import seconds

# Instants of the field picture, and points whose magnitude is drawn.
_INSTANTS, _POINTS = 41, len(fig.SERIES)
_CLIPPED = "gyroscope at its limit"
# Key of impact_metrics, words, factor from SI, unit.
_METRICS = (
    ("peak_linear_acceleration", "peak linear acceleration", 1 / 9.80665, "g"),
    ("peak_velocity_change", "peak change of velocity", 1.0, "m/s"),
    ("peak_angular_acceleration", "peak angular acceleration", 1.0, "rad/s²"),
    ("peak_angular_velocity", "peak angular velocity", 1.0, "rad/s"),
    ("hic15", "HIC15", 1.0, ""), ("hic36", "HIC36", 1.0, ""),
    ("clip_3ms", "3 ms clip", 1 / 9.80665, "g"),
    ("clip_3ms_cumulative", "3 ms clip, cumulative", 1 / 9.80665, "g"), ("bric", "BrIC", 1.0, ""),
    ("gambit", "GAMBIT", 1.0, ""), ("damage", "DAMAGE", 1.0, ""))


def field_sections(data: FieldData, origin: int) -> list[Section]:
    """All sections about a field.

    Args:
        data: FieldData.
        origin: int ns, zero of the time axis.
    """
    time = seconds(data.rows["stamp"], origin)
    clipped = data.clipped
    sections = [_field(data, time), _rates(data, time, clipped)]
    if data.readings:
        sections.append(_residuals(data, time))
    if data.impacts:
        sections.append(_impacts(data, origin))
    return sections


def _field(data, time):
    points = data.points
    force, kinematic = data.field(points)
    magnitude = np.linalg.norm(kinematic, axis=2)
    rows = []
    for k, point in enumerate(points):
        peak = int(np.argmax(magnitude[:, k]))
        rows.append((_place(point), number(magnitude[peak, k], 2), number(time[peak], 3),
                     number(np.sqrt(np.mean(magnitude[:, k] ** 2)), 2),
                     number(np.linalg.norm(force[:, k], axis=1).max(), 2)))
    stated = [(words, np.sqrt(np.trace(data.rows[name], axis1=1, axis2=2)), color)
              for words, name, color in (
                  ("σ of the specific force", "cov_specific_force", fig.SECONDARY),
                  ("σ of the kinematic acceleration in the world", "cov_acceleration_world",
                   fig.NEUTRAL))]
    panels = [
        Panel("kinematic in m/s²", tuple(Line(_place(p), time, magnitude[:, k], fig.SERIES[k])
                                         for k, p in enumerate(points[:_POINTS])), from_zero=True),
        Panel("specific force in m/s²", tuple(
            Line(_place(p), time, np.linalg.norm(force[:, k], axis=1), fig.SERIES[k])
            for k, p in enumerate(points[:_POINTS])), from_zero=True),
        Panel("σ at the origin in m/s²", tuple(Line(words, time, sd, color)
                                               for words, sd, color in stated), from_zero=True)]
    words = ("Magnitudes at the query points. The specific force is what accelerometers there "
             "would feel and needs no orientation; the kinematic acceleration is without gravity. "
             "As a vector in the world it shares the uncertainty of the orientation, which turns "
             "it and hardly changes its magnitude.")
    rate, turning = (np.linalg.norm(data.rows[name], axis=1).max() for name in ("omega", "alpha"))
    doubts = (Notes(data.remarks),) if data.remarks else ()
    return Section("Acceleration field", (
        *doubts,
        Numbers((Number("Samples", str(len(time))),
                 Number("Peak acceleration", f"{magnitude.max():.1f} m/s²",
                        "kinematic, all points"),
                 Number("Peak rate", f"{rate:.1f} rad/s"),
                 Number("Peak angular acc.", f"{turning:.0f} rad/s²"))),
        Table(("point x, y, z in m", "peak m/s²", "at s", "RMS m/s²", "peak specific force m/s²"),
              tuple(rows)),
        Figure(time_figure(panels), words),
        Figure(field_picture(data, time, magnitude[:, 0]),
               "The kinematic acceleration of points of the body, in body axes, around the "
               "greatest magnitude at the first query point. The slider moves through time; all "
               "arrows have one scale and a dot as their head. The line from the origin without a "
               "head is the angular velocity.",
               linked=False)))


def field_picture(data: FieldData, time: np.ndarray, magnitude: np.ndarray) -> go.Figure:
    """Arrows at the accelerometers and query points, with a slider over time: a figure.

    Args:
        time: (n,) s; magnitude: (n,) m/s^2, whose peak is the middle of the picture.
    """
    # Half an event's default length to both sides, but at least as many samples as instants.
    step = np.median(np.diff(time)) if len(time) > 1 else 1.0
    stride = max(1, int(round(data.config.stream.impact.duration / step / _INSTANTS)))
    first = int(np.argmax(magnitude)) - stride * (_INSTANTS // 2)
    first = max(0, min(first, len(time) - 1 - stride * (_INSTANTS - 1)))
    shown = np.arange(first, len(time), stride)[:_INSTANTS]
    places = np.unique(np.vstack([*data.places.values(), data.points]), axis=0)
    arrows = data.field(places)[1][shown]
    reach = max(np.linalg.norm(places - places.mean(axis=0), axis=1).max(), 1e-2)
    scale = reach / max(np.linalg.norm(arrows, axis=2).max(), 1e-9)
    rates = data.rows["omega"][shown]
    turning = reach * rates / max(np.linalg.norm(rates, axis=1).max(), 1e-9)
    named = {tuple(place): name for name, place in data.places.items()}
    figure = go.Figure(go.Scatter3d(
        x=places[:, 0], y=places[:, 1], z=places[:, 2], mode="markers+text",
        text=[fig.plain(named.get(tuple(p), "")) for p in places], textfont=dict(size=11),
        marker=dict(size=4, color=fig.REFERENCE), name="accelerometers and query points",
        hovertemplate="%{x:.3f}, %{y:.3f}, %{z:.3f} m<extra></extra>"))
    middle = int(np.argmax(magnitude[shown]))
    for k in range(len(shown)):
        figure.add_traces(_arrows(places, scale * arrows[k], turning[k], k == middle))
    count = len(shown)
    steps = []
    for k in range(count):
        visible = [True] + [k == other for other in range(count) for _ in range(2)]
        steps.append(dict(method="restyle", args=["visible", visible],
                          label=f"{time[shown[k]]:.3f}"))
    fig.style(figure, 620)
    middle_place = places.mean(axis=0)
    figure.update_layout(
        scene=dict(aspectmode="cube", camera=dict(
            eye=dict(x=1.25, y=1.25, z=0.85), center=dict(x=0, y=0, z=-0.12)), **{
            f"{axis}axis": dict(title=f"{axis} in m", range=[
                float(middle_place[i] - 1.4 * reach), float(middle_place[i] + 1.4 * reach)])
            for i, axis in enumerate("xyz")}),
        legend=dict(orientation="h", x=0, y=1.02, yanchor="bottom"),
        sliders=[dict(active=middle, steps=steps, currentvalue=dict(prefix="time in s: "),
                      pad=dict(t=20))])
    return figure


def _arrows(places, vectors, turning, visible):
    """Traces of one instant: arrows (a dot is the head), angular velocity."""
    tips = places + vectors
    x, y, z = np.stack([places, tips, np.full_like(tips, np.nan)], axis=1).reshape(-1, 3).T
    return [
        go.Scatter3d(x=x, y=y, z=z, mode="lines+markers", line=dict(color=fig.ESTIMATE, width=5),
                     marker=dict(size=[0, 6, 0] * len(places), color=fig.ESTIMATE,
                                 line=dict(width=0)),
                     name="kinematic acceleration", visible=visible, hoverinfo="skip"),
        go.Scatter3d(x=[0, turning[0]], y=[0, turning[1]], z=[0, turning[2]], mode="lines",
                     line=dict(color=fig.HIGHLIGHT, width=5), name="angular velocity",
                     visible=visible, hoverinfo="skip")]


def _rates(data, time, clipped):
    rows = data.rows
    panels = []
    for name, unit, values, cov, measured in (
            ("ω", "rad/s", rows["omega"], rows["cov_omega"], data.gyr),
            ("α", "rad/s²", rows["alpha"], rows["cov_alpha"], None)):
        sd = np.sqrt(np.maximum(np.einsum("nii->ni", cov), 0.0))
        for i, axis in enumerate("xyz"):
            items: list[Any] = [
                Band("±1σ stated", time, values[:, i] - sd[:, i], values[:, i] + sd[:, i]),
                Line("estimate", time, values[:, i], fig.ESTIMATE)]
            if measured is not None:
                items.append(Line("gyroscope as recorded", time, measured[:, i], fig.REFERENCE,
                                  dash="dot", width=1.1))
                # Dots, since there may be hundreds of short stretches.
                at_limit = np.where(clipped[:, i], measured[:, i], np.nan)
                if clipped[:, i].any():
                    items.append(Line(f"{_CLIPPED}, not used", time, at_limit, fig.HIGHLIGHT,
                                      markers=True))
            panels.append(Panel(f"{name} {axis} in {unit}", tuple(items)))
    blocks = [Figure(time_figure(panels, panel_height=150),
                     "Body axes. What the gyroscope recorded stands beside the estimate; where it "
                     "is taken to be at its limit the estimator did not see it.")]
    if data.gyr is not None:
        blocks.insert(0, _comparison(data, clipped))
    return Section("Angular velocity and acceleration", tuple(blocks))


def _comparison(data, clipped):
    difference = data.rows["omega"] - data.gyr
    sd = np.sqrt(np.einsum("nii->ni", data.rows["cov_omega"]))
    known = np.isfinite(difference)
    table = []
    for name, mask in (("gyroscope below its limit", known & ~clipped),
                       (_CLIPPED, known & clipped)):
        if not mask.any():
            continue
        part = difference[mask]
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.abs(part) / sd[mask]
        table.append((name, number(np.sqrt(np.mean(part ** 2)), 3),
                      number(np.median(np.abs(part)), 3), number(np.abs(part).max(), 2),
                      number(np.sqrt(np.mean(sd[mask] ** 2)), 3),
                      f"{100 * np.mean(ratio <= 3):.1f} %", str(len(part))))
    return Table(("samples of an axis", "RMS rad/s", "median rad/s", "largest rad/s", "σ stated",
                  "within 3σ", "count"), tuple(table),
                 "Estimated rate minus what the gyroscope recorded. Below its limit the estimator "
                 "used it; at its limit it did not, and the difference is an error as far as the "
                 "gyroscope can be trusted there: a limit that was set lower than its range leaves "
                 "it as a reference, one that is its range does not.")


def _residuals(data, time):
    table, panels = [], []
    for k, name in enumerate(data.readings):
        residual = data.residuals(name)
        sensor = data.accelerometer(name)
        noise = sensor.noise_density * np.sqrt(data.config.field.sample_rate)
        with np.errstate(invalid="ignore"):
            limit = np.inf if sensor.range is None else sensor.range
            saturated = int(np.sum(np.abs(data.readings[name]) >= limit))
        cells = []
        for i in range(3):
            known = residual[np.isfinite(residual[:, i]), i]
            cells.append(f"{known.mean():.2f} ± {known.std():.2f}" if len(known) else "–")
        table.append((name, *cells, number(noise, 3), str(saturated)))
        count = np.isfinite(residual).sum(axis=1)
        rms = np.sqrt(np.nansum(residual ** 2, axis=1) / np.maximum(count, 1))
        rms[count == 0] = np.nan
        panels.append(Line(name, time, rms, fig.SERIES[k % len(fig.SERIES)], width=1.0))
    return Section("Residuals", (
        Table(("accelerometer", "x in m/s²", "y", "z", "noise m/s²", "saturated"), tuple(table),
              "Reading minus estimated field, mean ± standard deviation in the accelerometer's own "
              "axes. The mean is its bias and what the model leaves out; noise is what the "
              "parameters say of one sample."),
        Figure(time_figure([Panel("RMS in m/s²", tuple(panels), from_zero=True)], panel_height=260),
               "Root of the mean square over the axes of each accelerometer. What grows with the "
               "motion is scale, position or flexing, not noise.")))


def _impacts(data, origin):
    header = ["metric", "unit"]
    columns = []
    for impact in data.impacts:
        header.append(f"event {impact['event'] + 1} at {_place(impact['point'])}")
        columns.append(impact)
    rows = [("begins at", "s", *(number((i["stamp"] - origin) * 1e-9, 3) for i in columns))]
    for key, words, factor, unit in _METRICS:
        rows.append((words, unit, *(number(i[key] * factor, 3) if key in i else "–"
                                    for i in columns)))
    rows.append(("recorded to its end", "", *("yes" if i["complete"] else "no" for i in columns)))
    rows.append(("samples with saturation", "", *(str(i["saturated_samples"]) for i in columns)))
    refused = sorted({i["refused"] for i in columns if "refused" in i})
    first = columns[0]
    classes = [f"{what} CFC {first[key]}" if first[key] else f"{what} unfiltered"
               for what, key in (("linear", "linear_class"), ("angular", "angular_class"))]
    text = ("Kinematic acceleration in the axes of SAE J211; " + ", ".join(classes) + "."
            + (" Without metrics: " + ", ".join(refused) + "." if refused else ""))
    return Section("Impacts", (Table(tuple(header), tuple(rows)), Text(text)))


def _place(point):
    return ", ".join(f"{v:g}" for v in point)
