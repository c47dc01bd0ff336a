"""The demo of the orientation: a sensor turned by hand, against an optical reference."""

import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from imu_fusion.demos.data import data_folder
from imu_fusion.evaluation.orientation_error import (
    moving_at,
    orientation_errors,
    shares_within,
    statistics,
)
from imu_fusion.messages.convert import attitude_log
from imu_fusion.nodes.processes import NodeProcesses
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.report.contents import moving_changes
from imu_fusion.report.recording import write_recording_report


def show(out: Path, console: Console) -> None:
    """Play a BROAD trial through replayer, orientation_estimator and recorder."""
    bag = data_folder("bags") / "broad_06_fast_rotation"
    recording = out / "recording"
    started = time.monotonic()
    with NodeProcesses(out / "logs") as nodes:
        nodes.start("recorder", out=str(recording), overwrite=True)
        nodes.start("orientation_estimator", qos="reliable")
        nodes.start("replayer", show=True, bag=str(bag), rate=0.0,
                    wait_for_nodes=("recorder", "orientation_estimator"))
        nodes.wait("replayer", 300)
        nodes.wait("recorder", 60)
    elapsed = time.monotonic() - started

    with open_bag(bag) as played, open_bag(recording) as recorded:
        duration = (played.end_time - played.start_time) * 1e-9
        console.print(_message_table(played, recorded))
        errors, moving = _compare(played, recorded)
    console.print(_error_table(errors, moving))
    report = out / "report.html"
    write_recording_report(bag, recording, report)
    console.print(f"{duration:.0f} s of data in {elapsed:.0f} s through three ROS 2 processes "
                  f"(domain {nodes.domain})\nrecording: {recording}\nreport:    {report}")


def _compare(played, recorded):
    """Errors of the recorded imu/data against the reference of what was played.

    Returns:
        (OrientationErrors, movement mask (n,) bool or None if the recording has none)
    """
    estimates = read_log(recorded, "imu/data", attitude_log)
    errors = orientation_errors(estimates.stamp, estimates.quat_world_imu,
                                read_log(played, "reference/pose"), estimates.cov_attitude)
    changes = moving_changes(played)
    return errors, None if changes is None else moving_at(errors.stamp, *changes)


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
