"""Sections about orientation: angles, errors against a reference, field, rates, force."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.evaluation import orientation_error
from imu_fusion.evaluation.orientation_error import OrientationErrors
from imu_fusion.report import figures as fig
from imu_fusion.report.figures import Band, Line, Panel, Shade, time_figure
from imu_fusion.report.html import Figure, Number, Numbers, Section, Table, Text
from imu_fusion.report.overview import number
from imu_fusion.samples import AttitudeLog, ImuLog, PoseLog, seconds

_MOVING = "in movement"


def euler_zyx(quat_world_imu: np.ndarray,
              cov_attitude: np.ndarray | None = None) -> tuple[np.ndarray, Any]:
    """Roll, pitch, yaw (REP 103: yaw about up, then pitch about left, then roll about forward).

    Args:
        quat_world_imu: (n, 4) xyzw.
        cov_attitude: (n, 3, 3) rad^2 of the local error, or None.

    Returns:
        angles (n, 3) rad; standard deviations (n, 3) rad to first order, at most pi (near
        pitch +-90 deg roll and yaw are not determined), NaN where the covariance is unknown.
    """
    rotation = Rotation.from_quat(quat_world_imu)
    yaw, pitch, roll = rotation.as_euler("ZYX").T
    angles = np.column_stack([roll, pitch, yaw])
    if cov_attitude is None:
        return angles, np.full_like(angles, np.nan)
    # d(roll, pitch, yaw) = J dtheta for a small rotation dtheta in the axes of the body.
    sin_roll, cos_roll = np.sin(roll), np.cos(roll)
    tan_pitch = np.tan(pitch)
    jacobian = np.zeros((len(angles), 3, 3))
    jacobian[:, 0, 0] = 1.0
    jacobian[:, 0, 1] = sin_roll * tan_pitch
    jacobian[:, 0, 2] = cos_roll * tan_pitch
    jacobian[:, 1, 1] = cos_roll
    jacobian[:, 1, 2] = -sin_roll
    jacobian[:, 2, 1] = sin_roll / np.cos(pitch)
    jacobian[:, 2, 2] = cos_roll / np.cos(pitch)
    cov = np.asarray(cov_attitude, dtype=np.float64)
    variance = np.einsum("nij,njk,nik->ni", jacobian, cov, jacobian)
    with np.errstate(invalid="ignore"):
        sd = np.where(variance > 0, np.sqrt(variance), np.nan)
    return angles, np.minimum(sd, np.pi)


def angle_panels(estimate: AttitudeLog, origin: int, reference: PoseLog | None = None,
                 reference_name: str = "reference") -> list[Panel]:
    """Panels of roll, pitch and yaw with their band, beside a reference.

    Args:
        estimate: AttitudeLog.
        origin: int ns, zero of the time axis.
        reference: PoseLog or None.
    """
    time = seconds(estimate.stamp, origin)
    angles, sd = (np.degrees(a) for a in euler_zyx(estimate.quat_world_imu,
                                                   estimate.cov_attitude))
    has_reference = False
    if reference is not None and len(reference):
        has_reference = True
        known = np.isfinite(reference.quat_world_imu).all(axis=1)
        ref_time = seconds(reference.stamp[known], origin)
        ref_angles = np.degrees(euler_zyx(reference.quat_world_imu[known])[0])
    panels = []
    for i, name in enumerate(("roll", "pitch", "yaw")):
        items: list[Line | Band] = [
            Band("estimate, ±3σ", time, angles[:, i] - 3 * sd[:, i], angles[:, i] + 3 * sd[:, i],
                 widest=180.0),
            Line("estimate", time, fig.break_wraps(angles[:, i]), fig.ESTIMATE)]
        if has_reference:
            items.append(Line(reference_name, ref_time, fig.break_wraps(ref_angles[:, i]),
                              fig.REFERENCE, dash="dot", width=1.2))
        panels.append(Panel(f"{name} in °", tuple(items)))
    return panels


def error_panels(errors: OrientationErrors, origin: int, word: str = "error") -> list[Panel]:
    """Panels of the error rotation in world axes with the stated standard deviations.

    Args:
        errors: OrientationErrors.
        origin: int ns, zero of the time axis.
        word: what it is called in the legend.
    """
    time = seconds(errors.stamp, origin)
    panels = []
    for i, name in enumerate(("tilt about east", "tilt about north", "heading")):
        sd = np.degrees(errors.sd_world[:, i])
        panels.append(Panel(f"{name} in °", (
            Band("±3σ stated", time, -3 * sd, 3 * sd, opacity=0.18),
            Band("±1σ stated", time, -sd, sd, opacity=0.38),
            Line(word, time, np.degrees(errors.rotation_world[:, i]), fig.ESTIMATE))))
    return panels


def orientation_section(estimate: AttitudeLog, origin: int, reference: PoseLog | None = None,
                        reference_name: str = "reference", shades: Sequence[Shade] = ()) -> Section:
    """Section with roll, pitch and yaw of an estimate beside a reference.

    Args:
        estimate, origin, reference: see :func:`angle_panels`.
        shades: sequence of Shade.
    """
    panels = angle_panels(estimate, origin, reference, reference_name)
    cov_world = orientation_error.attitude_cov_world(estimate.quat_world_imu,
                                                     estimate.cov_attitude)
    time = seconds(estimate.stamp, origin)
    variance = np.diagonal(cov_world, axis1=1, axis2=2)
    stated = [("tilt", np.sqrt(variance[:, 0] + variance[:, 1]), fig.ESTIMATE),
              ("heading", np.sqrt(variance[:, 2]), fig.HIGHLIGHT)]
    if np.isfinite(variance).any():
        panels.append(Panel("σ stated in °", tuple(
            Line(f"σ of {name}", time, np.degrees(sd), color) for name, sd, color in stated),
            from_zero=True))
    return Section("Orientation", (
        Figure(time_figure(panels, shades),
               "Roll, pitch and yaw of the sensor in east-north-up (REP 103: yaw counter-clockwise "
               "from east). Near a pitch of ±90° roll and yaw cannot be told apart and jump; "
               "errors are judged below without angles that can do that."),))


def error_section(errors: OrientationErrors, origin: int, moving: np.ndarray | None = None,
                  reference_name: str = "reference", is_truth: bool = True,
                  shades: Sequence[Shade] = ()) -> Section:
    """Section with the errors against a reference and their statistics.

    Args:
        errors: OrientationErrors.
        origin: int ns, zero of the time axis.
        moving: (n,) bool, or None.
        is_truth: whether the reference is so much better that differences are errors.
    """
    word = "error" if is_truth else "difference"
    time = seconds(errors.stamp, origin)
    rows = []
    for label, mask in ((_MOVING, moving), ("all samples", None)):
        if label == _MOVING and moving is None:
            continue
        rows += [(label, row.name, number(row.rmse_deg, 2), number(row.median_deg, 2),
                  number(row.p95_deg, 2), number(row.maximum_deg, 2), row.count)
                 for row in orientation_error.statistics(errors, mask)]
    table = Table(("samples", f"{word} angle", "RMS °", "median °", "95 % below °", "largest °",
                   "count"), tuple(rows),
                  f"{word.capitalize()}s relative to {reference_name}. The {word} rotation "
                  "(estimate times inverse reference, in the world) is split as in BROAD (Laidig "
                  "et al. 2021) into a heading part about the vertical and an inclination part "
                  "about a horizontal axis.")
    blocks: list[Any] = [table]
    if is_truth:
        blocks += _honesty(errors, moving)
    panels = error_panels(errors, origin, word)
    blocks.append(Figure(
        time_figure(panels, shades),
        f"The {word} rotation in the axes of the world with the standard deviations that the "
        "estimator stated."))
    variance = errors.sd_world ** 2
    panels = []
    for name, columns in (("total", [0, 1, 2]), ("heading", [2]), ("inclination", [0, 1])):
        expected = np.degrees(np.sqrt(variance[:, columns].sum(axis=1)))
        panels.append(Panel(f"{name} in °", (
            Band("3σ stated", time, 0 * expected, 3 * expected, opacity=0.18),
            Band("1σ stated", time, 0 * expected, expected, opacity=0.38),
            Line(f"{word} angle", time, np.degrees(getattr(errors, name)), fig.ESTIMATE)),
            from_zero=True))
    blocks.append(Figure(
        time_figure(panels, shades, panel_height=160),
        f"The {word} angles of the table; σ is the root of the sum of the variances involved, "
        "that is the RMS that the estimator expected."))
    return Section("Error against the reference" if is_truth
                   else f"Difference from {reference_name}", tuple(blocks))


def _honesty(errors, moving):
    """The table that compares stated with found errors, if the estimator stated any."""
    if not np.isfinite(errors.sd_world).any():
        return [Text("The estimates state no covariance.")]
    rows = []
    for label, mask in ((_MOVING, moving), ("all samples", None)):
        if label == _MOVING and moving is None:
            continue
        for name, shares in orientation_error.shares_within(errors, mask).items():
            rows.append((label, name, *(f"{100 * share:.1f} %" for share in shares)))
    rows.append(("a Gaussian", "", *(f"{100 * share:.1f} %"
                                     for share in orientation_error.GAUSSIAN_SHARES)))
    nees = errors.nees[np.isfinite(errors.nees)]
    return [Table(("samples", "error", "within 1σ", "within 2σ", "within 3σ"), tuple(rows),
                  "How honest the stated standard deviations are. Mean normalised squared error "
                  f"{nees.mean():.2f}; 3 would be expected.")]


def field_section(stamp: np.ndarray, mag_world: np.ndarray, origin: int,
                  shades: Sequence[Shade] = ()) -> Section:
    """Section with the magnetic field carried into the world by the estimate.

    Args:
        stamp: (n,) int64 ns; mag_world: (n, 3) tesla east, north, up, NaN where there is none.
    """
    time = seconds(stamp, origin)
    known = np.isfinite(mag_world).all(axis=1)
    time, field = time[known], mag_world[known]
    horizontal = np.hypot(field[:, 0], field[:, 1])
    norm = np.linalg.norm(field, axis=1) * 1e6
    dip = np.degrees(np.arctan2(-field[:, 2], horizontal))
    azimuth = np.degrees(np.arctan2(field[:, 0], field[:, 1]))
    rows = []
    for name, unit, values in (("strength", "µT", norm), ("inclination (dip below horizontal)",
                                                          "°", dip),
                               ("direction, east of north", "°", azimuth)):
        low, median, high = np.percentile(values, [5, 50, 95])
        rows.append((name, unit, number(median, 2), number(low, 2), number(high, 2),
                     number(values.std(), 2)))
    panels = [Panel(label, (Line("each sample", time, fig.break_wraps(values), fig.LIGHT, width=1),
                            Line("mean over 1 s", *_mean(time, values), fig.ESTIMATE, width=1.8)))
              for label, values in (("strength in µT", norm), ("inclination in °", dip),
                                    ("direction in °", azimuth))]
    return Section("Magnetic field", (
        Table(("quantity", "unit", "median", "5 %", "95 %", "standard deviation"), tuple(rows)),
        Figure(time_figure(panels, shades),
               "What the magnetometer measured, turned into the world by the estimated "
               "orientation. In an undisturbed field all three stand still. The strength does not "
               "depend on the orientation; inclination and direction do, and an estimator that "
               "steers by the field keeps them still.")))


def motion_section(raw: ImuLog, corrected: AttitudeLog, origin: int,
                   shades: Sequence[Shade] = ()) -> Section:
    """Section with angular rates and specific force.

    Args:
        raw: ImuLog as recorded, or None.
        corrected: AttitudeLog of the estimator, or None; not both are None.
        origin: int ns, zero of the time axis.
    """
    log = raw if raw is not None else corrected
    time = seconds(log.stamp, origin)
    panels = [Panel("angular rate in °/s", _xyz(time, np.degrees(log.gyr)))]
    caption = ["As recorded." if raw is not None else "As estimated."]
    if raw is not None and corrected is not None:
        shared, i, j = np.intersect1d(raw.stamp, corrected.stamp, return_indices=True)
        if len(shared):
            panels.append(Panel("correction in °/s", _xyz(
                seconds(shared, origin), np.degrees(corrected.gyr[j] - raw.gyr[i]))))
            caption.append("The correction is what the estimator added to the gyroscope: minus "
                           "its bias, plus what was recovered at its limit.")
    panels.append(Panel("specific force in m/s²", (
        *_xyz(time, log.acc),
        Line("norm", time, np.linalg.norm(log.acc, axis=1), fig.REFERENCE, width=1.0))))
    caption.append("The norm of the specific force is 9.81 m/s² at rest.")
    return Section("Angular rates and specific force", (
        Figure(time_figure(panels, shades), " ".join(caption)),))


def key_numbers(duration_s: float, imu_rate_hz: float, errors: OrientationErrors | None = None,
                moving: np.ndarray | None = None, findings: int = 0,
                is_truth: bool = True) -> Numbers:
    """The numbers at the top of a report."""
    items = [Number("Duration", f"{duration_s:.1f} s"),
             Number("Imu", f"{number(imu_rate_hz, 1)} Hz", "mean rate")]
    if errors is not None:
        where = "moving" if moving is not None else "all samples"
        word = "error" if is_truth else "difference"
        items += [Number(f"{row.name.capitalize()} {word}", f"{number(row.rmse_deg, 2)}°",
                         f"RMS, {where}")
                  for row in orientation_error.statistics(errors, moving)]
        shares = orientation_error.shares_within(errors, moving) if is_truth else {}
        for name, values in shares.items():
            if np.isfinite(values[0]):
                items.append(Number(f"{name.capitalize()} ≤ 3σ", f"{100 * values[2]:.1f} %",
                                    "Gaussian: 99.7 %"))
    items.append(Number("Remarks", str(findings), "on stamps, units"))
    return Numbers(tuple(items))


def _mean(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(time, mean) of the samples of every whole second."""
    second = np.floor(time).astype(np.int64)
    if len(time) == 0:
        return time, values
    starts = np.flatnonzero(np.r_[True, second[1:] != second[:-1]])
    count = np.diff(np.r_[starts, len(time)])
    return (np.add.reduceat(time, starts) / count, np.add.reduceat(values, starts) / count)


def _xyz(time, vectors):
    return tuple(Line(axis, time, vectors[:, i], color)
                 for i, (axis, color) in enumerate(fig.AXES.items()))
