"""Noise of a sensor from a recording at rest: Allan deviation, as the parameters that estimators
take.

The deviation itself is that of the library allantools (overlapping). White noise of density N falls
as N / sqrt(tau), a walk K rises as K sqrt(tau / 3), the instability B of the bias is the level
between them, .664 B (IEEE Std 952).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from imu_fusion.calibrate.files import parameter_text, read_topic
from imu_fusion.errors import CalibrationError
from imu_fusion.recordings.bag_reader import Lose, open_bag

_IMU, _MAG = "imu/data_raw", "imu/mag"
_FLICKER = 0.664       # of the bias instability, is the lowest deviation
_SHORTEST = 5.0        # s, for white noise
_LONG = 1800.0         # s, for an instability and a walk that mean something
_FEWEST = 9            # averages, of which a deviation is known to some 20 %
_WHITE = (-0.65, -0.35)    # slopes of the deviation that pass for white noise,
_WALK = 0.25               # and for a walk
_MOVED = 2.0           # times the scatter of the others: a tenth that was not still
_AXES = "xyz"


@dataclass(frozen=True, eq=False)
class NoiseOfSensor:
    """``name``; ``unit`` of a sample; ``tau`` (k,) s and ``deviation`` (k, 3) of Allan; ``density``
    (3,) unit/sqrt(Hz) of white noise; ``instability`` (3,) unit; ``walk`` (3,) unit/sqrt(s), nan
    where the recording is too short to show one; ``mean`` and ``sample_sd`` (3,) of the samples."""

    name: str
    unit: str
    tau: np.ndarray
    deviation: np.ndarray
    density: np.ndarray
    instability: np.ndarray
    walk: np.ndarray
    mean: np.ndarray
    sample_sd: np.ndarray


def noise_of(name: str, unit: str, values: np.ndarray, rate: float) -> NoiseOfSensor:
    """Noise of evenly sampled readings.

    Args:
        name, unit: of the sensor. values: (n, 3). rate: Hz.

    Raises:
        CalibrationError: less than half a minute.
    """
    import allantools  # here: an extra, which brings matplotlib along
    if len(values) < _SHORTEST * rate:
        raise CalibrationError(f"{name}: {len(values) / rate:.0f} s of rest; noise takes at least "
                               f"{_SHORTEST:.0f} s, better half an hour")
    columns = []
    for column in values.T:
        tau, deviation, _, count = allantools.oadev(column - column.mean(), rate=rate,
                                                    data_type="freq", taus="octave")
        # Overlapping averages are not independent: count those that are.
        keep = len(column) / rate / tau >= _FEWEST
        columns.append(deviation[keep])
    tau, deviation = tau[keep], np.column_stack(columns)
    density, instability, walk = (np.full(3, np.nan) for _ in range(3))
    for k in range(3):
        density[k], instability[k], walk[k] = _read_off(tau, deviation[:, k])
    return NoiseOfSensor(name, unit, tau, deviation, density, instability, walk,
                         values.mean(axis=0), values.std(axis=0))


def _read_off(tau, deviation):
    """White density, instability, walk (nan if the curve does not rise) of one axis."""
    slope = np.diff(np.log(np.maximum(deviation, 1e-300))) / np.diff(np.log(tau))
    white = np.flatnonzero((slope > _WHITE[0]) & (slope < _WHITE[1]))
    # Without such a stretch the shortest time is the best guess: an upper limit.
    at = white if len(white) else np.array([0])
    density = float(np.exp(np.mean(np.log(deviation[at] * np.sqrt(tau[at])))))
    lowest = int(np.argmin(deviation))
    rising = np.flatnonzero((slope > _WALK) & (np.arange(len(slope)) >= lowest))
    walk = float(np.exp(np.mean(np.log(deviation[rising + 1] * np.sqrt(3.0 / tau[rising + 1])))
                        )) if len(rising) else np.nan
    return density, float(deviation[lowest]) / _FLICKER, walk


def recorded_noise(bag: str | Path, topic: str = _IMU, mag_topic: str = _MAG,
                   lose: Lose = lambda text: None) -> tuple[list[NoiseOfSensor], list[str]]:
    """Noise of gyroscope, accelerometer and, where there is one, magnetometer in a recording.

    Args:
        lose: called with texts on what of it cannot be read.

    Returns:
        list of NoiseOfSensor, and texts on what makes it doubtful.

    Raises:
        TopicError: no such topic. CalibrationError: too short.
    """
    imu, _, remarks = read_topic(bag, topic, lose)
    parts = [("gyroscope", "rad/s", imu.stamp, imu.gyr), ("accelerometer", "m/s^2", imu.stamp,
                                                          imu.acc)]
    with open_bag(bag) as reader:
        has_mag = mag_topic in {name.lstrip("/") for name in reader.topics}
    if has_mag:
        mag, _, left_out = read_topic(bag, mag_topic, lose)
        remarks += left_out
        parts.append(("magnetometer", "T", mag.stamp, mag.mag))
    found = []
    for name, unit, stamp, values in parts:
        values = values[np.isfinite(values).all(axis=1)]
        if len(values) < 2:
            raise CalibrationError(f"{bag}: {name}: {len(values)} usable samples; "
                                   + "; ".join(remarks))
        steps = np.diff(stamp) * 1e-9
        rate = 1.0 / float(np.median(steps))
        found.append(noise_of(name, unit, values, rate))
        if steps.max() > 1.5 / rate:
            remarks.append(f"{name}: samples are missing (gaps up to {steps.max():.3f} s): the "
                           "deviation takes what is left as even")
        if _moves(values):
            remarks.append(f"{name}: not still: a tenth of the recording scatters far more "
                           "than the others; lay it where nobody walks, and cut the ends off")
        if len(values) / rate < _LONG:
            remarks.append(f"{name}: {len(values) / rate:.0f} s show white noise; instability and "
                           f"walk take {_LONG / 60:.0f} min or more, and are upper limits here")
    return found, remarks


def _moves(values):
    """Whether a tenth of readings (n, 3) scatters far more than the others."""
    tenth = len(values) // 10
    spread = values[:10 * tenth].reshape(10, tenth, 3).std(axis=1)
    return bool((spread.max(axis=0) > _MOVED * np.median(spread, axis=0)).any())


def noise_report(found: NoiseOfSensor) -> list[tuple[str, str]]:
    """What is said of a sensor: (name, value with its unit) for x, y, z."""
    def three(values):
        return ", ".join("-" if np.isnan(v) else f"{v:.3g}" for v in values)

    unit = found.unit
    return [(f"{found.name}: white noise, {unit}/sqrt(Hz)", three(found.density)),
            (f"{found.name}: instability of the bias, {unit}", three(found.instability)),
            (f"{found.name}: walk of the bias, {unit}/sqrt(s)", three(found.walk)),
            (f"{found.name}: one sample, {unit}", three(found.sample_sd)),
            (f"{found.name}: mean, {unit}", three(found.mean))]


def noise_parameters(found: list[NoiseOfSensor], bag: str | Path) -> str:
    """A ROS 2 parameter file (YAML) for all nodes: the worst axis of each sensor.

    A walk that the recording does not show is left out, and the estimators keep their own.
    """
    values, said, about = {}, [], {}
    for sensor in found:
        if sensor.name == "magnetometer":
            values["sensor.mag_noise_sd"] = float(sensor.sample_sd.max())
        else:
            short = "gyro" if sensor.name == "gyroscope" else "acc"
            values[f"sensor.{short}_noise_density"] = float(sensor.density.max())
            if not np.isnan(sensor.walk).all():
                values[f"sensor.{short}_bias_walk"] = float(np.nanmax(sensor.walk))
        said.append(f"{sensor.name}: instability of the bias "
                    f"{np.max(sensor.instability):.3g} {sensor.unit}")
        about[f"{sensor.name}_tau"] = [float(v) for v in sensor.tau]
        about[f"{sensor.name}_deviation"] = [float(v) for v in sensor.deviation.ravel()]
    return parameter_text("noise", values, bag, said, {"method": "Allan deviation", **about})


def write_plot(found: list[NoiseOfSensor], path: str | Path) -> None:
    """Write the Allan deviations as one HTML file."""
    from plotly.subplots import make_subplots  # an extra, too
    figure = make_subplots(rows=len(found), cols=1, vertical_spacing=0.1,
                           subplot_titles=[f"{s.name}, {s.unit}" for s in found])
    for row, sensor in enumerate(found, start=1):
        for k, axis in enumerate(_AXES):
            figure.add_scatter(x=sensor.tau, y=sensor.deviation[:, k], name=axis, row=row, col=1,
                               legendgroup=axis, showlegend=row == 1)
    figure.update_xaxes(type="log", title_text="averaging time in s")
    figure.update_yaxes(type="log")
    figure.update_layout(height=340 * len(found), title="Allan deviation", template="none")
    figure.write_html(str(path), include_plotlyjs=True)
