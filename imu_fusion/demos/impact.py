"""The demo of the acceleration field: eight accelerometers fill in clipped gyroscopes."""

from pathlib import Path

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from imu_fusion.batch import process
from imu_fusion.demos.data import data_folder
from imu_fusion.nodes.processes import NodeProcesses
from imu_fusion.parameters.file import load
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.report.recording import write_recording_report

# rad/s; from about here on some of the eight gyroscopes of the board clip themselves.
_MIMU_RANGE = 34.0


def replay(bag: Path, preset: Path, out: Path) -> Path:
    """Replay a recording through the node of the acceleration field, under a parameter file; the
    recording below ``out`` of what it publishes."""
    recording = out / "recording"
    with NodeProcesses(out / "logs") as nodes:
        nodes.start("recorder", out=str(recording), overwrite=True)
        nodes.start("acceleration_field_estimator", params_file=preset, qos="reliable")
        nodes.start("replayer", show=True, bag=str(bag), rate=0.0,
                    wait_for_nodes=("recorder", "acceleration_field_estimator"))
        nodes.wait("replayer", 300)
        nodes.wait("recorder", 60)
    return recording


def show(out: Path, console: Console) -> None:
    """Recover a gyroscope that clips at 1000 deg/s by eight accelerometers (mimu4444)."""
    bag, preset = data_folder("bags") / "mimu4444", data_folder("config") / "mimu4444.yaml"
    recording, smoothed = replay(bag, preset, out), out / "smoothed"
    values = load(preset)["acceleration_field_estimator"]
    (limit,) = values["sensor"]["gyro_range"]
    preset_smoothed = out / "smoothed.yaml"
    preset_smoothed.write_text(yaml.safe_dump({"acceleration_field_estimator": {
        "ros__parameters": {**values, "mode": "smoothed", "iteration": {"max": 10}}}}))
    process(bag, smoothed, preset_smoothed, without=("orientation_estimator", "smoother"),
            overwrite=True)
    with open_bag(bag) as played:
        truth = read_log(played, "imu/data_raw")
    table = Table("angular velocity where the gyroscope clips", "samples", "rms error rad/s",
                  "median", title=f"reference: the same gyroscope unclipped; it is taken to clip "
                                  f"at {limit:.1f} rad/s")
    for name, path in (("nodes, causal", recording), ("batch, smoothed", smoothed)):
        with open_bag(path) as reader:
            estimate = read_log(reader, "acceleration_field/imu")
        _, ours, theirs = np.intersect1d(estimate.stamp, truth.stamp, return_indices=True)
        clipped = (np.abs(truth.gyr) >= limit) & (np.abs(truth.gyr) < _MIMU_RANGE)
        error = (estimate.gyr[ours] - truth.gyr[theirs])[clipped[theirs]]
        table.add_row(name, str(len(error)), f"{np.sqrt(np.mean(error ** 2)):.2f}",
                      f"{np.median(np.abs(error)):.2f}")
    console.print(table)
    report = out / "report.html"
    write_recording_report(bag, smoothed, report, params_file=preset)
    console.print(f"recordings: {recording}, {smoothed}\nreport:     {report}")
