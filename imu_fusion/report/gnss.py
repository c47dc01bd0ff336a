"""Section about GNSS positions and velocities as recorded."""

import numpy as np
import plotly.graph_objects as go
import pymap3d

from imu_fusion.report import figures as fig
from imu_fusion.report.decimate import POINTS
from imu_fusion.report.figures import Line, Panel, time_figure
from imu_fusion.report.html import Figure, Section, Table, Text
from imu_fusion.report.overview import number
from imu_fusion.samples import FixLog, VelocityLog, seconds


def gnss_section(fix: FixLog, velocity: VelocityLog | None, origin: int) -> Section:
    """Section with the track, height, speed and stated standard deviations.

    Args:
        fix: FixLog.
        velocity: VelocityLog or None.
        origin: int ns, zero of the time axis.
    """
    fix = fix[(fix.status >= 0) & np.isfinite(fix.latitude_deg) & np.isfinite(fix.longitude_deg)]
    if len(fix) == 0:
        return Section("GNSS", (Text("No message has a fix."),))
    time = seconds(fix.stamp, origin)
    # One height for all: the track is looked at from above.
    east, north, _ = pymap3d.geodetic2enu(
        fix.latitude_deg, fix.longitude_deg, fix.height[0],
        fix.latitude_deg[0], fix.longitude_deg[0], fix.height[0])
    rows = [("extent east", number(np.ptp(east), 1), "m"),
            ("extent north", number(np.ptp(north), 1), "m"),
            ("height, least to greatest", number(np.ptp(fix.height), 1), "m"),
            ("length of the track", number(np.hypot(np.diff(east), np.diff(north)).sum(), 1), "m")]
    panels = [Panel("height in m", (Line("GNSS", time, fix.height, fig.ESTIMATE),))]
    speed = None
    if velocity is not None and len(velocity):
        speed_time = seconds(velocity.stamp, origin)
        speed = np.hypot(velocity.vel_world[:, 0], velocity.vel_world[:, 1])
        panels += [
            Panel("speed in m/s", (Line("GNSS", speed_time, speed, fig.ESTIMATE),),
                  from_zero=True),
            Panel("climb in m/s", (Line("GNSS", speed_time, velocity.vel_world[:, 2],
                                        fig.ESTIMATE),))]
        rows.append(("greatest horizontal speed", number(np.nanmax(speed), 2), "m/s"))
    sd = np.sqrt(np.diagonal(fix.cov_enu, axis1=1, axis2=2))
    if (sd > 0).any():
        panels.append(Panel("σ stated in m", tuple(
            Line(name, time, sd[:, i], color) for i, (name, color) in enumerate(
                zip(("east", "north", "up"), fig.AXES.values()))), from_zero=True))
        rows.append(("median stated σ east, north, up",
                     " / ".join(number(s, 3) for s in np.median(sd, axis=0)), "m"))
    color = None if speed is None else np.interp(time, speed_time, speed)
    return Section("GNSS", (
        Table(("quantity", "value", "unit"), tuple(rows)),
        Figure(_track(east, north, color), "Track seen from above, relative to the first fix.",
               linked=False),
        Figure(time_figure(panels, panel_height=150))))


def _track(east, north, speed):
    """East and north in m at one scale, coloured by speed if it is known."""
    step = -(-len(east) // POINTS)
    marker = dict(size=4, color=fig.ESTIMATE)
    if speed is not None:
        marker = dict(size=4, color=np.float32(speed[::step]), colorscale="Viridis",
                      colorbar=dict(thickness=14, title=dict(text="speed in m/s", side="right",
                                                             font=dict(size=13))))
    figure = go.Figure(go.Scatter(
        x=np.float32(east[::step]), y=np.float32(north[::step]), mode="lines+markers",
        marker=marker, line=dict(color="#c5ced8", width=1),
        hovertemplate="east %{x:.1f} m, north %{y:.1f} m<extra></extra>"))
    fig.style(figure, height=520)
    figure.update_xaxes(title_text="east in m")
    figure.update_yaxes(title_text="north in m", scaleanchor="x", scaleratio=1)
    return figure
