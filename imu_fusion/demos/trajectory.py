"""What the demos of the smoother share: the pipeline, the report, and whether both agree."""

import time
from pathlib import Path

import numpy as np
from rich.console import Console

from imu_fusion.errors import EstimationError
from imu_fusion.nodes.pipeline import run_pipeline
from imu_fusion.parameters.file import ParamsFile
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.report.recording import write_recording_report
from imu_fusion.report.smoother import Smoothed
from imu_fusion.streams.smoother_messages import SMOOTHED_FIX_TOPIC


def replay_and_smooth(bag: Path, out: Path, params_file: ParamsFile, console: Console) -> Smoothed:
    """Pipeline and report; the Smoothed of the report, which the nodes' output must equal."""
    recording, report = out / "recording", out / "report.html"
    started = time.monotonic()
    domain = run_pipeline(bag, recording, params_file, without=("orientation_estimator",),
                          overwrite=True, logs=out / "logs")
    elapsed = time.monotonic() - started
    with open_bag(recording) as reader:
        duration = (read_log(reader, "imu/data_raw").stamp[[0, -1]] * [-1, 1]).sum() * 1e-9
        recorded = read_log(reader, SMOOTHED_FIX_TOPIC)
    smoothed = write_recording_report(bag, None, report, params_file).smoothed
    if smoothed is None:
        raise EstimationError(f"{bag}: the nodes have smoothed it, the report has not")
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
