"""The smoother's part of the report: what its figures and tables say of a jump with a truth."""

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from imu_fusion import cli
from imu_fusion.estimation.smoother import SmootherParams
from imu_fusion.estimation.smoother.params import Gnss
from imu_fusion.estimation.smoother.result import SAMPLE
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.logs import read_log
from imu_fusion.report import smoother as report
from imu_fusion.report.contents import make_estimates, smoothed_of
from imu_fusion.report.html import Figure, Table, render_report
from imu_fusion.report.recording import write_recording_report
from imu_fusion.report.smoother import Smoothed, interpolate, smoother_sections
from imu_fusion.report.trajectory import map_figure, side_figure, space_figure
from test.report.test_report import Page

ROOT = Path(__file__).resolve().parents[2]
BAG, PARAMS = ROOT / "bags" / "jump_simulated", ROOT / "config" / "jump_simulated.yaml"


@pytest.fixture(scope="module")
def smoothed():
    _, report = make_estimates(BAG, PARAMS, with_orientation=False)
    found, reason = smoothed_of(report, int(report.detail[1]["imu/data_raw"].stamp[0]))
    assert reason is None
    return found


@pytest.fixture(scope="module")
def sections(smoothed):
    with open_bag(BAG) as reader:
        reference = read_log(reader, "reference/pose")
    return {s.title: s for s in smoother_sections(smoothed, reference)}


def table(section):
    return next(b for b in section.blocks if isinstance(b, Table))


def test_a_jump_has_all_sections_and_its_own_numbers(smoothed, sections):
    assert list(sections) == [
        "Trajectory", "Jump", "Errors", "Velocity", "Attitude of the trajectory", "Sensor errors",
        "Before and after", "Innovations", "Surface"]
    rows = {row[0]: row[1] for row in table(sections["Jump"]).rows}
    assert float(rows["jump length"]) == pytest.approx(smoothed.result.jump.length, abs=0.005)
    text = Page(render_report("t", list(sections.values()))).text
    assert f"jump length {smoothed.result.jump.length:.1f} m" in text


def test_numbers_about_noise_are_those_of_the_simulation(sections):
    """Stated noise is the simulated one: innovations are white with unit variance. 269 fixes:
    an RMS scatters by 4 %, a correlation by 0.06; four sigma of that are allowed."""
    rows = table(sections["Innovations"]).rows
    assert [row[:3] for row in rows[:3]] == [("position", n, 269) for n in ("east", "north", "up")]
    for row in rows:
        assert abs(float(row[4]) - 1.0) < 0.18 and abs(float(row[6])) < 0.25, row
        assert 90.0 < float(row[5]) <= 100.0
    for name, rms, stated, _ in table(sections["Before and after"]).rows:
        assert float(stated) == {"east": 3.0, "north": 3.0, "up": 5.0}[name]
        assert float(rms) == pytest.approx(float(stated), rel=0.18)
    for row in table(sections["Errors"]).rows:
        assert 0.3 < float(row[5]) < 9.0, row  # one run: correlated errors, far from 0 and 100
    for _, count, rms, _, sigma, excess in table(sections["Surface"]).rows:
        # The sensor moves as sigma allows: 1.1 is the most of 20 seeds in smoother_surface_fit.
        assert count > 100 and float(rms) < 3 * float(sigma) and 0.1 < float(excess) < 1.2


def test_side_view_and_mesh_lie_on_the_profile(smoothed):
    result, hill = smoothed.result, smoothed.surface
    fixes = smoothed.fixes_world()[1]
    figure = side_figure(hill, result.samples, fixes, result.events)
    in_run, landing, _, line, events = figure.data
    # Upwards in the figure is upwards in the world, forward is downhill.
    assert line.y[0] > 30 > 0 > line.y[-1] and line.x[0] < -70 < 100 < line.x[-1]
    np.testing.assert_allclose(np.interp(events.x, landing.x, landing.y)[1], events.y[1], atol=0.5)
    np.testing.assert_allclose([events.x[0], events.y[0]], 0.0, atol=0.3)
    figure, stretch = space_figure(result.samples, smoothed.time, fixes, hill)
    assert stretch == 1.0
    for mesh, profile in zip(figure.data[:2], (hill.in_run, hill.landing)):
        corners = np.stack([np.array(mesh[c]).ravel() for c in "xyz"], axis=1)
        x, _, z = hill.to_hill(corners).T
        np.testing.assert_allclose(z, profile(x)[0], atol=1e-6)
    # The run-out is on the drawn surface: truth and smoothing agree on that to a hand's breadth.
    end = hill.to_hill(result.samples["position_world"][-1])
    assert end[2] == pytest.approx(float(hill.landing(end[0])[0]), abs=0.2)
    track = map_figure(result.samples, fixes).data[1]
    assert track.x[-1] < 0 < track.y[-1]  # the hill looks to the north-west


def test_fixes_are_compared_at_the_time_and_place_of_the_antenna():
    """East at 10 m/s, nose east; antenna 2 m to the left (north); stamps 100 ms late."""
    samples = np.zeros(101, SAMPLE)
    samples["stamp"] = np.arange(101) * 10_000_000
    samples["position_world"][:, 0] = np.arange(101) * 0.1
    samples["quat_world_imu"] = Rotation.identity().as_quat()
    delay = (np.full((101, 1), 0.1), np.full((101, 1), 0.01))
    result = SimpleNamespace(samples=samples, states={"gnss_time_offset": delay},
                             frame=LocalFrame(47.0, 11.0, 500.0))
    params = SmootherParams(gnss=Gnss(lever_arm=(0.0, 2.0, 0.0)))
    smoothed = Smoothed(result, params, None, None, None, 0)
    np.testing.assert_allclose(smoothed.antenna(np.array([500_000_000])), [[4.0, 2.0, 0.0]],
                               atol=1e-9)
    assert np.isnan(smoothed.antenna(np.array([50_000_000]))).all()  # before the first sample
    result.states = {"gnss_time_offset": delay, "gnss_lever_arm": (
        np.tile([1.0, 0.0, 0.0], (101, 1)), np.zeros((101, 3)))}
    np.testing.assert_allclose(smoothed.antenna(np.array([500_000_000])), [[5.0, 0.0, 0.0]],
                               atol=1e-9)
    # Stamps beyond the 53 bits of a float.
    epoch = 1_700_000_000_000_000_000
    at = interpolate(epoch + np.array([0, 10]), np.array([[0.0], [1.0]]), np.array([epoch + 3]))
    assert at[0, 0] == pytest.approx(0.3, abs=1e-12)


def test_constant_states_are_a_table_and_wandering_ones_a_figure(smoothed):
    n = len(smoothed.result.samples)
    wander = np.linspace(0, 1, n)[:, None] * np.ones(3)
    states = dict(smoothed.result.states, gnss_position_error=(wander, np.ones((n, 3))))
    other = replace(smoothed, result=replace(smoothed.result, states=states))
    (section,) = report._errors(other)
    assert {row[0] for row in table(section).rows} == {"magnetometer bias", "magnetometer scale"}
    (figure,) = [b for b in section.blocks if isinstance(b, Figure)]
    notes = [a.text for a in figure.figure.layout.annotations]
    assert "GNSS position error" in notes and "magnetometer bias" not in notes


def test_a_single_pass_is_not_called_converged(smoothed):
    states = []
    for converged in (True, False, None):
        result = replace(smoothed.result, converged=converged)
        (state,) = [n.note for n in report.smoother_numbers(result) if n.label == "Iterations"]
        states.append((state, "iterations (" in result.summary()))
    assert states == [("converged", True), ("NOT CONVERGED", True), ("single pass", False)]


def test_report_from_the_command_line_is_bounded_and_refusals_are_told(tmp_path):
    out = tmp_path / "r.html"
    result = CliRunner().invoke(cli.cli, ["report", str(BAG), "--params-file", str(PARAMS),
                                          "--out", str(out)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    headings = re.findall(r"<h2>(.*?)</h2>", out.read_text())
    assert {"Trajectory", "Jump", "Orientation", "Error against the reference"} <= set(headings)
    assert out.stat().st_size < 11e6
    params = tmp_path / "p.yaml"
    params.write_text("smoother: {ros__parameters: {sensor.gyro_noise_density: 1.0e-10}}")
    result = CliRunner().invoke(cli.cli, ["report", str(BAG), "--params-file", str(params)])
    assert result.exit_code == 1 and "gyro_noise_density" in result.output


def test_what_cannot_be_smoothed_is_told_in_the_report(tmp_path):
    """A hill needs take-off and touch-down, and these need velocities."""
    with open_bag(BAG) as reader, BagWriter(tmp_path / "bag") as writer:
        for topic, msgtype, stamp, cdr in reader.messages():
            if topic != "/fix_velocity":
                writer.write(topic, msgtype, cdr, stamp)
    write_recording_report(tmp_path / "bag", None, tmp_path / "r.html", PARAMS)
    text = Page((tmp_path / "r.html").read_text()).text
    assert "no smoothed trajectory: take-off and touch-down" in text


@pytest.mark.slow
def test_a_real_browser_draws_every_figure_of_a_jump_offline(tmp_path):
    browser = next((p for p in map(shutil.which, ("chromium", "chromium-browser")) if p), None)
    if browser is None:
        pytest.skip("no Chromium here")
    out = tmp_path / "report.html"
    write_recording_report(BAG, None, out, PARAMS)
    drawn = subprocess.run(
        [browser, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
         "--no-first-run", "--disable-background-networking", "--disable-component-update",
         "--disable-sync", "--host-resolver-rules=MAP * ~NOTFOUND",
         f"--user-data-dir={tmp_path / 'user'}", "--virtual-time-budget=20000", "--dump-dom",
         out.as_uri()], check=True, capture_output=True, text=True, timeout=180).stdout
    figures = Page(out.read_text()).figures
    solid = sum(any(t["type"] == "scatter3d" for t in f["data"]) for f in figures)
    assert solid == 1
    assert len(re.findall(r'<div class="plot[^>]*js-plotly-plot', drawn)) == len(figures)
    # Three dimensions are drawn into a canvas, everything else into axes of SVG.
    assert drawn.count('class="cartesianlayer"') == len(figures)
    assert len(re.findall(r"<canvas", drawn)) == 1
    assert not re.search(r'<div class="[^"]*no-webgl', drawn)
