"""The section of the slope frame, of a ball whose smoothed motion is its truth."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.smoother.result import SAMPLE, SmootherResult
from imu_fusion.messages.convert import string_value
from imu_fusion.parameters.file import parameters_for
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.report.avalanche import slope_of, slope_section
from imu_fusion.report.html import Figure, Table, render_report
from imu_fusion.report.smoother import Smoothed
from imu_fusion.streams.smoother_params import SmootherNodeParams, SmoothingParams
from imu_fusion.surfaces.file import load_surface
from test.report.test_report import Page

ROOT = Path(__file__).resolve().parents[2]
BAG = ROOT / "bags" / "avalanche_simulated"


@pytest.fixture(scope="module")
def logs():
    with open_bag(BAG) as reader:
        ((_, _, _, cdr),) = reader.messages(["/reference/phases"])
        return {name: read_log(reader, name) for name in (
            "imu/data_raw", "imu/mag", "reference/pose", "fix")} | {
            "phases": {int(k): v for k, v in json.loads(string_value(cdr)).items()}}


@pytest.fixture(scope="module")
def smoothed(logs):
    """The truth of the recording as if the smoother had found it, stated to 0.1 m and 1 deg."""
    pose, raw = logs["reference/pose"], logs["imu/data_raw"]
    samples = np.zeros(len(pose), SAMPLE)
    time = (pose.stamp - pose.stamp[0]) * 1e-9
    samples["stamp"], samples["position_world"] = pose.stamp, pose.position_world
    samples["vel_world"] = np.gradient(pose.position_world, time, axis=0)
    samples["quat_world_imu"], samples["acc"] = pose.quat_world_imu, raw.acc
    turn = Rotation.from_quat(pose.quat_world_imu)
    samples["gyr"][1:] = (turn[:-1].inv() * turn[1:]).as_rotvec() / np.diff(time)[:, None]
    samples["cov_position"] = samples["cov_velocity"] = 0.01 * np.eye(3)
    samples["cov_attitude"] = np.radians(1.0) ** 2 * np.eye(3)
    params, _ = parameters_for((SmoothingParams, SmootherNodeParams), "smoother",
                               ROOT / "config" / "avalanche.yaml")
    surface = load_surface("fluela_plane")
    result = SmootherResult(samples, surface.origin, {}, {}, (0.0,), 1, True)
    return Smoothed(result, params, surface, logs["fix"], None, int(pose.stamp[0]))


def test_phases_velocities_and_flights_are_those_of_the_truth(smoothed, logs):
    slope = slope_of(smoothed, logs["imu/data_raw"])
    found = {t.number: slope.descent.entrained + t.time * 1e9 for t in slope.descent.transitions}
    # A sample of 150 Hz, a median over three of them, and noise on a slow rise.
    for number, stamp in logs["phases"].items():
        assert abs(found[number] - stamp) < 0.08e9, number
    first = slope.descent.flights[0]
    assert 0.5 < first.end - first.start < 1.2
    # The plane falls by 32 deg: all of the way lies in the slope frame's first axis.
    assert slope.position[-1, 0] > 400 and abs(slope.position[:, 2]).max() < 2.0


def test_the_section_has_its_tables_and_figures(smoothed, logs):
    section = slope_section(slope_of(smoothed, logs["imu/data_raw"]), logs["imu/mag"])
    phases, flights, in_situ = (b for b in section.blocks if isinstance(b, Table))
    assert [row[0][0] for row in phases.rows] == list("123456")
    assert all(len(row[-1]) > 10 for row in phases.rows)      # each with its reason
    lengths = [float(row[2]) for row in flights.rows]
    assert len(lengths) > 3 and max(lengths) == lengths[0] > 10
    figures = [b for b in section.blocks if isinstance(b, Figure)]
    assert len(figures) == 7
    text = Page(render_report("t", [section])).text
    assert "blind to a turn about the field" in text
    names = {trace.name for figure in figures for trace in figure.figure.data}
    assert {"terrain", "sensors alone, before calibration", "field model", "objective",
            "±3σ across"} <= names
    # True attitudes, an accelerometer that errs by 3 %: the terrain brings the track back to it.
    (off,) = (row[1] for row in in_situ.rows if row[0].startswith("off the slope"))
    before, after = (float(part.split()[0]) for part in off.split(","))
    assert before > 1.0 and after < 0.5
    # Within sixteen degrees of dip the uncalibrated field of the recording shows its iron.
    (dip,) = {float(trace.y[0]) for figure in figures for trace in figure.figure.data
              if trace.name == "field model" and 60 < trace.y[0] < 66}
    assert dip == pytest.approx(62.8, abs=0.1)


def test_what_is_no_ball_has_no_such_section(smoothed, logs):
    raw = logs["imu/data_raw"]
    still = Smoothed(smoothed.result, smoothed.params.replace(recover_rates=False),
                     smoothed.surface, None, None, smoothed.origin)
    assert slope_of(still, raw) is None
    nowhere = Smoothed(smoothed.result, smoothed.params, None, None, None, smoothed.origin)
    assert slope_of(nowhere, raw) is None
