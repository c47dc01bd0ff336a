"""Sections about a smoothed trajectory: where, how fast, how sure, and whether it fits."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.smoother.measurements.registry import MEASUREMENTS
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.points import at_antenna
from imu_fusion.estimation.smoother.result import SmootherResult
from imu_fusion.estimation.smoother.state import BLOCKS
from imu_fusion.evaluation.consistency import nees
from imu_fusion.report import figures as fig
from imu_fusion.report.figures import Band, Line, Panel, Shade, time_figure
from imu_fusion.report.html import Block, Figure, Number, Section, Table, Text
from imu_fusion.report.orientation import angle_panels
from imu_fusion.report.overview import number
from imu_fusion.report.trajectory import map_figure, side_figure, space_figure
from imu_fusion.samples import AttitudeLog, FixLog, PoseLog, VelocityLog, seconds
from imu_fusion.streams.smoother_messages import constant_states
from imu_fusion.surfaces.constraint import Surface
from imu_fusion.surfaces.hill import Hill

_ENU, _XYZ = ("east", "north", "up"), ("x", "y", "z")
_MEASUREMENTS = {m.name: m for m in MEASUREMENTS}
_STATES = {block.name: block for block in BLOCKS}
_BOUND, _IDEAL = 1.96, 95.0  # of a standard normal distribution, and its share within, %


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A SmootherResult with what it was made from: ``params``, ``surface``, FixLog and VelocityLog
    (None where there was none) and ``origin``, int ns, the zero of the time axes."""

    result: SmootherResult
    params: SmootherParams
    surface: Surface | None
    fix: FixLog | None
    velocity: VelocityLog | None
    origin: int

    @property
    def time(self) -> np.ndarray:
        """(n,) s of the samples."""
        return seconds(self.result.samples["stamp"], self.origin)

    def fixes_world(self) -> tuple[FixLog, np.ndarray]:
        """Valid fixes: FixLog and positions (m, 3) m."""
        if self.fix is None:
            none = np.empty(0)
            return FixLog(none.astype(np.int64), none, none, none, none, none), np.empty((0, 3))
        fix = self.fix[self.fix.usable]
        return fix, self.result.frame.to_enu(fix.latitude_deg, fix.longitude_deg, fix.height)

    def delay(self, *states: str) -> float:
        """ns by which stamps are late, as far as states of these names have found it."""
        return sum(int(round(float(self.result.states[name][0][0, 0]) * 1e9))
                   for name in states if name in self.result.states)

    def antenna(self, stamp: np.ndarray) -> np.ndarray:
        """Position (m, 3) of the antenna at stamps of fixes, NaN outside of the samples."""
        samples = at_antenna(self.result.samples, self.result.states, self.params)
        return interpolate(samples["stamp"], samples["position_world"],
                           stamp - self.delay("gnss_time_offset"))


def interpolate(stamp: np.ndarray, columns: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Columns (n, k) at other stamps (m,), NaN outside."""
    since, at = stamp - stamp[0], at - stamp[0]
    return np.column_stack([np.interp(at, since, column, left=np.nan, right=np.nan)
                            for column in columns.T])


def smoother_sections(smoothed: Smoothed, reference: PoseLog | None = None) -> list[Section]:
    """Sections about a smoothed trajectory.

    Args:
        smoothed: Smoothed.
        reference: PoseLog of the truth in the world of the smoother, or None.
    """
    sections = [_trajectory(smoothed)]
    if smoothed.result.jump is not None:
        sections.append(_jump(smoothed))
    if reference is not None:
        sections.append(_truth(smoothed, reference))
    sections.append(_velocity(smoothed))
    if smoothed.result.acc_density is None:
        sections.append(_attitude(smoothed))
    sections += _errors(smoothed)
    if smoothed.fix is not None:
        sections.append(_before_after(smoothed))
    if smoothed.result.innovations:
        sections.append(_innovations(smoothed))
        if smoothed.surface is not None:
            sections.append(_residuals(smoothed))
    return sections


def smoother_numbers(result: SmootherResult) -> tuple[Number, ...]:
    """The key numbers of a result: a tuple of Number."""
    sd = np.sqrt(np.median(np.trace(result.samples["cov_position"], axis1=1, axis2=2)))
    state = {None: "single pass", True: "converged",
             False: "NOT CONVERGED"}[result.converged]
    items = [Number("Iterations", str(result.iterations), state),
             Number("Position σ", f"{number(sd, 2)} m", "3D, median")]
    if result.jump is not None:
        items.insert(0, Number("Jump", f"{number(result.jump.length, 1)} m",
                               f"± {number(result.jump.length_sd, 2)} m (1σ)"))
    return tuple(items)


def _trajectory(smoothed):
    samples = smoothed.result.samples
    _, fixes = smoothed.fixes_world()
    figure, stretch = space_figure(samples, smoothed.time, fixes, smoothed.surface)
    heights = f" Heights are stretched by {stretch:.1f}." if stretch > 1.0 else ""
    place = "the origin of the surface" if smoothed.surface is not None else "the start"
    step = np.diff(samples["position_world"], axis=0)
    rows = (("length of the path", number(np.linalg.norm(step, axis=1).sum(), 1), "m"),
            *((f"extent {name}", number(np.ptp(samples["position_world"][:, i]), 1), "m")
              for i, name in enumerate(_ENU)),
            ("greatest speed", number(np.linalg.norm(samples["vel_world"], axis=1).max(), 2),
             "m/s"))
    return Section("Trajectory", (
        Text(smoothed.result.summary()[:1].upper() + smoothed.result.summary()[1:]
             + f". East, north and up are counted from {place}."),
        Figure(figure, "The smoothed trajectory, coloured by speed, and the fixes. Drag to turn, "
               "scroll to come closer." + heights, linked=False),
        Figure(map_figure(samples, fixes), "From above: fixes as recorded, and smoothed.",
               linked=False),
        Table(("quantity", "value", "unit"), rows)))


def _jump(smoothed):
    jump, result = smoothed.result.jump, smoothed.result

    def row(name, value, sd, unit, digits=2):
        known = value is not None
        return (name, number(value, digits) if known else "not recorded",
                number(sd, digits + 1) if known and sd is not None else "", unit)

    def event(name, stamp):
        return row(name, float(seconds(stamp, smoothed.origin)), None, "s", 3)

    rows = (row("jump length", jump.length, jump.length_sd, "m"),
            row("in-run speed, last 10 m before the edge", jump.in_run_speed,
                jump.in_run_speed_sd, "m/s"),
            row("take-off speed", jump.takeoff_speed, jump.takeoff_speed_sd, "m/s"),
            row("take-off angle, upwards positive", jump.takeoff_angle_deg,
                jump.takeoff_angle_sd_deg, "°"),
            row("flight time", jump.flight_time, jump.flight_time_sd, "s", 3),
            row("landing speed", jump.landing_speed, jump.landing_speed_sd, "m/s"),
            event("take-off", jump.takeoff_stamp), event("touch-down", jump.touchdown_stamp))
    blocks: list[Block] = [Table(
        ("quantity", "value", "σ", "unit"), rows,
        "The length is counted along the landing profile, as the markers of a hill stand.")]
    if isinstance(smoothed.surface, Hill):
        figure = side_figure(smoothed.surface, result.samples, smoothed.fixes_world()[1],
                             result.events)
        blocks.append(Figure(figure, "From the side, at one scale.", linked=False))
    return Section("Jump", tuple(blocks))


def _flight(smoothed):
    """The flight as a Shade, if there is one."""
    events = smoothed.result.events
    if events is None:
        return ()
    start, stop = seconds(np.array([events.takeoff, events.touchdown]), smoothed.origin).tolist()
    return (Shade("in the air", ((start, stop),)),)


def _figure(smoothed, panels, caption="", **options):
    return Figure(time_figure(panels, _flight(smoothed), **options), caption)


def _banded(time, values, sd, name, color=fig.ESTIMATE, label="±3σ"):
    return (Band(label, time, values - 3 * sd, values + 3 * sd), Line(name, time, values, color))


def _sd(cov):
    return np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0))


def _truth(smoothed, reference):
    """Errors of position and attitude against a reference."""
    samples = smoothed.result.samples
    _, i, j = np.intersect1d(samples["stamp"], reference.stamp, return_indices=True)
    rows, truth = samples[i], reference[j]
    time = seconds(rows["stamp"], smoothed.origin)
    position = rows["position_world"] - truth.position_world
    attitude = np.degrees((Rotation.from_quat(rows["quat_world_imu"]).inv()
                           * Rotation.from_quat(truth.quat_world_imu)).as_rotvec())
    panels, table = [], []
    for error, cov, scale, unit, names, what in (
            (position, rows["cov_position"], 1.0, "m", _ENU, "position"),
            (attitude, rows["cov_attitude"], np.degrees(1.0), "°", _XYZ, "attitude about"),
            )[:1 if smoothed.result.acc_density is not None else 2]:
        sd = scale * _sd(cov)
        ratio = nees(error / scale, cov).mean()
        rms = np.sqrt(np.mean(error ** 2, axis=0))
        table.append((what.removesuffix(" about"), *(number(r, 3) for r in rms), unit,
                      number(ratio, 2)))
        panels += [Panel(f"{name} in {unit}", (
            Band("±3σ stated", time, -3 * sd[:, k], 3 * sd[:, k]),
            Line("error", time, error[:, k], fig.ESTIMATE)), title=f"{what} {name}")
            for k, name in enumerate(names)]
    return Section("Errors", (
        Table(("error", "RMS east or x", "RMS north or y", "RMS up or z", "unit", "NEES"),
              tuple(table), "Against the truth of the recording. NEES: mean of the squared "
              "errors by their stated covariance; 3 if that is honest."),
        _figure(smoothed, panels, panel_height=130)))


def _velocity(smoothed):
    samples, time = smoothed.result.samples, smoothed.time
    sd = _sd(samples["cov_velocity"])
    speed = np.linalg.norm(samples["vel_world"], axis=1)
    velocity = smoothed.velocity
    panels = []
    if velocity is not None:
        late = smoothed.delay("gnss_time_offset", "velocity_time_offset")
        gnss_time = seconds(velocity.stamp - late, smoothed.origin)
    for i, name in enumerate(_ENU):
        items = list(_banded(time, samples["vel_world"][:, i], sd[:, i], "smoothed"))
        if velocity is not None:
            items.insert(1, Line("GNSS", gnss_time, velocity.vel_world[:, i], fig.HIGHLIGHT,
                                 markers=True))
        panels.append(Panel(f"{name} in m/s", tuple(items)))
    panels.append(Panel("speed in m/s", (Line("smoothed", time, speed, fig.ESTIMATE),),
                        from_zero=True))
    position_sd = _sd(samples["cov_position"])
    panels.append(Panel("position σ in m", tuple(
        Line(f"σ {name}", time, position_sd[:, i], color)
        for i, (name, color) in enumerate(zip(_ENU, fig.AXES.values()))), from_zero=True))
    return Section("Velocity", (_figure(
        smoothed, panels, "Velocities of the receiver are drawn at their stamps less the delay "
        "that was found, if it was asked for. Below: how sure the position is.",
        panel_height=170),))


def _attitude(smoothed):
    samples = smoothed.result.samples
    log = AttitudeLog(samples["stamp"], quat_world_imu=samples["quat_world_imu"],
                      cov_attitude=samples["cov_attitude"], gyr=samples["gyr"],
                      acc=samples["acc"])
    sd = np.degrees(_sd(samples["cov_attitude"]))
    panels = [*angle_panels(log, smoothed.origin), Panel("σ in °", tuple(
        Line(f"σ about {name}", smoothed.time, sd[:, i], color)
        for i, (name, color) in enumerate(fig.AXES.items())), from_zero=True)]
    return Section("Attitude of the trajectory", (_figure(
        smoothed, panels, "Roll, pitch and yaw of the sensor in east-north-up (yaw counter-"
        "clockwise from east). Near a pitch of ±90° roll and yaw cannot be told apart and jump; "
        "the standard deviations below are about the sensor's axes.", panel_height=170),))


def _errors(smoothed):
    """Sections, none if nothing is known of the errors of the sensors."""
    samples, time = smoothed.result.samples, smoothed.time
    panels = []
    for name, unit, scale in (("gyr", "°/s", np.degrees(1.0)), ("acc", "m/s²", 1.0)):
        if np.isnan(samples[f"{name}_bias"]).all():    # not in a recording
            continue
        what = {"gyr": "gyroscope bias", "acc": "accelerometer bias"}[name]
        panels.append(_components(time, scale * samples[f"{name}_bias"],
                                  scale * samples[f"{name}_bias_sd"], what, unit, _XYZ))
    rows, constant = [], constant_states(smoothed.result.states)
    for name, (values, sd) in smoothed.result.states.items():
        block = _STATES[name]
        what, unit, scale, names = block.title, block.unit, block.factor, block.components
        if name in constant:
            rows += [(what, part, number(scale * values[0, i], 3), number(scale * sd[0, i], 3),
                      unit) for i, part in enumerate(names)]
        else:
            panels.append(_components(time, scale * values, scale * sd, what, unit, names))
    blocks: list[Block] = []
    if panels:
        blocks.append(_figure(smoothed, panels, "Errors of the sensors as estimated, with three "
                              "standard deviations.", panel_height=180))
    if rows:
        blocks.append(Table(("constant state", "", "value", "σ", "unit"), tuple(rows)))
    return [Section("Sensor errors", tuple(blocks))] if blocks else []


def _components(time, values, sd, what, unit, names):
    items: list[Band | Line] = []
    for i, (part, color) in enumerate(zip(names, fig.SERIES if len(names) > 3 else
                                          fig.AXES.values())):
        items.append(Band(f"±3σ {part}", time, values[:, i] - 3 * sd[:, i],
                          values[:, i] + 3 * sd[:, i], color, 0.16))
        items.append(Line(part, time, values[:, i], color))
    return Panel(f"in {unit}", tuple(items), title=what)


def _before_after(smoothed):
    """Fixes less the smoothed trajectory."""
    fix, fixes = smoothed.fixes_world()
    difference = fixes - smoothed.antenna(fix.stamp)
    inside = np.isfinite(difference).all(axis=1)
    fix, difference = fix[inside], difference[inside]
    time = seconds(fix.stamp - smoothed.delay("gnss_time_offset"), smoothed.origin)
    sd = _sd(fix.cov_enu)
    sd[~np.any(sd, axis=1)] = smoothed.params.gnss.fix_sd
    rows = [(name, number(np.sqrt(np.mean(difference[:, i] ** 2)), 3),
             number(np.median(sd[:, i]), 3), number(np.abs(difference[:, i]).max(), 3))
            for i, name in enumerate(_ENU)]
    panels = [Panel(f"{name} in m", (
        Band("±3σ of the fixes", time, -3 * sd[:, i], 3 * sd[:, i], fig.NEUTRAL, 0.22),
        Line("fix less smoothed", time, difference[:, i], fig.ESTIMATE, markers=True)))
        for i, name in enumerate(_ENU)]
    return Section("Before and after", (
        Table(("fix less smoothed", "RMS m", "σ of the fixes m", "largest m"), tuple(rows)),
        _figure(smoothed, panels, "What smoothing changed: the positions of the receiver less "
                "those of the trajectory, within what the fixes state of themselves (or what the "
                "parameters say where they state nothing).", panel_height=150)))


def _innovations(smoothed):
    """Normalised innovations with their bounds, and whether they are white."""
    rows, panels = [], []
    for name, (stamp, values) in smoothed.result.innovations.items():
        what, parts = _MEASUREMENTS[name].title, _MEASUREMENTS[name].components
        time = seconds(stamp, smoothed.origin)
        for i, part in enumerate(parts):
            v = values[:, i]
            centred = v - v.mean()
            lag = np.mean(centred[1:] * centred[:-1]) / np.mean(centred ** 2) if len(v) > 2 \
                else np.nan
            rows.append((what, part, len(v), number(v.mean(), 2),
                         number(np.sqrt(np.mean(v ** 2)), 2),
                         number(100 * np.mean(np.abs(v) < _BOUND), 1), number(lag, 2)))
        bound = np.full(len(time), _BOUND)
        panels.append(Panel("in σ", (
            Band(f"±{_BOUND}σ", time, -bound, bound, fig.NEUTRAL, 0.22),
            *(Line(part, time, values[:, i], color, markers=True) for i, (part, color) in
              enumerate(zip(parts, fig.AXES.values() if parts == _XYZ else fig.SERIES)))),
            title=what))
    return Section("Innovations", (
        Table(("measurement", "", "count", "mean", "RMS", f"within ±{_BOUND}σ %",
               "correlation with the next"), tuple(rows),
              f"Ideal: mean 0, RMS 1, {_IDEAL:g} % within, correlation 0. Less than 1: the stated "
              "noise is too large; more, or correlated: too small, or something is not modelled."),
        _figure(smoothed, panels, "Measurements less their prediction from everything before "
                "them, by their standard deviation.", panel_height=170)))


def _residuals(smoothed):
    """Residuals of the surface's constraints where they hold."""
    panels, rows = [], []
    for name, fit in smoothed.result.surface.items():
        time, bound = smoothed.time[fit.sample], np.full(len(fit.sample), 3.0 * fit.sigma)
        name = name.replace("_", " ")
        panels.append(Panel("in m", (
            Band("±3σ of the constraint", time, -bound, bound, fig.NEUTRAL, 0.22),
            Line("residual", time, fit.residual, fig.ESTIMATE)), title=name))
        rows.append((name, len(fit.sample), number(fit.rms, 3), number(fit.largest, 3),
                     number(fit.sigma, 3), number(fit.excess, 2)))
    kind = "hill" if isinstance(smoothed.surface, Hill) else "surface"
    if not rows:
        return Section("Surface", (Text(f"The {kind} constrains no sample."),))
    return Section("Surface", (
        Table(("constraint", "samples", "RMS m", "largest m", "σ m", "over seconds, by σ"),
              tuple(rows), "Over seconds: RMS of the means of a second, by the standard deviation "
              "that σ gives them. A surface that fits leaves less than 1."),
        _figure(smoothed, panels, f"How far the trajectory stands off the {kind} where it is "
                "told to be on it.", panel_height=140)))
