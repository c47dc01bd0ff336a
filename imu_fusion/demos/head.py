"""The demo of the acceleration field on a head: simulated, so that the truth is known."""

import json
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from imu_fusion.batch import process
from imu_fusion.demos.data import data_folder
from imu_fusion.demos.impact import replay
from imu_fusion.messages.convert import attitude_log, string_value
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.report.recording import write_recording_report


def show(out: Path, console: Console) -> None:
    """A simulated blow to a head with four accelerometers, compared with its truth."""
    bag = data_folder("bags") / "head_simulated"
    preset = data_folder("config") / "head_four_accelerometers.yaml"
    recording, estimates, report = replay(bag, preset, out), out / "estimates", out / "report.html"
    reports, _ = process(bag, estimates, preset, without=("orientation_estimator", "smoother"),
                         overwrite=True)
    (found,) = (report.results["peaks"] for report in reports if report.results)
    with open_bag(bag) as reader:
        ((_, _, _, cdr),) = reader.messages(["/reference/impact"])
        pose = read_log(reader, "reference/pose")
    truth = json.loads(string_value(cdr))
    with open_bag(recording) as reader:
        attitude = read_log(reader, "acceleration_field/imu", attitude_log)
    _, i, j = np.intersect1d(attitude.stamp, pose.stamp, return_indices=True)
    off = (Rotation.from_quat(attitude.quat_world_imu[i]).inv()
           * Rotation.from_quat(pose.quat_world_imu[j])).magnitude()
    table = Table("quantity", "estimate", "truth", "error",
                  title="SIMULATED blow to a head: estimate against its truth")
    for name, unit, estimate, true in (
            ("peak acceleration of the centre", "m/s^2", found["peak_linear_acceleration"][0],
             truth["peak_linear_acceleration"]),
            ("peak angular velocity", "rad/s", found["peak_angular_velocity"],
             truth["peak_angular_velocity"])):
        table.add_row(f"{name} in {unit}", f"{estimate:.4g}", f"{true:.4g}",
                      f"{100.0 * (estimate / true - 1.0):+.2f} %")
    table.add_row("orientation, largest error in deg", "", "", f"{np.degrees(off.max()):.2f}")
    console.print(table)
    write_recording_report(bag, estimates, report, params_file=preset)
    console.print(f"recordings: {recording}, {estimates}\nreport:     {report}")
