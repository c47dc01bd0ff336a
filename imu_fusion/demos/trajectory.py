"""The demos of the smoother: a car without GNSS for a while, and a simulated ski jump."""

import json
import os
import sys
import time
from pathlib import Path

import numpy as np
from rich.table import Table

import imu_fusion
from imu_fusion.nodes import pipeline
from imu_fusion.errors import BagError
from imu_fusion.evaluation.consistency import nees
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.messages.convert import string_value
from imu_fusion.recordings.logs import read_log
from imu_fusion.streams.smoother import FIX_TOPIC, SMOOTHED_FIX_TOPIC, VELOCITY_TOPIC
from imu_fusion.report.recording import write_recording_report

# The drive: its stretches without GNSS, s, as in benchmarks/smoother_drive.py.
_LENGTH, _COUNT, _FIRST, _LAST = 15.0, 11, 60.0, -45.0
_FIXED = 2  # NavSatStatus of RTK solutions with fixed ambiguities


def shared(folder):
    """A data folder of the package: in the checkout, or installed under share/.

    Raises:
        BagError: neither is there.
    """
    prefixes = [sys.prefix, *os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)]
    candidates = [Path(imu_fusion.__file__).parent.parent / folder]
    candidates += [Path(prefix) / "share" / "imu_fusion" / folder for prefix in prefixes if prefix]
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    raise BagError("the files of the demo are not installed; looked in "
                   + ", ".join(map(str, candidates)))


def drive(out, console):
    """A car with RTK fixes, some stretches of which are withheld and serve as the truth."""
    bag, params_file = shared("bags") / "drive_0708", shared("config") / "drive_0708.yaml"
    withheld = out / "withheld"
    with open_bag(bag) as reader:
        truth = read_log(reader, FIX_TOPIC)
        stretches = _write_withheld(reader, withheld)
    smoothed = _run(withheld, out, params_file, console)
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
    with BagWriter(path, overwrite=True) as writer:
        for topic, msgtype, stamp, cdr in reader.messages():
            if topic not in gnss or not any(a <= stamp < b for a, b in stretches):
                writer.write(topic, msgtype, cdr, stamp)
    return stretches


def _add_row(table, name, world, error, cov):
    driven = "" if world is None else f"{np.linalg.norm(np.diff(world, axis=0), axis=1).sum():.0f}"
    length = np.linalg.norm(error, axis=1)
    table.add_row(name, driven, f"{np.sqrt(np.mean(length ** 2)):.3f}", f"{length.max():.3f}",
                  f"{nees(error, cov).mean():.1f}")


def jump(out, console):
    """A simulated ski jump, reconstructed and compared with its truth."""
    bag, params_file = shared("bags") / "jump_simulated", shared("config") / "jump_simulated.yaml"
    smoothed = _run(bag, out, params_file, console)
    with open_bag(bag) as reader:
        ((_, _, _, cdr),) = reader.messages(["/reference/jump"])
        pose = read_log(reader, "reference/pose")
    found, truth = smoothed.result.jump, json.loads(string_value(cdr))
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


def _run(bag, out, params_file, console):
    """Pipeline and report; the Smoothed of the report, which the nodes' output must equal."""
    recording, report = out / "recording", out / "report.html"
    started = time.monotonic()
    domain = pipeline.run(bag, recording, params_file, without=("orientation_estimator",),
                          overwrite=True, logs=out / "logs")
    elapsed = time.monotonic() - started
    with open_bag(recording) as reader:
        duration = (read_log(reader, "imu/data_raw").stamp[[0, -1]] * [-1, 1]).sum() * 1e-9
        recorded = read_log(reader, SMOOTHED_FIX_TOPIC)
    smoothed = write_recording_report(bag, None, report, params_file)
    samples, frame = smoothed.result.samples, smoothed.result.frame
    latitude, longitude, height = frame.to_geodetic(samples["position_world"])
    same = (np.array_equal(recorded.stamp, samples["stamp"])
            and np.array_equal(recorded.latitude_deg, latitude)
            and np.array_equal(recorded.longitude_deg, longitude)
            and np.array_equal(recorded.height, height))
    console.print(f"{duration:.0f} s of data in {elapsed:.0f} s through four ROS 2 processes "
                  f"(domain {domain}): {smoothed.result.summary()}")
    console.print("the nodes recorded " + (
        "the same positions as smoothing in this process, bit for bit" if same else
        "OTHER positions than smoothing in this process: please report this"))
    console.print(f"recording: {recording}\nreport:    {report}")
    return smoothed
