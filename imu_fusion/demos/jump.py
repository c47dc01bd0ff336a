"""The demo of the smoother on a ski jump: simulated, so that the truth is known."""

import json
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from imu_fusion.demos.data import data_folder
from imu_fusion.demos.trajectory import replay_and_smooth
from imu_fusion.errors import EstimationError
from imu_fusion.messages.convert import string_value
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log


def show(out: Path, console: Console) -> None:
    """A simulated ski jump, reconstructed and compared with its truth."""
    bag = data_folder("bags") / "jump_simulated"
    params_file = data_folder("config") / "jump_simulated.yaml"
    smoothed = replay_and_smooth(bag, out, params_file, console)
    with open_bag(bag) as reader:
        ((_, _, _, cdr),) = reader.messages(["/reference/jump"])
        pose = read_log(reader, "reference/pose")
    found, truth = smoothed.result.jump, json.loads(string_value(cdr))
    if found is None:
        raise EstimationError("no jump was found in the recording of a jump")
    table = Table("quantity", "estimate", "truth", "error",
                  title="SIMULATED jump on Oberstdorf HS106: estimate against its truth")
    for name, unit, digits, estimate, true in (
            (f"jump length (1\u03c3 {found.length_sd:.2f} m)", "m", 2, found.length,
             truth["length"]),
            ("take-off speed", "m/s", 2, found.takeoff_speed, truth["takeoff_speed"]),
            ("landing speed", "m/s", 2, found.landing_speed, truth["touchdown_speed"]),
            ("flight time", "s", 3, found.flight_time, truth["flight_time"])):
        table.add_row(f"{name} in {unit}", f"{estimate:.{digits}f}", f"{true:.{digits}f}",
                      f"{estimate - true:+.{digits}f}")
    samples = smoothed.result.samples
    _, i, j = np.intersect1d(samples["stamp"], pose.stamp, return_indices=True)
    error = samples["position_world"][i] - pose.position_world[j]
    rms = " / ".join(f"{e:.3f}" for e in np.sqrt(np.mean(error ** 2, axis=0)))
    table.add_row("position RMS E / N / U in m", "", "", rms)
    console.print(table)
