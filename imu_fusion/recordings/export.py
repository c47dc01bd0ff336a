"""Recordings as tables for other programs: CSV with units in the header, TUM and GPX."""

import os
import shutil
from collections.abc import Callable, Collection
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from imu_fusion.errors import BagError
from imu_fusion.geometry.rotation_arrays import rpy_angles
from imu_fusion.messages.layouts import (
    ACCEL,
    FIX,
    IMU,
    MAG,
    NANOSECONDS,
    ODOMETRY,
    POSE,
    TWIST,
    Layout,
)
from imu_fusion.recordings.bag_reader import Lose, Reader, open_bag
from imu_fusion.recordings.logs import decoded_blocks
from imu_fusion.recordings.targets import make_parents, refuse_source, remove_empty

_XYZ = ("x", "y", "z")


def _axes(name: str, unit: str) -> list[str]:
    return [f"{name}_{axis} [{unit}]" for axis in _XYZ]


def _diagonal(values: np.ndarray, field: slice, size: int = 3, first: int = 0) -> np.ndarray:
    """Standard deviations (n, 3) of three axes of covariances from one on; NaN where unknown."""
    cov = values[:, field].reshape(len(values), size, size)
    sd = np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2)[:, first:first + 3], 0.0))
    return np.where(sd > 0.0, sd, np.nan)


def _imu(values: np.ndarray) -> np.ndarray:
    quat = values[:, IMU["orientation"]]
    absent = values[:, IMU["orientation_covariance"].start] == -1.0
    known = ~absent & (np.linalg.norm(quat, axis=1) > 0.5)
    angles = np.full((len(values), 3), np.nan)
    angles[known] = np.degrees(rpy_angles(quat[known]))
    rates, forces = (np.where(values[:, [IMU[f + "_covariance"].start]] == -1.0, np.nan,
                              values[:, IMU[f]]) for f in ("angular_velocity",
                                                           "linear_acceleration"))
    return np.column_stack([
        np.where(known[:, None], quat, np.nan), angles,
        np.where(known[:, None], np.degrees(_diagonal(values, IMU["orientation_covariance"])),
                 np.nan), rates, forces])


def _odometry(values: np.ndarray) -> np.ndarray:
    return np.column_stack([
        values[:, ODOMETRY["position"]], _diagonal(values, ODOMETRY["pose_covariance"], 6),
        values[:, ODOMETRY["orientation"]],
        np.degrees(rpy_angles(values[:, ODOMETRY["orientation"]])),
        values[:, ODOMETRY["linear"]], values[:, ODOMETRY["angular"]]])


def _accel(values: np.ndarray) -> np.ndarray:
    return np.column_stack([
        values[:, ACCEL["linear"]], _diagonal(values, ACCEL["covariance"], 6),
        values[:, ACCEL["angular"]], _diagonal(values, ACCEL["covariance"], 6, first=3)])


Columns = tuple[Layout, list[str], Callable[[np.ndarray], np.ndarray]]
_QUATERNION = ["q_x", "q_y", "q_z", "q_w"]
_ANGLES = ["roll [deg]", "pitch [deg]", "yaw [deg]"]
_COLUMNS: tuple[Columns, ...] = (
    (IMU, [*_QUATERNION, *_ANGLES, *_axes("sd_orientation_world", "deg"),
           *_axes("angular_velocity", "rad/s"), *_axes("specific_force", "m/s^2")], _imu),
    (MAG, _axes("magnetic_field", "T"), lambda v: v[:, MAG["magnetic_field"]]),
    (FIX, ["status", "latitude [deg]", "longitude [deg]", "height [m]", "sd_east [m]",
           "sd_north [m]", "sd_up [m]"], lambda v: np.column_stack(
        [v[:, 0], v[:, 2:5], _diagonal(v, FIX["position_covariance"])])),
    (TWIST, ["v_east [m/s]", "v_north [m/s]", "v_up [m/s]", "sd_east [m/s]", "sd_north [m/s]",
             "sd_up [m/s]"], lambda v: np.column_stack(
        [v[:, TWIST["linear"]], _diagonal(v, TWIST["covariance"], 6)])),
    (POSE, [*_axes("position", "m"), *_QUATERNION, *_ANGLES], lambda v: np.column_stack(
        [v[:, POSE["position"]], v[:, POSE["orientation"]],
         np.degrees(rpy_angles(v[:, POSE["orientation"]]))])),
    (ODOMETRY, [*_axes("position", "m"), *_axes("sd_position", "m"), *_QUATERNION, *_ANGLES,
                *_axes("velocity_body", "m/s"), *_axes("angular_velocity", "rad/s")], _odometry),
    (ACCEL, [*_axes("acceleration", "m/s^2"), *_axes("sd_acceleration", "m/s^2"),
             *_axes("angular_acceleration", "rad/s^2"),
             *_axes("sd_angular_acceleration", "rad/s^2")], _accel))
_TABLES = {columns[0].msgtype: columns for columns in _COLUMNS}
# Biases travel in the angular part of a twist.
_BIAS_TOPIC = "imu/gyro_bias"
_BIAS: Columns = (TWIST, [*_axes("gyro_bias", "rad/s"), *_axes("sd_gyro_bias", "rad/s")],
                  lambda v: np.column_stack([v[:, TWIST["angular"]], _diagonal(
                      v, TWIST["covariance"], 6, first=3)]))


def export(path: str | Path, out: str | Path, topics: Collection[str] = (),
           forms: Collection[str] = (), lose: Lose = lambda text: None) -> dict[str, int]:
    """Write each topic that has numbers as a table.

    Args:
        path: recording, or file of a device. topics: those to write; all, if empty.
        out: folder to make: ``<topic>.csv``, a row for each message, with stamps in ns since 1970
            and in s since the first message of the recording; of poses also ``<topic>.tum`` (time,
            position, quaternion x y z w), of fixes ``<topic>.gpx``.
        forms: those of csv, tum and gpx to write; all, if empty.
        lose: called with texts on what of the recording cannot be read.

    Returns:
        dict of file name to number of rows.

    Raises:
        BagError: ``out`` exists, or cannot be written; nothing is left behind then.
    """
    out = Path(out)
    refuse_source(path, out)
    if out.exists():
        raise BagError(f"{out}: exists already; choose another folder")
    part = out.with_name(f".{out.name}.part-{os.getpid()}")
    folders: list[Path] = []
    try:
        folders = make_parents(out)
        part.mkdir()
        with open_bag(path) as reader:
            wanted = [reader.require(topic).name for topic in topics] or list(reader.topics)
            counts: dict[str, int] = {}
            for name in wanted:
                if reader.topics[name].msgtype in _TABLES:
                    counts |= _write(reader, name, part, forms)
        if not counts:
            raise BagError(f"{path}: no topic that can be a table"
                           + (f" of the form {' or '.join(forms)}" if forms else "")
                           + f": {', '.join(sorted(_TABLES))}")
        os.rename(part, out)
    except OSError as error:
        raise BagError(f"{out}: cannot be written ({error.strerror})") from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
        remove_empty(folders)
    for text in reader.losses:
        lose(text)
    return counts


def _write(reader: Reader, topic: str, folder: Path, forms: Collection[str]) -> dict[str, int]:
    """{file: rows} of the files of one topic."""
    chosen = _BIAS if topic.endswith(_BIAS_TOPIC) else _TABLES[reader.topics[topic].msgtype]
    layout, names, values = chosen
    stem = topic.strip("/").replace("/", "_")
    suffixes: dict[str, Any] = {".csv": _Csv(names)}
    if layout in (POSE, ODOMETRY):
        suffixes[".tum"] = _Tum(layout)
    elif layout is FIX:
        suffixes[".gpx"] = _Gpx()
    if forms:
        suffixes = {suffix: form for suffix, form in suffixes.items() if suffix[1:] in forms}
    counts = {}
    with ExitStack() as stack:
        files = {suffix: stack.enter_context(open(folder / (stem + suffix), "w"))
                 for suffix in suffixes}
        for suffix, form in suffixes.items():
            files[suffix].write(form.head)
            counts[stem + suffix] = 0
        for block in decoded_blocks(reader, topic, layout):
            stamp, raw = block.stamp, block.values
            table = values(raw)
            for suffix, form in suffixes.items():
                lines = form.lines(stamp, stamp - reader.start_time, table, raw)
                files[suffix].writelines(lines)
                counts[stem + suffix] += len(lines)
        for suffix, form in suffixes.items():
            files[suffix].write(form.tail)
    return counts


def _text(value: float) -> str:
    """Empty where there is no number."""
    return "" if np.isnan(value) else f"{value:.10g}"


class _Csv:
    """A row for each message."""

    tail = ""

    def __init__(self, names: list[str]) -> None:
        self.head = ",".join(["stamp [ns]", "time [s]", *names]) + "\n"

    def lines(self, stamp: np.ndarray, since: np.ndarray, table: np.ndarray,
              raw: np.ndarray) -> list[str]:
        return [",".join([str(s), f"{t * 1e-9:.9f}", *map(_text, row)]) + "\n"
                for s, t, row in zip(stamp.tolist(), since.tolist(), table.tolist())]


class _Tum:
    """Trajectories as evaluation tools take them: https://cvg.cit.tum.de/data/datasets."""

    head, tail = "# time [s] x y z [m] q_x q_y q_z q_w\n", ""

    def __init__(self, layout: Layout) -> None:
        self._position, self._quaternion = layout["position"], layout["orientation"]

    def lines(self, stamp: np.ndarray, since: np.ndarray, table: np.ndarray,
              raw: np.ndarray) -> list[str]:
        rows = np.column_stack([raw[:, self._position], raw[:, self._quaternion]])
        return [f"{s // NANOSECONDS}.{s % NANOSECONDS:09d} " + " ".join(f"{v:.10g}" for v in row)
                + "\n" for s, row in zip(stamp.tolist(), rows.tolist())]


class _Gpx:
    """A track of the fixes that there are; heights stay those of the recording, above the
    ellipsoid."""

    head = ('<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" creator="imu_fusion" '
            'xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>\n')
    tail = "</trkseg></trk></gpx>\n"

    def lines(self, stamp: np.ndarray, since: np.ndarray, table: np.ndarray,
              raw: np.ndarray) -> list[str]:
        return [f'<trkpt lat="{lat:.9f}" lon="{lon:.9f}"><ele>{height:.3f}</ele>'
                f"<time>{_moment(s)}</time></trkpt>\n"
                for s, status, lat, lon, height in zip(stamp.tolist(), *table[:, :4].T.tolist())
                if status >= 0 and np.isfinite([lat, lon, height]).all()]


def _moment(stamp: int) -> str:
    return f"{datetime.fromtimestamp(stamp // NANOSECONDS, UTC):%Y-%m-%dT%H:%M:%S}" \
           f".{stamp % NANOSECONDS // 1000:06d}Z"
