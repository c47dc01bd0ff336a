"""The field in the report: magnitudes, residuals and clipping of a motion known exactly."""

import re
import shutil

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from imu_fusion.messages.convert import imu_message
from imu_fusion.messages.layouts import ACCEL, IMU
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.results import write_results
from imu_fusion.report.acceleration_field import field_picture, field_sections
from imu_fusion.report.field_data import read_field
from imu_fusion.report.html import Notes
from imu_fusion.report.recording import write_recording_report
from imu_fusion.streams.acceleration_field import ACCEL_TOPIC, IMU_TOPIC
from test.report.test_report import EVIL, START, Page

G = 9.80665
RATE = 1000
PLACES = {"a": (0.1, 0.0, 0.0), "b": (0.0, 0.1, 0.0), "c": (0.0, 0.0, 0.1), "d": (0.0, 0.0, 0.0)}
# Rows are the axes of sensor b in the body: y, z, x.
AXES_B = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
BIAS_B = np.array([0.3, 0.0, -0.2])
POINT = (0.2, 0.0, 0.05)
ALPHA = 40.0   # rad/s^2 about z: the rate grows through the limit of the gyroscope
LIMIT = 12.0
PULSE = 100 * G


def pulse(t):
    """Half a sine of 10 ms along x."""
    return PULSE * np.sin(np.pi * (t - 0.3) / 0.01) if 0.3 <= t <= 0.31 else 0.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A body that is turned about the vertical ever faster, and pushed once."""
    folder = tmp_path_factory.mktemp("field")
    with BagWriter(folder / "bag") as writer:
        for i in range(600):
            t = i / RATE
            stamp = START + i * 1_000_000
            omega, turn = ALPHA * t, Rotation.from_rotvec([0, 0, 0.5 * ALPHA * t * t])
            body = np.array([pulse(t), 0.0, 0.0])

            def field(place):
                x, y, _ = place
                return body + [-omega ** 2 * x - ALPHA * y, -omega ** 2 * y + ALPHA * x, 0.0]

            for name, place in PLACES.items():
                force = field(place) + [0, 0, G]
                reading = AXES_B @ force + BIAS_B if name == "b" else force
                writer.write(f"/accelerometers/{name}", IMU.msgtype,
                             imu_message(stamp, EVIL, None, reading), stamp)
            writer.write("/imu/data_raw", IMU.msgtype,
                         imu_message(stamp, EVIL, (0, 0, omega), None), stamp)
            writer.write("/" + IMU_TOPIC, IMU.msgtype, imu_message(
                stamp, "body", (0, 0, omega + 0.01), body + [0, 0, G], turn.as_quat(),
                1e-6 * np.eye(3), 1e-4 * np.eye(3), 1e-2 * np.eye(3)), stamp)
            cov = np.diag([1e-2] * 3 + [1.0] * 3)
            writer.write("/" + ACCEL_TOPIC, ACCEL.msgtype, ACCEL.encode(
                stamp, "body", np.concatenate([body, [0, 0, ALPHA], cov.ravel()])), stamp)
    sensors = {name: {"position": list(map(float, place)), "range": [1000.0]}
               for name, place in PLACES.items()}
    sensors["b"]["axes"] = AXES_B.ravel().tolist()
    parameters = {"accelerometers": {"names": list(PLACES), **sensors},
                  "use_gyro": True, "sensor": {"gyro_range": [LIMIT]}, "points": list(POINT),
                   "sample_rate": 1000.0}
    (folder / "p.yaml").write_text(yaml.safe_dump(
        {"acceleration_field_estimator": {"ros__parameters": parameters}}))
    return folder / "bag", folder / "p.yaml"


@pytest.fixture(scope="module")
def data(recording):
    bag, params = recording
    return read_field(bag, bag, params)


def test_field_at_the_query_point_is_that_of_the_motion(data):
    omega = ALPHA * np.arange(600) / RATE + 0.01  # as estimated
    force, kinematic = data.field(data.points)
    assert data.points == pytest.approx(np.array([POINT]))
    quiet = np.r_[0:300, 311:600]
    x = POINT[0]
    expected = np.column_stack([-omega ** 2 * x, np.full(600, ALPHA * x), np.zeros(600)])
    # The rotation about the vertical leaves gravity where it is.
    assert kinematic[quiet, 0] == pytest.approx(expected[quiet], abs=1e-9)
    assert force[quiet, 0] - kinematic[quiet, 0] == pytest.approx(
        np.tile([0, 0, G], (len(quiet), 1)), abs=1e-9)
    assert kinematic[305, 0] - expected[305] == pytest.approx([PULSE, 0, 0], abs=1e-6)


def test_residuals_are_the_biases_in_the_axes_of_the_sensor(data):
    slow = slice(0, 20)  # where the estimate's 0.01 rad/s make no difference: 2 omega dw r
    assert data.residuals("b")[slow] == pytest.approx(np.tile(BIAS_B, (20, 1)), abs=2e-3)
    assert data.residuals("a")[slow] == pytest.approx(np.zeros((20, 3)), abs=2e-3)


def test_clipping_is_told_per_axis_from_the_recorded_rate(data):
    assert not data.clipped[:, :2].any()
    assert data.clipped[:, 2].tolist() == [ALPHA * i / RATE >= LIMIT for i in range(600)]


def test_what_makes_the_field_doubtful_stands_above_it(data, recording, tmp_path):
    assert not any(isinstance(b, Notes) for b in field_sections(data, START)[0].blocks)
    bag, params = recording
    shutil.copytree(bag, tmp_path / "bag")
    text = "accelerometer 'b' contradicts the others"
    write_results(tmp_path / "bag", {"acceleration_field_estimator": {"remarks": [text]}})
    noted = read_field(bag, tmp_path / "bag", params)
    assert field_sections(noted, START)[0].blocks[0] == Notes((text,))


def test_the_event_has_its_metrics_in_the_table(data, recording):
    sections = {s.title: s for s in field_sections(data, START)}
    assert list(sections) == ["Acceleration field", "Angular velocity and acceleration",
                              "Residuals", "Impacts"]
    table = sections["Impacts"].blocks[0]
    rows = {row[0]: row[1:] for row in table.rows}
    # 100 g along x; at the query point the rotation adds less than 3.5 g.
    assert float(rows["peak linear acceleration"][1]) == pytest.approx(100, abs=3.5)
    assert rows["peak linear acceleration"][0] == "g"
    # HIC by its definition (the best window, by symmetry about the peak), on the exact signal: the
    # pulse less the centripetal part. Sampled at 1 ms the window cannot be met exactly: 5 %.
    half = np.linspace(1e-5, 0.005, 500)
    mean = 100 * np.sin(np.pi * half / 0.01) / (np.pi * half / 0.01) - 12.2 ** 2 * POINT[0] / G
    assert float(rows["HIC15"][1]) == pytest.approx(np.max(2 * half * mean ** 2.5), rel=0.05)
    # |f_x| reaches 1000 m/s^2 by the rotation and 980 of the pulse at a: none is saturated.
    assert rows["samples with saturation"][1] == "0"


def test_rates_are_judged_where_the_gyroscope_was_not_used(data):
    (section,) = [s for s in field_sections(data, START) if s.title.startswith("Angular vel")]
    rows = {row[0]: row for row in section.blocks[0].rows}
    at_limit = rows["gyroscope at its limit"]
    assert float(at_limit[1]) == pytest.approx(0.01, abs=1e-3)  # the error put in
    assert int(at_limit[6]) == 300


def test_picture_has_one_arrow_per_place_and_its_slider_shows_one_instant(data):
    time = np.arange(600) / RATE
    magnitude = np.linalg.norm(data.field(data.points)[1][:, 0], axis=1)
    figure = field_picture(data, time, magnitude)
    assert len(figure.data[0].x) == len(PLACES) + 1
    (slider,) = figure.layout.sliders
    assert len(slider.steps) == 41 and len(figure.data) == 1 + 2 * 41
    for k, step in enumerate(slider.steps):
        assert [i for i, seen in enumerate(step.args[1]) if seen] == [0, 1 + 2 * k, 2 + 2 * k]
    shown = [i for i, trace in enumerate(figure.data) if trace.visible is not False]
    assert shown == [0, 1 + 2 * slider.active, 2 + 2 * slider.active]
    assert float(slider.steps[slider.active].label) == pytest.approx(0.305, abs=0.006)
    # Arrows point along x at the height of the pulse.
    arrows = figure.data[1 + 2 * slider.active]
    shaft = np.array([[arrows[a][1] - arrows[a][0] for a in "xyz"]])
    assert shaft[0, 0] > 10 * np.abs(shaft[0, 1:]).max()


def test_the_page_holds_the_sections_and_no_markup_from_outside(recording, tmp_path):
    bag, params = recording
    write_recording_report(bag, bag, tmp_path / "r.html", params)
    page = Page((tmp_path / "r.html").read_text())
    for title in ("Acceleration field", "Residuals", "Impacts"):
        assert title in page.text
    assert not [tag for tag, _ in page.tags if tag in ("img", "i")]
    assert not re.search("angular velocity are not finite", page.text)
    # Without a parameter file nothing is known of the accelerometers, and the rest stands.
    write_recording_report(bag, bag, tmp_path / "r.html")
    page = Page((tmp_path / "r.html").read_text())
    assert "Acceleration field" in page.text and "Residuals" not in page.text
