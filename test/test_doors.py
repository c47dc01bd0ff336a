"""The same options at every door, and results that one can take away."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from imu_fusion import batch, cli
from imu_fusion.messages.convert import imu_message, mag_message
from imu_fusion.messages.layouts import IMU, MAG
from imu_fusion.nodes.base import message_class
from imu_fusion.nodes.pipeline import plan_pipeline
from imu_fusion.nodes.replayer import ReplayerParams
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.inspect import inspect_topics
from imu_fusion.recordings.logs import read_log
from imu_fusion.report.contents import smoothed_of
from imu_fusion.report.recording import write_recording_report
from imu_fusion.report.trajectory_data import read_result
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate
from imu_fusion.streams.acceleration_field import AccelerationFieldStream, read_configuration
from imu_fusion.streams.orientation import OrientationStream
from imu_fusion.streams.registry import STAGES
from test.nodes.test_smoother import write as write_drive
from test.report.test_report import Page
from test.test_cli import write

ROOT = Path(__file__).resolve().parents[1]


def call(*arguments, code=0):
    result = CliRunner().invoke(cli.cli, list(map(str, arguments)), catch_exceptions=False)
    assert result.exit_code == code, result.output
    return result.output


@pytest.fixture
def renamed(tmp_path):
    """A drive as a robot records it: its Imu with somebody's orientation on imu/data, its fixes on
    gps/fix."""
    with open_bag(write_drive(tmp_path / "plain", 400)) as reader, \
            BagWriter(tmp_path / "robot") as writer:
        for topic, msgtype, log_time, cdr in reader.messages():
            name = {"/fix": "/gps/fix", "/imu/data_raw": "/imu/data"}.get(topic, topic)
            writer.write(name, msgtype, cdr, log_time)
    return tmp_path / "robot"


REMAP = {"/imu/data_raw": "/imu/data", "/fix": "/gps/fix"}
OPTIONS = [word for name, other in REMAP.items() for word in ("--remap", f"{name}:={other}")]


def test_a_recording_reads_the_same_under_other_names(renamed, tmp_path):
    with open_bag(tmp_path / "plain") as plain, open_bag(renamed, remap=REMAP) as reader:
        assert set(reader.topics) == set(plain.topics) and not reader.warnings
        assert {name: info.count for name, info in reader.topics.items()} == {
            name: info.count for name, info in plain.topics.items()}
        assert [(t, n, bytes(c)) for t, _, n, c in reader.messages()] == [
            (t, n, bytes(c)) for t, _, n, c in plain.messages()]
        np.testing.assert_array_equal(read_log(reader, "fix").latitude_deg,
                                      read_log(plain, "fix").latitude_deg)


def test_what_has_the_new_name_already_is_left_out_and_said(tmp_path):
    bag = tmp_path / "bag"
    with BagWriter(bag) as writer:
        for topic, stamp in (("/imu/data_raw", 1), ("/imu/better", 2)):
            writer.write(topic, IMU.msgtype, IMU.encode(stamp, "i", np.zeros(IMU.size)), stamp)
    with open_bag(bag, remap={"/imu/data_raw": "/imu/better"}) as reader:
        assert [stamp for _, _, stamp, _ in reader.messages()] == [2]
        assert "/imu/data_raw of the recording is left out" in reader.warnings[0]


def test_process_report_and_convert_take_one_remap(renamed, tmp_path):
    plain, other = tmp_path / "of_plain", tmp_path / "of_robot"
    call("process", tmp_path / "plain", plain)
    call("process", renamed, other, *OPTIONS, "--report")
    assert (json.loads((plain / "results.json").read_text())["smoother"]
            == json.loads((other / "results.json").read_text())["smoother"])
    headings = [h.split("<")[0] for h in (other / "report.html").read_text().split("<h2>")[1:]]
    assert "Trajectory" in headings and "GNSS" in headings and "Orientation" in headings
    call("convert", renamed, tmp_path / "converted", *OPTIONS)
    with open_bag(tmp_path / "converted") as reader:
        assert {"/imu/data_raw", "/fix"} <= set(reader.topics)
    for command in ("process", "report", "convert"):
        out = ["--out", tmp_path / "x.html"] if command == "report" else [tmp_path / "x"]
        words = call(command, renamed, *out, "--remap", "fix:=/gps", code=1)
        assert "no topic '/gps'; it has: " in words and "/gps/fix" in words


def test_a_pipeline_plays_what_is_renamed_though_an_estimate_has_its_name(renamed):
    plan = plan_pipeline(renamed, without=["orientation_estimator"], remap=REMAP)
    assert plan.outdated == () and plan.renamed == REMAP
    parameters = ReplayerParams.from_mapping(
        {k: v for k, v in plan.replay_parameters(renamed).items() if v != ()})
    assert set(parameters.remap) == {"/imu/data:=/imu/data_raw", "/gps/fix:=/fix"}


def test_play_hands_its_remap_to_the_replayer(monkeypatch):
    given = []
    monkeypatch.setattr("imu_fusion.nodes.main", lambda words, node: given.extend(words) or 0)
    call("play", "bag", *OPTIONS)
    assert "remap:=['/imu/data:=/imu/data_raw', '/gps/fix:=/fix']" in given


def test_a_report_shows_the_trajectory_that_it_is_given(tmp_path):
    """Read back from the messages, it is the one that was smoothed."""
    bag = write_drive(tmp_path / "bag", 400)
    (report,) = [r for r in batch.process(bag, tmp_path / "out")[0] if r.node == "smoother"]
    whole, _ = smoothed_of(report, 0)
    with open_bag(tmp_path / "out") as reader:
        found, remarks, why = read_result(reader)
    assert not why and remarks == report.remarks
    for name in ("position_world", "vel_world", "quat_world_imu", "gyr", "acc", "acc_sd",
                 "cov_position", "cov_attitude", "cov_velocity", "gyr_sd"):
        np.testing.assert_allclose(found.samples[name], whole.result.samples[name], rtol=1e-6,
                                   atol=1e-9)
    assert found.frame == whole.result.frame and found.summary() == whole.result.summary()
    smoothed = write_recording_report(bag, tmp_path / "out", tmp_path / "r.html").smoothed
    np.testing.assert_array_equal(smoothed.result.samples["position_world"],
                                  found.samples["position_world"])


def test_a_report_without_a_trajectory_says_why(tmp_path):
    bag = write(tmp_path / "bag")
    out = tmp_path / "r.html"
    call("report", bag, "--out", out)
    assert "There is no smoothed trajectory: no messages on 'fix'" in Page(out.read_text()).text
    call("report", bag, "--out", out)    # over the last one
    call("process", bag, tmp_path / "out", "--report")
    call("report", bag, "--estimates", tmp_path / "out", "--out", tmp_path / "out" / "report.html")


def test_what_fails_leaves_nothing_behind(tmp_path):
    bag = write(tmp_path / "bag")
    with BagWriter(tmp_path / "nothing") as writer:
        writer.add_topic("/text", "std_msgs/msg/String")
    before = sorted(tmp_path.rglob("*"))
    for arguments in (["process", bag, tmp_path / "a" / "b" / "out", "--without", "smoother",
                       "--without", "orientation_estimator"],
                      ["process", tmp_path / "nothing", tmp_path / "a" / "out"],
                      ["convert", tmp_path / "bag" / "metadata.yaml", tmp_path / "a" / "out"],
                      ["convert", bag, tmp_path / "a" / "out", "--topic", "/none"],
                      ["export", tmp_path / "nothing", tmp_path / "a" / "tables"]):
        call(*arguments, code=1)
        assert sorted(tmp_path.rglob("*")) == before, arguments


def test_several_recordings_in_one_call_and_a_table_of_what_was_found(tmp_path):
    first, second = (write_drive(tmp_path / name, 300) for name in ("first", "second"))
    (tmp_path / "broken.mcap").write_bytes(b"nothing")
    said = call("process", first, tmp_path / "broken.mcap", second, tmp_path / "monday",
                "--without", "orientation_estimator", code=1)
    assert "failed: " in said
    with open(tmp_path / "monday" / "summary.csv") as stream:
        rows = {row["recording"]: row for row in csv.DictReader(stream)}
    assert list(rows) == ["first", "broken", "second"] and rows["broken"]["smoother.samples"] == ""
    found = json.loads((tmp_path / "monday" / "second" / "results.json").read_text())["smoother"]
    assert float(rows["second"]["smoother.cost"]) == found["cost"]
    assert float(rows["first"]["smoother.origin.latitude_deg"]) == found["origin"]["latitude_deg"]
    assert found["units"]["height"] == "m" and set(found["states"]) <= set(found["units"])
    assert not any("units" in name for name in rows["first"])
    said = call("process", first, first, tmp_path / "tuesday", code=1)
    assert "called first, as" in said and not (tmp_path / "tuesday").exists()


def test_export_writes_the_forms_that_are_asked_for(tmp_path):
    bag = write_drive(tmp_path / "bag", 30)
    call("export", bag, tmp_path / "tracks", "--gpx")
    assert [f.name for f in (tmp_path / "tracks").iterdir()] == ["fix.gpx"]
    call("export", bag, tmp_path / "both", "--csv", "--gpx", "--topic", "fix")
    assert sorted(f.name for f in (tmp_path / "both").iterdir()) == ["fix.csv", "fix.gpx"]
    assert "of the form tum" in call("export", bag, tmp_path / "none", "--tum", code=1)


# What the panel draws, as its source says (ThreeDeeRender/ros.ts of Foxglove Studio).
IN_SPACE = {"nav_msgs/msg/Path", "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/PointCloud2",
            "geometry_msgs/msg/PoseWithCovarianceStamped"}


# Keys of panels, as those of Foxglove Studio's open successor say (Lichtblick, PlotConfig,
# RendererConfig and the map's Config); what they do not know they ignore without a word.
PANEL_KEYS = {
    "3D": {"followMode", "followTf", "cameraState", "scene", "topics", "transforms"},
    "map": {"layer", "followTopic", "disabledTopics", "topicColors", "center", "zoomLevel"},
    "Plot": {"foxglovePanelTitle", "paths", "showLegend", "isSynced", "xAxisVal", "minYValue",
             "maxYValue", "yAxisLabel"}}


def test_the_layout_for_foxglove_says_nothing_that_its_panels_ignore():
    panels = json.loads((ROOT / "config" / "foxglove.json").read_text())["configById"]
    for name, panel in panels.items():
        assert panel.keys() <= PANEL_KEYS[name.partition("!")[0]], name
        for path in panel.get("paths", ()):
            assert path.keys() <= {"value", "enabled", "timestampMethod", "label", "color"}, path
            assert path["timestampMethod"] in ("headerStamp", "receiveTime")
    assert panels["3D!space"]["followMode"] in ("follow-pose", "follow-position", "follow-none")
    assert any(topic["visible"] for topic in panels["3D!space"]["topics"].values())
    assert panels["map!places"]["layer"] in ("map", "satellite", "custom")


def test_the_layout_for_foxglove_plots_fields_that_its_messages_have():
    panels = json.loads((ROOT / "config" / "foxglove.json").read_text())["configById"]
    types = {f"/{topic}": msgtype for stage in STAGES.values()
             for topic, msgtype in stage.outputs.items()}
    types["/reference/pose"] = "geometry_msgs/msg/PoseStamped"
    assert {name.partition("!")[0] for name in panels} == {"3D", "map", "Plot"}
    for name, panel in panels.items():
        for topic in panel.get("topics", {}):
            assert types[topic] in IN_SPACE, f"{name} cannot draw {topic}"
        for path in panel.get("paths", ()):
            assert path["enabled"] and path["timestampMethod"] == "headerStamp", path
            topic, *fields = path["value"].split(".")
            value = message_class(types[topic])()
            assert value.header.stamp is not None
            for field in fields:
                value = getattr(value, field)
            assert isinstance(value, float), path
    # The map takes every NavSatFix that is there.
    assert "sensor_msgs/msg/NavSatFix" in types.values()


def test_the_layout_for_foxglove_shows_topics_that_there_are():
    layout = json.loads((ROOT / "config" / "foxglove.json").read_text())
    text = json.dumps(layout["configById"])
    from test.documents import topics
    shown = {part.strip('"') for part in text.replace(".", '"').split('"')
             if part.startswith("/")}
    assert shown and all(name.strip("/") in topics() for name in shown), shown

    def leaves(node):
        return {node} if isinstance(node, str) else leaves(node["first"]) | leaves(node["second"])

    assert leaves(layout["layout"]) == set(layout["configById"])


AK8963 = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# What is done to rates, forces and fields (n, 3), what is said of it, and whether that is the end.
DAMAGES = {
    "nothing": (lambda gyr, acc, mag: (gyr, acc, mag), (), False),
    "other units": (lambda gyr, acc, mag: (np.degrees(gyr), acc / 9.81, 1e6 * mag),
                    ("angular velocity in deg/s", "gravity in g", "Earth's in microtesla"), True),
    "other axes": (lambda gyr, acc, mag: (gyr, acc, mag @ AK8963.T), ("(y, x, -z)",), True),
    "no gyroscope": (lambda gyr, acc, mag: (0.0 * gyr, acc, mag), ("exactly zero",), True)}


@pytest.mark.parametrize("name", DAMAGES)
def test_what_is_wrong_with_samples_is_said_at_every_door(name, tmp_path):
    """By info, process and the report in the same words, and by a node once it has seen enough."""
    spoil, words, ends = DAMAGES[name]
    imu, mag, _, _ = simulate(Tumbling(seed=3, quat_start=(0.0, 0.0, 0.0, 1.0)), 51.0, rate=100.0,
                              sensors=Sensors(gyr_density=2e-4, acc_density=2e-3, mag_sd=3e-7))
    rates, forces, fields = spoil(imu.gyr, imu.acc, mag.mag)
    sent = {"imu/data_raw": [imu_message(stamp, "imu", gyr, acc)
                             for stamp, gyr, acc in zip(imu.stamp.tolist(), rates, forces)],
            "imu/mag": [mag_message(stamp, "imu", field)
                        for stamp, field in zip(mag.stamp.tolist(), fields)]}
    with BagWriter(tmp_path / "bag") as writer:
        for (topic, cdrs), layout, log in zip(sent.items(), (IMU, MAG), (imu, mag)):
            for stamp, cdr in zip(log.stamp.tolist(), cdrs):
                writer.write(f"/{topic}", layout.msgtype, cdr, stamp)
    with open_bag(tmp_path / "bag") as reader:
        by_info = {f.text.lstrip("/") for t in inspect_topics(reader) for f in t.findings}
    call("process", tmp_path / "bag", tmp_path / "out", code=int(ends))
    assert (tmp_path / "out").exists() is not ends
    call("process", tmp_path / "bag", tmp_path / "forced", "--force", "--report")
    by_process = json.loads((tmp_path / "forced" / "results.json").read_text()).get("findings", [])
    page = Page((tmp_path / "forced" / "report.html").read_text()).text
    stream = OrientationStream()
    stream.take(sent)
    for found in (by_info, by_process, stream.findings):
        assert all(any(word in text for text in found) for word in words), found
        assert words or not found
    assert by_info == set(by_process) and all(text in page for text in by_process)


def test_accelerometers_in_g_are_told_at_every_door(tmp_path):
    """Of an array whose axes point anywhere; that one of them hangs upside down is no remark."""
    preset = ROOT / "config" / "head_four_accelerometers.yaml"
    config = read_configuration(preset)
    random = np.random.default_rng(0)
    sent = {f"accelerometers/{name}": [
        imu_message(5_000_000 * n, name, None,
                    np.reshape(own.axes, (3, 3)) @ [0.0, 0.0, 1.0] + random.normal(0.0, 1e-3, 3))
        for n in range(600)] for name, own in config.accelerometers.items()}
    with BagWriter(tmp_path / "bag") as writer:
        for topic, cdrs in sent.items():
            for n, cdr in enumerate(cdrs):
                writer.write(f"/{topic}", IMU.msgtype, cdr, 5_000_000 * n)
    with open_bag(tmp_path / "bag") as reader:
        by_info = {f.text.lstrip("/") for t in inspect_topics(reader) for f in t.findings}
    call("process", tmp_path / "bag", tmp_path / "out", "--params-file", preset)
    by_process = json.loads((tmp_path / "out" / "results.json").read_text())["findings"]
    stream = AccelerationFieldStream(config)
    stream.take(sent)
    for found in (by_info, by_process, stream.findings):
        assert len(found) == 4 and all("which is gravity in g" in text for text in found)
    assert by_info == set(by_process)
