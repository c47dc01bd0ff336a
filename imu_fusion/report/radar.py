"""A trajectory beside a radar's range gates: range-time diagram, and velocities down the slope."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import plotly.graph_objects as go

from imu_fusion.errors import LayoutError, TopicError
from imu_fusion.estimation.avalanche.radar import (
    Gate,
    RadarLog,
    Secant,
    gates_of,
    range_differences,
)
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.recordings.bag_reader import Lose, Reader, find_topic, open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.recordings.radar import read_radar
from imu_fusion.report import figures as fig
from imu_fusion.report.contents import FIX_TOPIC, VELOCITY_TOPIC
from imu_fusion.report.html import Block, Figure, Number, Numbers, Section, Table, write_report
from imu_fusion.report.overview import number
from imu_fusion.report.trajectory import thinned
from imu_fusion.report.trajectory_data import read_result
from imu_fusion.samples import seconds
from imu_fusion.samples.guard import usable_part
from imu_fusion.surfaces.constraint import Surface
from imu_fusion.surfaces.file import load_surface

VELOCITY_SD = 1.5    # m/s, of a radar's velocities (Winkler 2025, Fig. 19)
_AGREE = 0.5         # m


@dataclass(frozen=True, eq=False)
class Seen:
    """A trajectory as a radar sees it: ``time`` (n,) s since ``start`` (ns), ``position`` (n, 3) m
    from the radar, ``speed`` (n,) m/s; ``source`` in words."""

    time: np.ndarray
    start: int
    position: np.ndarray
    speed: np.ndarray
    source: str

    @property
    def range(self) -> np.ndarray:
        """(n,) m."""
        return np.linalg.norm(self.position, axis=1)


def read_seen(bag: str | Path, radar: LocalFrame, lose: Lose = lambda text: None) -> Seen:
    """The smoothed trajectory of a recording, or else its fixes and their velocities; lose: called
    with texts on what of it cannot be read.

    Raises:
        TopicError: there is neither.
    """
    with open_bag(bag) as reader:
        result, _, _ = read_result(reader)
        if result is not None:
            for text in reader.losses:
                lose(text)
            samples = result.samples
            place = result.frame.to_geodetic(samples["position_world"])
            return _seen(samples["stamp"], radar.to_enu(*place), samples["vel_world"], "smoothed")
        fix, velocity = (_log(reader, name, bag) for name in (FIX_TOPIC, VELOCITY_TOPIC))
        for text in reader.losses:
            lose(text)
    fix = fix[fix.usable]
    both, of_fix, of_velocity = np.intersect1d(fix.stamp, velocity.stamp, return_indices=True)
    if len(both) < 2:
        raise TopicError(f"{bag}: {FIX_TOPIC} and {VELOCITY_TOPIC} have no stamps in common")
    fix = fix[of_fix]
    return _seen(both, radar.to_enu(fix.latitude_deg, fix.longitude_deg, fix.height),
                 velocity.vel_world[of_velocity], "fixes")


def _log(reader: Reader, name, bag):
    if find_topic(reader.topics, name) is None:
        raise TopicError(f"{bag}: neither a smoothed trajectory nor {FIX_TOPIC} with "
                         f"{VELOCITY_TOPIC}: process the recording, and name OUT here")
    return usable_part(read_log(reader, name), name)[0]


def _seen(stamp, position, vel, source):
    return Seen(seconds(stamp, int(stamp[0])), int(stamp[0]), position,
                np.linalg.norm(vel, axis=1), source)


def on_ground(seen: Seen, radar: LocalFrame, surface: Surface) -> Seen:
    """The same with the heights of a terrain.

    Raises:
        LayoutError: a surface without one height, or which ends before the trajectory does.
    """
    place = surface.origin.to_enu(*radar.to_geodetic(seen.position))
    heights = [c for c in surface.constraints() if c.height]
    if len(heights) != 1:
        raise LayoutError(f"heights of the terrain: a surface with {len(heights)} of them")
    above, gradient = heights[0].evaluate(place)
    place[:, 2] -= above / gradient[:, 2]
    if not np.isfinite(place).all():
        raise LayoutError("the surface does not reach as far as the trajectory")
    return replace(seen, position=radar.to_enu(*surface.origin.to_geodetic(place)))


def write_radar_report(bag: str | Path, place: Sequence[float], path: str | Path,
                       table: str | Path | None = None, gate_length: float = 25.0,
                       along_beam: bool = False, surface: str | None = None,
                       lose: Lose = lambda text: None) -> list[tuple[str, str]]:
    """Write the HTML report of a trajectory beside a radar.

    Args:
        bag: recording with smoother/odometry, or with fix and fix_velocity.
        place: of the radar, latitude, longitude (deg) and height (m) in the datum of the fixes.
        path: file to write.
        table: CSV file of :func:`~imu_fusion.recordings.radar.read_radar`.
        gate_length: m.
        along_beam: whether the table's velocities are those along the beam, which are projected,
            too.
        surface: of :func:`~imu_fusion.surfaces.file.load_surface`, whose heights are taken in
            place of the trajectory's: fixes are off by metres; None: the trajectory's own.
        lose: of :func:`read_seen`.

    Returns:
        what it says in numbers: (name, value with its unit).

    Raises:
        TopicError, BagError: nothing to compare. EstimationError: a trajectory without a way.
    """
    radar = LocalFrame(*place)
    seen = read_seen(bag, radar, lose)
    if surface is not None:
        seen = on_ground(seen, radar, load_surface(surface))
    secant = Secant.through(seen.position)
    log = None if table is None else RadarLog(*read_radar(table, seen.start))
    numbers = _numbers(seen, log)
    gates = [] if log is None else gates_of(log, gate_length)
    boxes = _boxes(gates, secant, gate_length, along_beam)
    blocks: list[Block] = [
        Numbers(tuple(Number(name, value) for name, value in numbers)),
        Figure(_range_time(seen, log), "Range-time diagram: how far from the radar, coloured by "
               "speed, and what the radar saw.", linked=False),
        Figure(_velocities(seen, secant, boxes), "Speed against the way down the slope secant, the "
               "line from the first place to the last. Boxes: range gates projected on it, as "
               f"high as ±{VELOCITY_SD:g} m/s.", linked=False)]
    if boxes:
        blocks.append(_gate_table(seen, secant, boxes))
    write_report(path, f"{Path(bag).resolve().name} beside the radar",
                 [Section("Range gates on the slope", tuple(blocks))],
                 f"radar at {radar.latitude_deg:.6f}, {radar.longitude_deg:.6f}, "
                 f"{radar.height:.1f} m; trajectory: {seen.source}")
    return numbers


def _numbers(seen, log):
    rows = [("range at the start", f"{seen.range[0]:.1f} m"),
            ("range at the end", f"{seen.range[-1]:.1f} m")]
    if log is not None:
        off = range_differences(seen.time, seen.position, log)
        off = off[np.isfinite(off)]
        if len(off):
            low, middle, high = np.percentile(off, (5, 50, 95))
            rows += [("range less the radar's, median", f"{middle:.2f} m"),
                     ("5 to 95 % of it", f"{low:.1f} to {high:.1f} m"),
                     (f"within {_AGREE:g} m", f"{100 * np.mean(np.abs(off) < _AGREE):.0f} %")]
        else:
            rows.append(("common times", "none: is the table of another clock?"))
    return rows


@dataclass(frozen=True)
class _Box:
    """A Gate on the secant: from ``low`` to ``high`` m, with the velocity down the slope."""

    gate: Gate
    low: float
    high: float
    velocity: float


def _boxes(gates: Sequence[Gate], secant: Secant, length: float, along_beam: bool) -> list[_Box]:
    """The gates that lie on the secant."""
    boxes = []
    for gate in gates:
        ends, _ = secant.project(gate.range + length * np.array([-0.5, 0.5]))
        _, (cosine,) = secant.project(np.array([gate.range]))
        if np.isfinite(ends).all() and cosine > 0.0:
            velocity = gate.velocity / cosine if along_beam else gate.velocity
            boxes.append(_Box(gate, float(ends.min()), float(ends.max()), velocity))
    return boxes


def _speed_at(seen, secant, box):
    """Median speed of the trajectory between the ends of a box; nan where it never is."""
    inside = np.abs(secant.distance(seen.position) - 0.5 * (box.low + box.high)) < 0.5 * (
        box.high - box.low)
    return float(np.median(seen.speed[inside])) if inside.any() else np.nan


def _gate_table(seen, secant, boxes):
    return Table(("range m", "first seen s", "down the secant m", "velocity m/s",
                  "speed of the trajectory there m/s"), tuple(
        (number(box.gate.range, 1), number(box.gate.time, 1), f"{box.low:.0f} to {box.high:.0f}",
         number(box.velocity, 1), number(_speed_at(seen, secant, box), 1)) for box in boxes),
        "Range gates of the radar on the slope secant, their velocities along it.")


def _range_time(seen, log):
    time, range_, speed = thinned(seen.time, seen.range, seen.speed)
    figure = go.Figure([go.Scatter(
        x=np.float32(time), y=np.float32(range_), mode="markers", name=seen.source,
        showlegend=False, marker=dict(
            size=5, color=np.float32(speed), colorscale="Viridis", showscale=True,
            colorbar=dict(thickness=14, title=dict(text="speed in m/s", side="right"))))])
    if log is not None:
        seen_at, seen_range = thinned(log.time, log.range)
        figure.add_trace(go.Scatter(
            x=np.float32(seen_at), y=np.float32(seen_range), mode="lines", name="radar",
            line=dict(color=fig.HIGHLIGHT, width=1.5, shape="hv")))
    return _labelled(figure, "time since start in s", "range in m")


def _velocities(seen, secant, boxes):
    distance, speed = thinned(secant.distance(seen.position), seen.speed)
    figure = go.Figure([go.Scatter(x=np.float32(distance), y=np.float32(speed), mode="lines",
                                   name=seen.source, line=dict(color=fig.ESTIMATE, width=1.5))])
    x, y = [], []
    for box in boxes:
        if np.isfinite(box.velocity):
            low, high = box.velocity - VELOCITY_SD, box.velocity + VELOCITY_SD
            x += [box.low, box.high, box.high, box.low, box.low, np.nan]
            y += [low, low, high, high, low, np.nan]
    if x:
        figure.add_trace(go.Scatter(
            x=np.float32(np.array(x)), y=np.float32(np.array(y)), mode="lines",
            name="range gates", fill="toself",
            fillcolor="rgba(123,135,148,0.25)", line=dict(color=fig.REFERENCE, width=1)))
    return _labelled(figure, "distance down the slope secant in m", "speed in m/s")


def _labelled(figure, across, upwards):
    fig.style(figure, height=420)
    figure.update_layout(legend=dict(orientation="h", x=0, y=1.0, yanchor="bottom"))
    figure.update_xaxes(title_text=across)
    figure.update_yaxes(title_text=upwards)
    return figure
