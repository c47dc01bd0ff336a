"""The demo of a ball in an avalanche: simulated, so that the truth is known."""

import json
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from imu_fusion.calibrate.magnetometer import (
    calibrate_recorded_magnetometer,
    magnetometer_parameters,
)
from imu_fusion.demos.data import data_folder
from imu_fusion.demos.trajectory import replay_and_smooth
from imu_fusion.errors import EstimationError
from imu_fusion.evaluation.consistency import nees
from imu_fusion.messages.convert import string_value
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.report.avalanche import slope_of

_BEFORE_GAP = 8.99   # s after the entrainment: then nothing was recorded for half a second


def show(out: Path, console: Console) -> None:
    """A simulated ball: its magnetometer calibrated in situ, then smoothed through the nodes."""
    bag, calibration = data_folder("bags") / "avalanche_simulated", out / "magnetometer.yaml"
    found, _ = calibrate_recorded_magnetometer(bag)
    calibration.write_text(magnetometer_parameters(found, bag))
    preset = data_folder("config") / "avalanche.yaml"
    smoothed = replay_and_smooth(bag, out, (preset, calibration), console)
    with open_bag(bag) as reader:
        raw, pose = read_log(reader, "imu/data_raw"), read_log(reader, "reference/pose")
        ((_, _, _, cdr),) = reader.messages(["/reference/phases"])
    slope = slope_of(smoothed, raw)
    if slope is None:
        raise EstimationError("no descent was found in the recording of one")
    console.print(_error_table(slope, smoothed.result.samples, pose))
    truth = {int(number): int(stamp) for number, stamp in json.loads(string_value(cdr)).items()}
    table = Table("phase", "begins s", "truth", "error s", title="phases from the signals")
    for at in slope.descent.transitions:
        true = (truth[at.number] - slope.descent.entrained) * 1e-9
        table.add_row(str(at.number), f"{at.time:.2f}", f"{true:.2f}", f"{at.time - true:+.3f}")
    console.print(table)


def _error_table(slope, samples, pose):
    """Errors against the truth in the slope frame, before the gap and over all of the motion."""
    _, i, j = np.intersect1d(samples["stamp"], pose.stamp, return_indices=True)
    rows = samples[i]
    error = (rows["position_world"] - pose.position_world[j]) @ slope.axes
    cov = slope.axes.T @ rows["cov_position"] @ slope.axes
    turn = (Rotation.from_quat(rows["quat_world_imu"]).inv()
            * Rotation.from_quat(pose.quat_world_imu[j])).as_rotvec()
    since = (rows["stamp"] - slope.descent.entrained) * 1e-9
    table = Table("RMS (stated)", "long. m", "lat. m", "transv. m", "NEES", "attitude deg", "NEES",
                  title="SIMULATED ball: errors in the slope frame (NEES: ideal 3)")
    for name, end in (("to the gap, 9 s", _BEFORE_GAP), ("all of it", 1e3)):
        part = (since >= 0.0) & (since < end)
        stated = np.sqrt(cov[part].diagonal(0, 1, 2).mean(axis=0))
        rms = np.sqrt(np.mean(error[part] ** 2, axis=0))
        table.add_row(name, *(f"{e:.2f} ({s:.2f})" for e, s in zip(rms, stated)),
                      f"{nees(error[part], cov[part]).mean():.1f}",
                      f"{np.degrees(np.sqrt(np.mean(np.sum(turn[part] ** 2, axis=1)))):.1f}",
                      f"{nees(turn[part], rows['cov_attitude'][part]).mean():.1f}")
    return table
