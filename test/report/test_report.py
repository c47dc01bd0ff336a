"""The HTML report: self-contained, safe against what files contain, complete, bounded."""

import base64
import json
import re
import shutil
import subprocess
import zlib
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.errors import ImuFusionError, TopicError
from imu_fusion.messages.convert import (
    bool_message,
    imu_message,
    mag_message,
    pose_message,
    velocity_message,
)
from imu_fusion.messages.diagnostics import DIAGNOSTICS_TYPE, diagnostics_message
from imu_fusion.messages.layouts import BOOL_TYPE, IMU, ODOMETRY, TWIST
from imu_fusion.messages.orientation_status import FLAGS_TYPE, flags_message
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.report.figures import (
    Band,
    Line,
    Panel,
    Shade,
    break_wraps,
    intervals,
    merged,
    time_figure,
)
from imu_fusion.report.gnss import gnss_section
from imu_fusion.report.html import (
    Figure,
    Notes,
    Number,
    Numbers,
    Section,
    Table,
    Text,
    render_report,
    write_report,
)
from imu_fusion.report.orientation import euler_zyx
from imu_fusion.report.orientation_status import Status
from imu_fusion.report.orientation_status import shades as status_shades
from imu_fusion.report.recording import write_recording_report
from imu_fusion.samples import FixLog, VelocityLog

BAGS = Path(__file__).resolve().parents[2] / "bags"
START = 1_700_000_000_000_000_000
EVIL = "</script><script>alert('x')</script><img src=x onerror=alert(1)>&\"'"


class Page(HTMLParser):
    """What a browser would make of a page: tags outside of scripts, texts of scripts."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.tags, self.links, self.text, self.figures = [], [], "", []
        self._script = None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self._script = dict(attributes).get("type", "js") if tag == "script" else None
        self.links += [v for k, v in attributes if k in ("src", "href", "data", "action")]

    def handle_endtag(self, tag):
        self._script = None

    def handle_data(self, data):
        if self._script is None:
            self.text += data
        elif self._script == "application/json":
            self.figures.append(json.loads(data))


def evil_recording(directory, topic):
    """A small recording with estimates, whose strings try to break out of the page."""
    rng = np.random.default_rng(0)
    with BagWriter(directory) as writer:
        for i in range(400):
            stamp = START + i * 10_000_000
            rotation = Rotation.from_rotvec([0, 0, i * 0.01])
            body = rotation.inv()
            gyr, acc = [0, 0, 1.0] + rng.normal(0, 1e-3, 3), [0, 0, 9.81] + rng.normal(0, .05, 3)
            writer.write("/imu/data_raw", "sensor_msgs/msg/Imu",
                         imu_message(stamp, EVIL, gyr, acc), stamp)
            writer.write("/imu/mag", "sensor_msgs/msg/MagneticField", mag_message(
                stamp, EVIL, body.apply([0, 20e-6, -44e-6]) + rng.normal(0, 1e-7, 3)), stamp)
            writer.write("/imu/data", "sensor_msgs/msg/Imu", imu_message(
                stamp, EVIL, gyr, acc, rotation.as_quat(), np.eye(3) * 1e-4), stamp)
            writer.write(topic, "geometry_msgs/msg/PoseStamped",
                         pose_message(stamp, EVIL, rotation.as_quat()), stamp)
    return directory


def test_strings_of_a_recording_cannot_become_markup(tmp_path):
    topic = f"/reference/{EVIL}"
    out = tmp_path / "report.html"
    bag = tmp_path / "b<i>ag\udcff"    # a name that is no text, either
    write_recording_report(evil_recording(bag, topic), bag, out)
    page = Page(out.read_text())
    assert not [tag for tag, attributes in page.tags if tag in ("img", "i", "iframe")]
    assert not [a for _, attributes in page.tags for a in attributes if a.startswith("on")]
    assert len([t for t, _ in page.tags if t == "script"]) == 2 + len(page.figures)
    assert EVIL in page.text and "b<i>ag" in page.text  # shown as what it is
    # plotly reads tags in names: there they arrive as entities.
    names = [trace.get("name", "") for figure in page.figures for trace in figure["data"]]
    assert any("alert" in name for name in names)
    assert not [name for name in names if "<" in name]


def test_a_report_needs_nothing_from_outside(tmp_path):
    out = tmp_path / "sub" / "report.html"
    write_report(out, "title", [Section("One", (Text("text"), Figure(time_figure([
        Panel("y in m", (Line("a", np.arange(3.0), np.arange(3.0), "#000000"),))])),))])
    page = Page(out.read_text())
    assert [link for link in page.links if not link.startswith("#")] == []
    assert [t for t, _ in page.tags if t in ("link", "iframe", "object")] == []
    (packed,) = re.findall(r'id="plotly">([^<]*)<', out.read_text())
    plotly = zlib.decompress(base64.b64decode(packed))
    assert b"plotly.js" in plotly[:100] and b"scatter3d" in plotly and len(plotly) > 1e6
    assert "Plotly.newPlot" in out.read_text() and out.stat().st_size < 1e6


def test_all_blocks_are_shown_and_columns_of_numbers_set_to_the_right():
    text = render_report("T", [Section("S", (
        Numbers((Number("RMSE", "1.5°", "moving"),)), Notes(("careful",)),
        Table(("name", "value"), (("a", "1.25"), ("b", "–"))),
        Table(("name", "why"), (("a", "x"), ("b", "a sentence that a narrow page would squeeze"))),
        Table(("none",), ())))], "below")
    page = Page(text)
    for word in ("T", "below", "RMSE", "1.5°", "moving", "careful", "1.25"):
        assert word in page.text
    assert text.count('<td class="number">') == 2 and text.count('<th class="number">') == 2
    assert text.count('<td class="prose">') == 2


def test_a_report_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ImuFusionError, match="cannot be written"):
        write_report(tmp_path / "file" / "report.html", "t", [])


def test_the_report_of_a_real_recording_is_complete_and_bounded(tmp_path):
    out = tmp_path / "report.html"
    write_recording_report(BAGS / "px4_plane", None, out)
    page = Page(out.read_text())
    assert "13656" in page.text and "136.55" in page.text and "214 gaps" in page.text
    headings = re.findall(r"<h2>(.*?)</h2>", out.read_text())
    assert headings == [
        "Summary", "The recording", "Trajectory", "Velocity", "Attitude of the trajectory",
        "Sensor errors", "Before and after", "Innovations", "Orientation",
        "Difference from onboard_ekf/pose", "Gyroscope bias", "Magnetic field",
        "Angular rates and specific force", "GNSS"]
    assert out.stat().st_size < 3e6


def test_a_report_makes_nothing_where_estimates_are_given_and_says_what_these_lack(tmp_path):
    out = tmp_path / "report.html"
    write_recording_report(BAGS / "px4_plane", BAGS / "px4_plane", out)
    page = Page(out.read_text())
    assert "px4_plane holds no estimates, but /fix, " in page.text
    assert ("There is no smoothed trajectory: px4_plane holds no trajectory on smoother/odometry"
            in page.text)
    assert re.findall(r"<h2>(.*?)</h2>", out.read_text()) == [
        "Summary", "The recording", "Angular rates and specific force", "GNSS"]


def test_hours_of_data_give_a_page_of_bounded_size():
    n = 2_000_000
    time = np.arange(n) * 0.0035
    lines = tuple(Line(f"s{i}", time, np.sin(time * (i + 1)), "#000000") for i in range(3))
    text = Figure(time_figure([Panel("y", lines)] * 3)).render()
    # 9 lines x 2400 points x 2 x float32 in base64 are 230 kB.
    assert len(text) < 230_000


def test_time_axes_are_one_and_all_panels_are_labelled():
    line = Line("a", np.arange(5.0), np.arange(5.0), "#123456")
    figure = time_figure([Panel("u in V", (line,)), Panel("i in A", (line,))],
                         [Shade("on", ((1.0, 2.0),))])
    assert figure.layout.xaxis.matches is None and figure.layout.xaxis2.matches == "x"
    labels = {a.text for a in figure.layout.annotations}
    assert labels == {"u in V", "i in A"}
    assert "time" in figure.layout.xaxis2.title.text
    # One legend entry per name, however many panels it is in.
    assert [t.name for t in figure.data if t.showlegend is not False] == ["a", "on"]


def test_shaded_spans_stay_few_and_none_is_lost():
    # Ten thousand flickers become one span; a single sample keeps the width of a pixel.
    flicker = [(0.01 * i, 0.01 * i + 0.005) for i in range(10_000)]
    assert merged([*flicker, (900.0, 900.0)], 1.0) == [(0.0, pytest.approx(100.99)), (900.0, 901.0)]
    line = Line("a", np.arange(1000.0), np.arange(1000.0), "#123456")
    shades = [Shade("one", tuple(flicker)), Shade("two", ((1.0, 2.0), (500.0, 600.0))),
              Shade("none", ())]
    figure = time_figure([Panel("u", (line,))] * 3, shades)
    assert len(figure.layout.shapes) == 3
    assert [t.name for t in figure.data if t.showlegend is not False] == ["a", "one", "two"]


def test_spans_of_flags_hold_until_the_next_change():
    stamp = np.array([0, 1, 3, 4], dtype=np.int64) * 1_000_000_000
    status = Status(stamp, np.array([1, 4, 4 | 8, 0]), stamp[:0], np.empty((0, 3)),
                    np.empty((0, 3)))
    found = {s.name: s.spans for s in status_shades(status, 0, 9_000_000_000)}
    assert found == {"at rest": ((0.0, 1.0),), "magnetic disturbance": ((1.0, 3.0), (3.0, 4.0)),
                     "sensor at its limit": ((3.0, 4.0),)}


def test_a_band_breaks_where_it_wraps_or_is_not_determined():
    time = np.arange(8.0)
    angle = np.array([170, 175, 179, -178, -174, -170, -166, -162.0])
    sd = np.array([1, 1, 1, 1, 1, 300, 1, 1.0])
    figure = time_figure([Panel("yaw", (
        Band("b", time, angle - sd, angle + sd, widest=180.0),))])
    y = np.asarray(figure.data[0].y)
    # Two outlines, of 3 and 4 samples: before the wrap, and after it without the wide one.
    assert np.isnan(y).sum() == 2
    assert np.nanmax(np.abs(y)) == 180
    outlines = np.split(y, np.flatnonzero(np.isnan(y)) + 1)
    assert all(len(np.unique(np.sign(o[np.isfinite(o)]))) == 1 for o in outlines if len(o) > 1)


def test_euler_angles_and_their_standard_deviations():
    """Hand-worked: yaw 90 deg from east looks north; sd against a numerical derivative."""
    quat = Rotation.from_euler("ZYX", [90, 20, -10], degrees=True).as_quat()[None]
    angles, _ = euler_zyx(quat)
    np.testing.assert_allclose(np.degrees(angles), [[-10, 20, 90]], atol=1e-12)
    rng = np.random.default_rng(1)
    rotation = Rotation.from_euler("ZYX", rng.uniform(-1.2, 1.2, (20, 3)))
    square = rng.normal(size=(20, 3, 3))
    cov = square @ square.transpose(0, 2, 1) * 1e-6
    _, sd = euler_zyx(rotation.as_quat(), cov)
    step = 1e-6
    jacobian = np.stack([
        (euler_zyx((rotation * Rotation.from_rotvec(step * axis)).as_quat())[0]
         - euler_zyx((rotation * Rotation.from_rotvec(-step * axis)).as_quat())[0]) / (2 * step)
        for axis in np.eye(3)], axis=2)
    expected = np.sqrt(np.einsum("nij,njk,nik->ni", jacobian, cov, jacobian))
    np.testing.assert_allclose(sd, expected, rtol=1e-6)
    assert np.isnan(euler_zyx(quat, np.zeros((1, 3, 3)))[1]).all()


def test_stretches_and_wraps():
    mask = np.array([True, True, False, True])
    assert intervals(np.arange(4.0), mask) == [(0.0, 2.0), (3.0, 3.0)]
    assert intervals(np.arange(2.0), np.zeros(2, bool)) == []
    np.testing.assert_array_equal(np.isnan(break_wraps([170, 179, -179, -170])),
                                  [False, False, True, False])


def test_damaged_samples_are_left_out_and_told(tmp_path):
    """Zero quaternions, NaN, repeated and backward stamps do not stop a report."""
    rng = np.random.default_rng(0)
    with BagWriter(tmp_path / "bag") as writer:
        for i in range(300):
            stamp = START + (i if i != 50 else 49) * 10_000_000
            quat = [0, 0, 0, 0] if i == 10 else [0, 0, 0, 1]
            acc = [np.nan if i == 20 else 0.0, 0.0, 9.81] + rng.normal(0, 0.05, 3)
            writer.write("/imu/data_raw", "sensor_msgs/msg/Imu",
                         imu_message(stamp, "i", [0, 0, 0], acc), START + i * 10_000_000)
            writer.write("/imu/data", "sensor_msgs/msg/Imu",
                         imu_message(stamp, "i", [0, 0, 0], acc, quat, np.eye(3) * 1e-4),
                         START + i * 10_000_000)
            writer.write("/reference/pose", "geometry_msgs/msg/PoseStamped",
                         pose_message(stamp, "world", quat), START + i * 10_000_000)
    out = tmp_path / "report.html"
    write_recording_report(tmp_path / "bag", tmp_path / "bag", out)
    text = Page(out.read_text()).text
    assert "reference/pose: 1 orientations are zero" in text
    assert "1 samples left out: repeated stamp" in text
    assert "not finite" in text


def test_broken_messages_of_estimates_are_left_out_and_told(tmp_path):
    """One of each kind in eighty; and results of a smoother that it never wrote."""
    with BagWriter(tmp_path / "bag") as writer:
        for i in range(80):
            stamp = START + i * 10_000_000
            forces = [0.0, 0.1, 9.81]
            made = {"/imu/data_raw": (IMU.msgtype, imu_message(stamp, "i", np.zeros(3), forces)),
                    "/imu/data": (IMU.msgtype, imu_message(stamp, "i", np.zeros(3), forces,
                                                           [0, 0, 0, 1], np.eye(3) * 1e-4)),
                    "/imu/flags": (FLAGS_TYPE, flags_message(stamp, "i", 1)),
                    "/imu/gyro_bias": (TWIST.msgtype, velocity_message(stamp, "i", np.zeros(3))),
                    "/reference/moving": (BOOL_TYPE, bool_message(i > 40)),
                    "/smoother/odometry": (ODOMETRY.msgtype, ODOMETRY.encode(
                        stamp, "world", np.zeros(ODOMETRY.size), "i")),
                    "/smoother/imu": (IMU.msgtype, imu_message(stamp, "i", np.zeros(3), forces)),
                    "/smoother/results": (DIAGNOSTICS_TYPE, diagnostics_message(
                        stamp, "", "smoother", "", {"origin": "[1]", "states": "3"}))}
            for topic, (msgtype, cdr) in made.items():
                writer.write(topic, msgtype, cdr[:4] if i == 30 else cdr, stamp)
    out = tmp_path / "report.html"
    written = write_recording_report(tmp_path / "bag", tmp_path / "bag", out)
    text = Page(out.read_text()).text
    assert not written.complete and written.smoothed is None
    for topic in ("imu/data", "imu/flags", "imu/gyro_bias"):
        assert f"/{topic}: 1 messages cannot be decoded" in text, topic
    assert "holds a trajectory that cannot be read" in text


def test_a_recording_without_messages_is_told(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/imu/data_raw", "sensor_msgs/msg/Imu")
    with pytest.raises(TopicError, match="no messages"):
        write_recording_report(tmp_path / "bag", tmp_path / "bag", tmp_path / "r.html")


def test_gnss_track_has_the_true_extent():
    """0.001 deg of latitude are 111.19 m on a meridian near 47 deg (WGS84: 111.18 m)."""
    n = 11
    fix = FixLog(np.arange(n) * 10 ** 9, 47 + np.linspace(0, 1e-3, n), np.full(n, 8.0),
                 np.linspace(400, 410, n), np.tile(np.eye(3) * 4.0, (n, 1, 1)),
                 np.r_[np.zeros(n - 1), -1])
    velocity = VelocityLog(fix.stamp, np.tile([3.0, 4.0, 1.0], (n, 1)), np.zeros((n, 3, 3)))
    section = gnss_section(fix, velocity, 0)
    cells = {row[0]: row[1] for row in section.blocks[0].rows}
    # The last one has no fix: nine tenths of the way.
    assert float(cells["extent north"]) == pytest.approx(0.9 * 111.18, abs=0.1)
    assert float(cells["extent east"]) == 0.0
    assert float(cells["greatest horizontal speed"]) == 5.0
    assert "2.000 / 2.000 / 2.000" in cells["median stated σ east, north, up"]
    assert "No message" in gnss_section(fix[-1:], None, 0).blocks[0].text


@pytest.mark.slow
def test_a_real_browser_draws_every_figure_offline(tmp_path):
    browser = next((p for p in map(shutil.which, ("chromium", "chromium-browser")) if p), None)
    if browser is None:
        pytest.skip("no Chromium here")
    out = tmp_path / "report.html"
    write_recording_report(BAGS / "px4_plane", None, out)
    drawn = subprocess.run(
        [browser, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
         "--disable-background-networking", "--disable-component-update", "--disable-sync",
         "--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={tmp_path / 'user'}",
         "--virtual-time-budget=20000", "--dump-dom", out.as_uri()],
        check=True, capture_output=True, text=True, timeout=120).stdout
    figures = len(Page(out.read_text()).figures)
    assert figures == 16
    # plotly marks every element that it has drawn into, and puts one layer of axes there.
    assert len(re.findall(r'<div class="plot[^>]*js-plotly-plot', drawn)) == figures
    assert drawn.count('class="cartesianlayer"') == figures
