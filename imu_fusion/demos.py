"""``imu_fusion demo``: the main job on a real recording, through real ROS 2 nodes."""

import os
import sys
import time
from pathlib import Path

import numpy as np
import yaml
from rich.table import Table

import imu_fusion
from imu_fusion.batch import process
from imu_fusion.errors import BagError, ParameterError
from imu_fusion.estimation.orientation_error import (moving_at, orientation_errors, shares_within,
                                                     statistics)
from imu_fusion.graph import Graph
from imu_fusion.messages.bag import open_bag
from imu_fusion.messages.convert import attitude_log, bool_value, read_log
from imu_fusion.parameter_file import load
from imu_fusion.report.recording import write_orientation_report


def bags_directory():
    """Where the recordings of the package are: in the checkout, or installed under share/.

    Raises:
        BagError: neither is there.
    """
    prefixes = [sys.prefix, *os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)]
    candidates = [Path(imu_fusion.__file__).parent.parent / "bags"]
    candidates += [Path(prefix) / "share" / "imu_fusion" / "bags" for prefix in prefixes if prefix]
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    raise BagError("the recordings of the demo are not installed; looked in "
                   + ", ".join(map(str, candidates)))


def orientation(out, console):
    """Play a BROAD trial through replayer, orientation_estimator and recorder."""
    bag = bags_directory() / "broad_06_fast_rotation"
    recording = out / "recording"
    started = time.monotonic()
    with Graph(out / "logs") as graph:
        graph.start("recorder", out=str(recording), overwrite=True)
        graph.start("orientation_estimator", qos="reliable")
        graph.start("replayer", show=True, bag=str(bag), rate=0.0,
                    wait_for_nodes=("recorder", "orientation_estimator"))
        graph.wait("replayer", 300)
        graph.wait("recorder", 60)
    elapsed = time.monotonic() - started

    with open_bag(bag) as played, open_bag(recording) as recorded:
        duration = (played.end_time - played.start_time) * 1e-9
        console.print(_message_table(played, recorded))
        errors, moving = compare(played, recorded)
    console.print(_error_table(errors, moving))
    report = out / "report.html"
    write_orientation_report(bag, recording, report)
    console.print(f"{duration:.0f} s of data in {elapsed:.0f} s through three ROS 2 processes "
                  f"(domain {graph.domain})\nrecording: {recording}\nreport:    {report}")


def compare(played, recorded):
    """Errors of the recorded imu/data against the reference of what was played.

    Returns:
        (OrientationErrors, movement mask (n,) bool or None if the recording has none)
    """
    estimates = read_log(recorded, "imu/data", attitude_log)
    errors = orientation_errors(estimates.stamp, estimates.quat_world_imu,
                                read_log(played, "reference/pose"), estimates.cov_attitude)
    changes = [(log_time, bool_value(cdr)) for _, _, log_time, cdr
               in played.messages(["/reference/moving"])]
    if not changes:
        return errors, None
    stamps, values = zip(*changes)
    return errors, moving_at(errors.stamp, np.array(stamps), np.array(values))


def _message_table(played, recorded):
    table = Table("topic", "played", "recorded", "lost", title="messages")
    for name, info in sorted(recorded.topics.items()):
        source = played.topics.get(name)
        if source is None and name in ("/imu/data", "/imu/rpy/filtered"):
            source = played.topics["/imu/data_raw"]  # one estimate per Imu
        lost = "" if source is None else str(source.count - info.count)
        table.add_row(name, "" if name not in played.topics else str(source.count),
                      str(info.count), lost)
    return table


def _error_table(errors, moving):
    table = Table("error angle", "RMSE deg", "median", "95 %", "largest",
                  title="orientation against the optical reference, while moving")
    for row in statistics(errors, moving):
        table.add_row(row.name, f"{row.rmse_deg:.2f}", f"{row.median_deg:.2f}",
                      f"{row.p95_deg:.2f}", f"{row.maximum_deg:.2f}")
    for name, (_, _, three) in shares_within(errors, moving).items():
        table.add_row(f"{name} within 3 sigma", f"{100 * three:.1f} %", "", "", "")
    return table


def impact(out, console):
    """Recover a gyroscope that clips at 1000 deg/s by eight accelerometers (mimu4444)."""
    bag = bags_directory() / "mimu4444"
    preset = bags_directory().parent / "config" / "mimu4444.yaml"
    recording, smoothed = out / "recording", out / "smoothed"
    with Graph(out / "logs") as graph:
        graph.start("recorder", out=str(recording), overwrite=True)
        graph.start("acceleration_field_estimator", params_file=preset, qos="reliable")
        graph.start("replayer", show=True, bag=str(bag), rate=0.0,
                    wait_for_nodes=("recorder", "acceleration_field_estimator"))
        graph.wait("replayer", 300)
        graph.wait("recorder", 60)
    values = load(preset)["acceleration_field_estimator"]
    limit = values["gyroscope"]["range"]
    preset_smoothed = out / "smoothed.yaml"
    preset_smoothed.write_text(yaml.safe_dump({"acceleration_field_estimator": {
        "ros__parameters": {**values, "mode": "smoothed"}}}))
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
    for path, parameters in ((recording, preset), (smoothed, preset_smoothed)):
        write_orientation_report(bag, path, out / f"{path.name}.html", parameters)
    console.print(f"recordings: {recording}, {smoothed}\nreports:    {out / 'recording.html'}, "
                  f"{out / 'smoothed.html'}")


# rad/s; from about here on some of the eight gyroscopes of the board clip themselves.
_MIMU_RANGE = 34.0

DEMOS = {"orientation": orientation, "impact": impact}


def run(name, out, console):
    """Run a demo.

    Args:
        name: one of DEMOS.
        out: directory for its files.
        console: rich Console.

    Raises:
        ParameterError: no such demo.
        ImuFusionError: a node failed.
    """
    if name not in DEMOS:
        raise ParameterError(f"no demo '{name}'; there are: {', '.join(DEMOS)}")
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    DEMOS[name](out, console)
