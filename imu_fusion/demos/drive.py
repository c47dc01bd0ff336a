"""The demo of the smoother in a car: GNSS withheld for a while serves as the truth."""

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from imu_fusion.demos.data import data_folder
from imu_fusion.demos.trajectory import replay_and_smooth
from imu_fusion.evaluation.consistency import nees
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.logs import read_log
from imu_fusion.streams.stream import FIX_TOPIC, VELOCITY_TOPIC

# The drive: its stretches without GNSS, s, as in benchmarks/smoother_drive.py.
_LENGTH, _COUNT, _FIRST, _LAST = 15.0, 11, 60.0, -45.0
_FIXED = 2  # NavSatStatus of RTK solutions with fixed ambiguities


def show(out: Path, console: Console) -> None:
    """A car with RTK fixes, some stretches of which are withheld and serve as the truth."""
    bag, params_file = data_folder("bags") / "drive_0708", data_folder("config") / "drive_0708.yaml"
    withheld = out / "withheld"
    with open_bag(bag) as reader:
        truth = read_log(reader, FIX_TOPIC)
        stretches = _write_withheld(reader, withheld)
    smoothed = replay_and_smooth(withheld, out, params_file, console)
    # A fix shows where the antenna was when it was taken: its stamp less the delay found.
    place = smoothed.antenna(truth.stamp)
    world = smoothed.result.frame.to_enu(truth.latitude_deg, truth.longitude_deg, truth.height)
    samples = smoothed.result.samples
    row = np.searchsorted(samples["stamp"], truth.stamp).clip(0, len(samples) - 1)
    error, cov = place - world, samples["cov_position"][row]
    good = (truth.status == _FIXED) & np.isfinite(error).all(axis=1)
    table = Table("without GNSS", "driven m", "RMS m", "largest m", "NEES (ideal 3)",
                  title="position against the RTK fixes that the smoother has not seen")
    hidden = np.zeros(len(truth), bool)
    for start, end in stretches:
        inside = (truth.stamp >= start) & (truth.stamp < end)
        hidden |= inside
        since = (start - truth.stamp[0]) * 1e-9
        _add_row(table, f"{since:.0f} to {since + _LENGTH:.0f} s", world[inside],
                 error[inside & good], cov[inside & good])
    _add_row(table, "all of them", None, error[hidden & good], cov[hidden & good])
    _add_row(table, "with GNSS", None, error[~hidden & good], cov[~hidden & good])
    console.print(table)


def _write_withheld(reader, path):
    """Write a recording without GNSS in some stretches; returns these: [(start, end)] ns."""
    first = reader.start_time
    duration = (reader.end_time - first) * 1e-9
    stretches = [(first + round(start * 1e9), first + round((start + _LENGTH) * 1e9))
                 for start in np.linspace(_FIRST, duration + _LAST, _COUNT)]
    gnss = {f"/{FIX_TOPIC}", f"/{VELOCITY_TOPIC}"}
    with BagWriter(path, overwrite=True, whole=True) as writer:
        for topic, msgtype, stamp, cdr in reader.messages():
            if topic not in gnss or not any(a <= stamp < b for a, b in stretches):
                writer.write(topic, msgtype, cdr, stamp)
    return stretches


def _add_row(table, name, world, error, cov):
    driven = "" if world is None else f"{np.linalg.norm(np.diff(world, axis=0), axis=1).sum():.0f}"
    length = np.linalg.norm(error, axis=1)
    table.add_row(name, driven, f"{np.sqrt(np.mean(length ** 2)):.3f}", f"{length.max():.3f}",
                  f"{nees(error, cov).mean():.1f}")
