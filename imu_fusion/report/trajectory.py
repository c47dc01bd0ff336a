"""Figures of a trajectory in space: 3D on its surface, from above, and a jump from the side."""

import numpy as np
import plotly.graph_objects as go

from imu_fusion.estimation.smoother.jump_events import JumpEvents
from imu_fusion.report import figures as fig
from imu_fusion.report.decimate import POINTS
from imu_fusion.surfaces.constraint import Surface
from imu_fusion.surfaces.hill import Hill

# A flat trajectory is stretched upwards so that its height is at least this part of its extent.
_LEAST_HEIGHT = 0.12
_SURFACE = "#c9d3dc"
_CELLS = 60
_SIZE = 1.35  # of the longest side of the drawn box, in plotly's units


def thinned(*columns: np.ndarray) -> list[np.ndarray]:
    """Every k-th row of columns of the same length, at most POINTS."""
    step = -(-len(columns[0]) // POINTS)
    return [np.asarray(column)[::step] for column in columns]


def _speed_marks(speed, size, **bar):
    return dict(size=size, color=np.float32(speed), colorscale="Viridis", colorbar=dict(
        thickness=14, title=dict(text="speed in m/s", side="right", font=dict(size=13)), **bar))


def space_figure(samples: np.ndarray, time: np.ndarray, fixes_world: np.ndarray,
                 surface: Surface | None) -> go.Figure:
    """The trajectory in three dimensions, to be turned with the mouse.

    Args:
        samples: structured array of the smoother.
        time: (n,) s.
        fixes_world: (m, 3) m.
        surface: Surface or None.

    Returns:
        (figure, factor by which heights are stretched)
    """
    position, time, velocity = thinned(samples["position_world"], time, samples["vel_world"])
    speed = np.linalg.norm(velocity, axis=1)
    (fixes,) = thinned(fixes_world)
    figure = go.Figure([go.Surface(
        x=x.tolist(), y=y.tolist(), z=z.tolist(), colorscale=[[0, _SURFACE], [1, _SURFACE]],
        showscale=False, opacity=0.75, hoverinfo="skip", name="surface",
        contours=dict(x=dict(highlight=False), y=dict(highlight=False), z=dict(highlight=False)))
        for x, y, z in _surface_meshes(surface, samples["position_world"])])
    figure.add_trace(go.Scatter3d(
        **_xyz(fixes), mode="markers", name="fixes", marker=dict(
            size=2.2, color=fig.HIGHLIGHT, opacity=0.55), hoverinfo="skip"))
    marks = _speed_marks(speed, 2, x=1.0, len=0.7)
    figure.add_trace(go.Scatter3d(
        **_xyz(position), mode="lines", name="smoothed", customdata=np.float32(time).tolist(),
        showlegend=False,    # plotly warns of a legend of colours by value
        line=dict(width=5, color=marks["color"], colorscale=marks["colorscale"],
                  colorbar=marks["colorbar"], showscale=True),
        hovertemplate="%{customdata:.2f} s<br>east %{x:.1f} m<br>north %{y:.1f} m<br>"
                      "up %{z:.1f} m<extra></extra>"))
    extent = np.maximum(np.ptp(samples["position_world"], axis=0), 1e-3)
    widest = extent[:2].max()
    stretch = max(1.0, _LEAST_HEIGHT * widest / extent[2]) if extent[2] > 0.01 * widest else 1.0
    fig.style(figure, height=620)
    ratio = extent * [1.0, 1.0, stretch] / extent.max()
    axis = dict(backgroundcolor="#ffffff", gridcolor="#dde3e9", zerolinecolor="#c5ced8")
    figure.update_layout(
        margin=dict(l=0, r=0, t=10, b=0),
        legend=dict(x=0.01, y=0.99, itemsizing="constant"),
        scene=dict(xaxis=dict(title="east in m", **axis), yaxis=dict(title="north in m", **axis),
                   zaxis=dict(title="up in m", **axis), aspectmode="manual",
                   aspectratio=dict(zip("xyz", map(float, _SIZE * np.maximum(ratio, 0.05)))),
                   camera=dict(eye=dict(zip("xyz", _side_view(samples["position_world"]))))))
    return figure, stretch


def _side_view(position_world):
    """Where to look from, to see the long side of a trajectory from the south."""
    centred = position_world[:, :2] - position_world[:, :2].mean(axis=0)
    _, directions = np.linalg.eigh(centred.T @ centred)
    across = directions[:, 0]
    across = across if across[1] < 0 else -across
    return float(1.8 * across[0]), float(1.8 * across[1]), 0.95


def _xyz(points):
    return {axis: np.float32(points[:, i]) for i, axis in enumerate("xyz")}


def _surface_meshes(surface, position_world):
    """Grids (x, y, z), each (rows, columns) m, of a surface around a trajectory."""
    if surface is None:
        return
    is_hill = isinstance(surface, Hill)
    # Along the hill's axes, else along east and north.
    turn = surface.axes[:2, :2] if is_hill else np.eye(2)
    along = position_world[:, :2] @ turn.T
    low, high = along.min(axis=0), along.max(axis=0)
    margin = np.maximum(0.05 * (high - low), 6.0)
    low, high = low - margin, high + margin
    for constraint in surface.constraints():
        if not constraint.height:
            continue
        ends = [low[0], high[0]]
        if constraint.phase == "in_run":
            ends[1] = min(ends[1], 0.0)
        elif constraint.phase == "landing":
            ends[0] = max(ends[0], 0.0)
        a, b = np.meshgrid(np.linspace(ends[0], ends[1], _CELLS), np.linspace(
            low[1], high[1], 5 if is_hill else _CELLS))
        x, y = np.moveaxis(np.stack([a, b], axis=-1) @ turn, -1, 0)
        flat = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
        # The residual of a height constraint is the height above the surface.
        yield x, y, -constraint.evaluate(flat)[0].reshape(x.shape)


def map_figure(samples: np.ndarray, fixes_world: np.ndarray) -> go.Figure:
    """Fixes and smoothed trajectory from above at one scale."""
    position, velocity = thinned(samples["position_world"], samples["vel_world"])
    (fixes,) = thinned(fixes_world)
    figure = go.Figure([
        go.Scatter(x=np.float32(fixes[:, 0]), y=np.float32(fixes[:, 1]), mode="markers",
                   name="fixes", marker=dict(size=5, color=fig.HIGHLIGHT, opacity=0.5,
                                             symbol="circle-open"), hoverinfo="skip"),
        go.Scatter(x=np.float32(position[:, 0]), y=np.float32(position[:, 1]),
                   mode="lines+markers", name="smoothed",
                   line=dict(color=fig.NEUTRAL, width=1),
                   marker=_speed_marks(np.linalg.norm(velocity, axis=1), 3.5),
                   hovertemplate="east %{x:.2f} m, north %{y:.2f} m<extra></extra>")])
    fig.style(figure, height=560)
    figure.update_layout(legend=dict(orientation="h", x=0, y=1.0, yanchor="bottom"))
    figure.update_xaxes(title_text="east in m")
    figure.update_yaxes(title_text="north in m", scaleanchor="x", scaleratio=1)
    return figure


def side_figure(hill: Hill, samples: np.ndarray, fixes_world: np.ndarray,
                events: JumpEvents) -> go.Figure:
    """The long section of a jump: profile, fixes, smoothed trajectory, events; one scale."""
    x, _, z = hill.to_hill(samples["position_world"]).T
    x_fix, _, z_fix = hill.to_hill(fixes_world).T
    figure = go.Figure()
    for profile, ends in ((hill.in_run, (min(x.min(), 0.0), 0.0)),
                          (hill.landing, (0.0, max(x.max(), 0.0)))):
        at = np.linspace(ends[0], ends[1], 400)
        figure.add_trace(go.Scatter(
            x=np.float32(at), y=np.float32(-profile(at)[0]), mode="lines", name="profile",
            legendgroup="profile", showlegend=profile is hill.in_run,
            line=dict(color=fig.REFERENCE, width=2), hoverinfo="skip"))
    x, z, time = thinned(x, z, (samples["stamp"] - events.takeoff) * 1e-9)
    figure.add_trace(go.Scatter(
        x=np.float32(x_fix), y=np.float32(-z_fix), mode="markers", name="fixes", hoverinfo="skip",
        marker=dict(size=5, color=fig.HIGHLIGHT, opacity=0.55, symbol="circle-open")))
    figure.add_trace(go.Scatter(
        x=np.float32(x), y=np.float32(-z), mode="lines", name="smoothed",
        customdata=np.float32(time).tolist(), line=dict(color=fig.ESTIMATE, width=2.5),
        hovertemplate="%{customdata:.2f} s after take-off<br>forward %{x:.2f} m<br>"
                      "up %{y:.2f} m<extra></extra>"))
    stamps = [events.takeoff, events.touchdown]
    since = samples["stamp"] - samples["stamp"][0]
    at = hill.to_hill(np.column_stack([np.interp(
        np.array(stamps) - samples["stamp"][0], since, column)
        for column in samples["position_world"].T]))
    figure.add_trace(go.Scatter(
        x=at[:, 0].tolist(), y=(-at[:, 2]).tolist(), mode="markers+text", name="events",
        text=["take-off", "touch-down"], textposition=["top center", "top right"],
        marker=dict(size=11, symbol="diamond", color=fig.SECONDARY,
                    line=dict(color="white", width=1)), hoverinfo="text"))
    fig.style(figure, height=560)
    figure.update_layout(legend=dict(orientation="h", x=0, y=1.0, yanchor="bottom"))
    figure.update_xaxes(title_text="forward from the table in m")
    figure.update_yaxes(title_text="up in m", scaleanchor="x", scaleratio=1)
    return figure
