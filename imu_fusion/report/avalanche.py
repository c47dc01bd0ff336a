"""The section of the slope frame: a ball in an avalanche, as Winkler et al. (2025) draw it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import plotly.graph_objects as go
from scipy.spatial.transform import Rotation

from imu_fusion.errors import CalibrationError, EstimationError, ImuFusionError, LayoutError
from imu_fusion.estimation.avalanche.dead_reckoning import BallSamples
from imu_fusion.estimation.avalanche.descent import Descent, read_descent
from imu_fusion.estimation.avalanche.field_check import angles_deg
from imu_fusion.estimation.avalanche.phases import NAMES
from imu_fusion.estimation.avalanche.slope import fall_line, rotation_vectors, slope_axes, turns
from imu_fusion.estimation.smoother.points import at_surface
from imu_fusion.geometry.gravity import normal_gravity
from imu_fusion.geometry.magnetic_field import decimal_year, magnetic_field_world
from imu_fusion.report import figures as fig
from imu_fusion.report.figures import Band, Line, Panel, Shade, time_figure
from imu_fusion.report.html import Block, Figure, Section, Table, Text
from imu_fusion.report.in_situ import Reckoned, in_situ_blocks, reckon
from imu_fusion.report.overview import number
from imu_fusion.report.smoother import Smoothed
from imu_fusion.report.trajectory import thinned
from imu_fusion.samples import ImuLog, MagLog, seconds

_AXES = ("longitudinal", "lateral", "transverse")
_SECANT = 120.0          # m, of the slope frame
_GAP = 3.0               # usual steps: dead reckoning ends there
_TUBE = 3.0              # standard deviations
_COLORS = ("#7b8794", "#E69F00", "#56B4E9", "#D55E00", "#009E73", "#CC79A7", "#7b8794")


@dataclass(frozen=True, eq=False)
class Slope:
    """A smoothed ball in its slope frame (22): ``axes`` (3, 3), columns longitudinal, lateral,
    transverse, in world axes; ``descent`` of it; ``centre``: samples of the ball's centre."""

    smoothed: Smoothed
    raw: ImuLog
    axes: np.ndarray
    gravity: float
    descent: Descent
    centre: np.ndarray

    @property
    def rows(self) -> slice:
        return self.descent.rows

    @property
    def time(self) -> np.ndarray:
        """(n,) s of the motion, on the time axis of the report."""
        return self.smoothed.time[self.rows]

    def since(self, time: float) -> float:
        """A time (s) after the entrainment on the time axis of the report."""
        return float(seconds(np.array([self.descent.entrained]), self.smoothed.origin)[0]) + time

    def in_slope(self, vectors: np.ndarray) -> np.ndarray:
        """World vectors (n, 3) in the slope frame."""
        return vectors @ self.axes

    @cached_property
    def position(self) -> np.ndarray:
        """(n, 3) m from the place of the entrainment, slope frame."""
        place = self.centre["position_world"][self.rows]
        return self.in_slope(place - place[0])

    @cached_property
    def position_sd(self) -> np.ndarray:
        """(n, 3) m, slope frame."""
        return self._sd("cov_position")

    def _sd(self, name):
        cov = self.axes.T @ self.centre[name][self.rows] @ self.axes
        return np.sqrt(np.maximum(cov.diagonal(0, 1, 2), 0.0))

    @cached_property
    def shades(self) -> tuple[Shade, ...]:
        """The phases."""
        found = self.descent.transitions
        return tuple(Shade(f"{a.number} {NAMES[a.number]}", ((self.since(a.time),
                                                             self.since(b.time)),),
                           _COLORS[a.number], 0.16) for a, b in zip(found, found[1:]))

    @property
    def flight_shades(self) -> tuple[Shade, ...]:
        """The ballistic flights."""
        return (Shade("ballistic flight", tuple(
            (self.since(f.start), self.since(f.end)) for f in self.descent.flights),
            _COLORS[2], 0.4),)

    def row(self, time: float) -> int:
        """The sample of the motion at a time (s) after the entrainment."""
        return int(np.clip(np.searchsorted(self.descent.time, time), 0, len(self.descent.time) - 1))


def slope_of(smoothed: Smoothed, raw: ImuLog) -> Slope | None:
    """The Slope of a ball; None where the motion is not one: no terrain with a fall line, or rates
    that were not recovered, or no motion between rests."""
    if smoothed.surface is None or not getattr(smoothed.params, "recover_rates", False):
        return None
    samples, states = smoothed.result.samples, smoothed.result.states
    centre = at_surface(samples, states, smoothed.params)
    place = centre["position_world"][0]
    try:
        axes = slope_axes(fall_line(smoothed.surface, place, _SECANT))
        latitude, _, height = smoothed.result.frame.to_geodetic(place)
        gravity = normal_gravity(float(latitude), float(height))
        descent = read_descent(
            ImuLog(samples["stamp"], samples["gyr"], samples["acc"]), samples["quat_world_imu"],
            -np.array(smoothed.params.surface.lever_arm), gravity)
    except (EstimationError, LayoutError):
        return None
    return Slope(smoothed, raw, axes, gravity, descent, centre)


def slope_section(slope: Slope, mag: MagLog | None) -> Section:
    """The section; ``mag``: MagLog as recorded, or None."""
    reckoned = _reckoned(slope)
    blocks: list[Block] = [
        Text("The slope frame: longitudinal down the fall line, lateral to the left seen "
             "downwards, transverse away from the slope. All is of the ball's centre, counted from "
             "the entrainment."),
        _phase_table(slope), *_flight_table(slope),
        Figure(_side_view(slope, reckoned), "From the side, at one scale: the terrain below the "
               "ball, where the ball was, and where its sensors alone would have it, before and "
               "after their calibration by the terrain.", linked=False),
        Figure(_map(slope), f"From above the slope: tube of {_TUBE:.0f}σ.", linked=False),
        Figure(time_figure(_velocity(slope), slope.shades, 150),
               "Velocity in the slope frame; the phases are shaded."),
        Figure(time_figure(_rotation(slope), slope.shades, 170),
               "Rotation vector since the entrainment (23), each the nearest to the one before: "
               "where a wobbling ball passes a whole turn beside its axis, none is near. Turns, "
               "and the rates as recorded and with what was recovered beyond the range."),
        Figure(time_figure(_forces(slope), slope.flight_shades, 150),
               "Specific force of the ball's centre. In free flight it is zero: those spans are "
               "shaded, and the table of flights lists them.")]
    if mag is not None and len(mag):
        blocks.append(Figure(
            time_figure(_field(slope, mag), slope.shades, 150),
            "The field as the attitudes carry it into the world, its strength also before the "
            "calibration of the magnetometer, and the lines of the World Magnetic Model. This "
            "check (25)-(27) is blind to a turn about the field, which is "
            "most of the heading where the field is steep."))
    if reckoned is not None:
        blocks += in_situ_blocks(reckoned)
    return Section("On the slope", tuple(blocks))


def _phase_table(slope):
    rows = []
    velocity = slope.in_slope(slope.centre["vel_world"][slope.rows])
    for found in slope.descent.transitions:
        k = slope.row(found.time)
        rows.append((f"{found.number} {NAMES[found.number]}", number(found.time, 2),
                     number(slope.position[k, 0], 1), number(velocity[k, 0], 2),
                     number(float(np.linalg.norm(velocity[k])), 2), found.reason))
    return Table(("phase", "begins s", "distance m", "velocity down the slope m/s", "speed m/s",
                  "because"), tuple(rows), "Phases as Winkler et al. (2025, section 3.2) number "
                 "them.")


def _flight_table(slope):
    rows = []
    for flight in slope.descent.flights:
        a, b = slope.row(flight.start), slope.row(flight.end)
        path = slope.position[a:b + 1]
        rows.append((number(flight.start, 2), number(flight.end - flight.start, 2),
                     number(float(np.linalg.norm(path[-1] - path[0])), 1),
                     number(_arch(path), 2)))
    return [Table(("begins s", "lasts s", "length m", "height m"), tuple(rows),
                  "Ballistic flights. Height: the most by which the path rises above the straight "
                  "line between its ends.")] if rows else []


def _arch(path):
    """Largest transverse rise (m) of a path (n, 3) above the line between its ends."""
    along = path[:, 0] - path[0, 0]
    share = along / along[-1] if along[-1] else np.zeros(len(path))
    return float(np.max(path[:, 2] - path[0, 2] - share * (path[-1, 2] - path[0, 2])))


def _reckoned(slope) -> Reckoned | None:
    """Dead reckoning by the sensors alone, (18)-(21), up to the first gap, with forces as recorded
    and as the terrain calibrates them; None where that is too short."""
    start, step = slope.rows.start, np.diff(slope.smoothed.result.samples["stamp"][slope.rows])
    gaps = np.flatnonzero(step > _GAP * np.median(step))
    part = slice(start, start + int(gaps[0]) + 1 if len(gaps) else slope.rows.stop)
    samples = slope.smoothed.result.samples[part]
    _, own, ours = np.intersect1d(slope.raw.stamp, samples["stamp"], return_indices=True)
    rest = slice(slope.descent.motion.rest_start, start)
    _, still, _ = np.intersect1d(slope.raw.stamp, slope.smoothed.result.samples["stamp"][rest],
                                 return_indices=True)
    try:
        return reckon(BallSamples(
            seconds(samples["stamp"][ours], int(samples["stamp"][0])),
            samples["quat_world_imu"][ours], slope.raw.acc[own], samples["gyr"][ours],
            -np.array(slope.smoothed.params.surface.lever_arm)), slope.axes, slope.gravity,
            float(np.linalg.norm(slope.raw.acc[still].mean(axis=0))))
    except CalibrationError:
        return None


def _path(points, name, color, **line):
    """A line through points (x (n,), y (n,))."""
    return go.Scatter(x=np.float32(points[0]), y=np.float32(points[1]), mode="lines", name=name,
                      line=dict(color=color, width=2, **line))


def _side_view(slope, reckoned):
    """Horizontal distance along the fall line against height."""
    down = np.linalg.norm(slope.axes[:2, 0]), slope.axes[2, 0]
    out = np.hypot(*slope.axes[:2, 2]), slope.axes[2, 2]

    def section(place):
        return place[:, 0] * down[0] + place[:, 2] * out[0], (place[:, 0] * down[1]
                                                              + place[:, 2] * out[1])

    (place,) = thinned(slope.position)
    figure = go.Figure([_path(_terrain(slope), "terrain", fig.REFERENCE, dash="dot"),
                        _path(section(place), "smoothed", fig.ESTIMATE)])
    if reckoned is not None:
        for place, name, color in ((reckoned.before, "before", fig.HIGHLIGHT),
                                   (reckoned.after, "after", fig.SECONDARY)):
            figure.add_trace(_path(section(place), f"sensors alone, {name} calibration", color,
                                   dash="dash"))
    return _scaled(figure, "distance along the fall line in m", "height in m", slope, section)


def _terrain(slope):
    """Distance and height of the terrain below the ball, from the place of the entrainment."""
    (place,) = thinned(slope.centre["position_world"][slope.rows])
    (height,) = (c for c in slope.smoothed.surface.constraints() if c.height)
    above, gradient = height.evaluate(place)
    ground = place[:, 2] - above / gradient[:, 2]
    along = slope.in_slope((place - place[0]) * [1.0, 1.0, 0.0])[:, 0]
    return along / np.linalg.norm(slope.axes[:2, 0]), ground - place[0, 2]


def _map(slope):
    """Longitudinal against lateral, with the tube of what is stated."""
    place, sd = thinned(slope.position, slope.position_sd)
    low, high = place[:, 1] - _TUBE * sd[:, 1], place[:, 1] + _TUBE * sd[:, 1]
    figure = go.Figure([
        go.Scatter(x=np.float32(np.r_[place[:, 0], place[::-1, 0]]),
                   y=np.float32(np.r_[low, high[::-1]]), fill="toself", mode="lines",
                   line=dict(width=0), fillcolor="rgba(86,180,233,0.35)", hoverinfo="skip",
                   name=f"±{_TUBE:.0f}σ across"),
        _path((place[:, 0], place[:, 1]), "smoothed", fig.ESTIMATE)])
    return _scaled(figure, "longitudinal in m", "lateral in m", slope,
                   lambda p: (p[:, 0], p[:, 1]))


def _scaled(figure, across, upwards, slope, project):
    """The figure with where the phases begin, at one scale."""
    rows = [slope.row(t.time) for t in slope.descent.transitions]
    x, y = project(slope.position[rows])
    figure.add_trace(go.Scatter(
        x=np.float32(x), y=np.float32(y), mode="markers", name="phases begin",
        text=[f"{t.number} {NAMES[t.number]}" for t in slope.descent.transitions],
        hovertemplate="%{text}<extra></extra>", marker=dict(size=8, symbol="diamond",
                                                            color=fig.SECONDARY)))
    fig.style(figure, height=420)
    figure.update_layout(legend=dict(orientation="h", x=0, y=1.0, yanchor="bottom"))
    figure.update_xaxes(title_text=across)
    figure.update_yaxes(title_text=upwards, scaleanchor="x", scaleratio=1)
    return figure


def _velocity(slope):
    velocity, sd = slope.in_slope(slope.centre["vel_world"][slope.rows]), slope._sd("cov_velocity")
    return [Panel("in m/s", (
        Band("±3σ", slope.time, velocity[:, k] - 3 * sd[:, k], velocity[:, k] + 3 * sd[:, k]),
        Line("smoothed", slope.time, velocity[:, k], fig.ESTIMATE)), title=name)
        for k, name in enumerate(_AXES)]


def _rotation(slope):
    samples = slope.smoothed.result.samples[slope.rows]
    vectors = slope.in_slope(rotation_vectors(samples["quat_world_imu"])) / (2.0 * np.pi)
    count = turns(slope.time, samples["gyr"])
    size = np.linalg.norm(samples["gyr"], axis=1)
    _, own, ours = np.intersect1d(slope.raw.stamp, samples["stamp"], return_indices=True)
    colors = fig.AXES.items()
    return [
        Panel("in turns", tuple(Line(name, slope.time, vectors[:, k], color) for k, (name, color)
                                in enumerate(zip(_AXES, fig.AXES.values()))),
              title="rotation vector, slope frame"),
        Panel("in turns", tuple(Line(name, slope.time, count[:, k], color)
                                for k, (name, color) in enumerate(colors)),
              title="turns about the ball's axes"),
        Panel("in rad/s", (
            Line("rate", slope.time, size, fig.ESTIMATE),
            Line("as recorded", slope.time[ours], np.linalg.norm(slope.raw.gyr[own], axis=1),
                 fig.HIGHLIGHT, width=1.0)), title="rate, norm", from_zero=True)]


def _forces(slope):
    g = slope.gravity
    return [Panel("in g", (Line("norm", slope.time,
                                np.linalg.norm(slope.descent.force, axis=1) / g, fig.ESTIMATE),),
                  title="specific force of the centre", from_zero=True),
            Panel("in g", tuple(Line(name, slope.time, slope.descent.force[:, k] / g, color)
                                for k, (name, color) in enumerate(fig.AXES.items())),
                  title="in the ball's axes")]


def _field(slope, mag):
    samples = slope.smoothed.result.samples[slope.rows]
    _, own, ours = np.intersect1d(mag.stamp, samples["stamp"], return_indices=True)
    sensor = slope.smoothed.params.with_calibrated_magnetometer().sensor
    measured = (mag.mag[own] - sensor.mag_offset) @ np.reshape(sensor.mag_matrix, (3, 3)).T
    world = Rotation.from_quat(samples["quat_world_imu"][ours]).apply(measured)
    inclination, declination = angles_deg(world)
    found = 1e6 * np.linalg.norm(world, axis=1), inclination, declination
    model = _model(slope)
    time = slope.time[ours]
    panels = []
    for k, label in enumerate(("strength in µT", "inclination in °", "declination in °")):
        items: list[Line | Band] = [Line("calibrated", time, fig.break_wraps(found[k]), fig.LIGHT)]
        if k == 0:
            items.insert(0, Line("as recorded", time, 1e6 * np.linalg.norm(mag.mag[own], axis=1),
                                 fig.HIGHLIGHT, width=1.0))
        if model is not None:
            items.append(Line("field model", time[[0, -1]], np.repeat(model[k], 2),
                              fig.REFERENCE, "dash"))
        panels.append(Panel(label, tuple(items)))
    return panels


def _model(slope) -> Sequence[float] | None:
    """Strength (µT), inclination and declination (deg) of the World Magnetic Model; None outside
    of its years."""
    frame = slope.smoothed.result.frame
    try:
        field = magnetic_field_world(frame.latitude_deg, frame.longitude_deg, frame.height,
                                     decimal_year(slope.descent.entrained))
    except ImuFusionError:
        return None
    inclination, declination = angles_deg(field)
    return 1e6 * float(np.linalg.norm(field)), float(inclination), float(declination)
