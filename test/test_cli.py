"""The command line as a person meets it: exit codes, one-line errors, files made."""

import re

import pytest
from click.testing import CliRunner
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from imu_fusion import cli
from imu_fusion.messages.convert import imu_message, mag_message
from imu_fusion.messages.layouts import IMU, MAG
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter

START = 1_700_000_000_000_000_000
STEP = 10_000_000


def write(directory, imu_topic="/imu/data_raw", mag_unit=1.0, acc_unit=1.0, spoil=lambda i: {}):
    """A still sensor for six seconds; ``spoil(i)`` changes what is written as sample i."""
    with BagWriter(directory) as writer:
        for i in range(600):
            sample = {"stamp": START + i * STEP, "gyr": [0.0, 0.0, 0.0]} | spoil(i)
            log_time = START + i * STEP
            writer.write(imu_topic, IMU.msgtype,
                         imu_message(sample["stamp"], "imu_link", sample["gyr"],
                                     [0.0, 0.0, 9.81 * acc_unit]), log_time)
            writer.write("/imu/mag", MAG.msgtype,
                         mag_message(START + i * STEP, "imu_link",
                                     [0.0, 2e-5 * mag_unit, -4e-5 * mag_unit]), log_time)
    return str(directory)


def call(*arguments):
    result = CliRunner().invoke(cli.cli, list(arguments), catch_exceptions=False)
    assert "Traceback" not in result.output
    return result


def test_help_names_every_command_and_what_it_does():
    output = call("--help").output
    for command in ("run", "process", "play", "record", "info", "convert", "report", "demo",
                    "pipeline"):
        assert re.search(rf"^  {command} +\w", output, re.MULTILINE)


def test_process_writes_a_recording_that_others_can_read(tmp_path):
    bag = write(tmp_path / "bag")
    result = call("process", bag, str(tmp_path / "out"))
    assert result.exit_code == 0, result.output
    with open_bag(tmp_path / "out") as reader:
        assert reader.topics["/imu/data"].count == 600
        # level, x axis to the (magnetic) east: the identity
        values = IMU.decode(next(reader.messages(["/imu/data"]))[3])[2]
    assert values[IMU["orientation"]] == pytest.approx([0, 0, 0, 1], abs=1e-9)


@pytest.mark.parametrize("arguments, words", [
    (["process", "{missing}", "{out}"], "no such file"),
    (["process", "{other}", "{out}"], r"--remap imu/data_raw:=/robot/imu"),
    (["process", "{bag}", "{out}", "--without", "orientation"], "no estimator 'orientation'"),
    (["process", "{bag}", "{out}", "--without", "orientation_estimator"], "switched off"),
    (["process", "{bag}", "{bag}"], "would be destroyed"),
    (["process", "{bag}", "{other}"], "not empty"),
    (["process", "{bag}", "{out}", "--params-file", "{missing}"], "cannot be read"),
    (["process", "{bag}", "{out}", "--remap", "imu/data_raw:=/imu/mag"],
     "is sensor_msgs/msg/MagneticField, expected sensor_msgs/msg/Imu"),
    (["info", "{missing}"], "no such file"),
    (["convert", "{bag}", "{out}", "--topic", "/nope"], "no topic '/nope'"),
    (["report", "{missing}"], "no such file"),
    (["demo", "nope", "--out", "{out}"], "no demo 'nope'; there are: .*orientation"),
])
def test_errors_are_one_line_with_exit_code_one(tmp_path, arguments, words):
    names = {"bag": write(tmp_path / "bag"), "other": write(tmp_path / "other", "/robot/imu"),
             "missing": str(tmp_path / "missing"), "out": str(tmp_path / "out")}
    result = call(*[a.format(**names) for a in arguments])
    assert result.exit_code == 1
    (line,) = [t for t in result.output.splitlines() if t.startswith("imu_fusion: ")]
    assert re.search(words, line), line


def test_wrong_usage_ends_with_two():
    assert call("process").exit_code == 2
    assert call("run", "nonsense").exit_code == 2
    assert call("process", "a", "b", "--remap", "x").exit_code == 2


@pytest.mark.parametrize("options, words", [
    (dict(mag_unit=1e6), "microtesla"), (dict(mag_unit=1e4), "gauss"),
    (dict(acc_unit=1 / 9.81), "gravity in g"),
])
def test_wrong_units_are_warned_of(tmp_path, options, words):
    result = call("process", write(tmp_path / "bag", **options), str(tmp_path / "out"))
    assert re.search(f"warning: .*{words}", result.output), result.output
    assert words in call("info", str(tmp_path / "bag")).output


@pytest.mark.parametrize("spoil, words", [
    (lambda i: {"gyr": [float("nan"), 0, 0]} if i == 300 else {}, "1 not finite"),
    (lambda i: {"stamp": START + 299 * STEP} if i == 300 else {}, "1 repeated stamp"),
    (lambda i: {"stamp": START + 290 * STEP - 1} if i == 300 else {}, "1 stamp older"),
])
def test_bad_samples_are_left_out_counted_and_named(tmp_path, spoil, words):
    result = call("process", write(tmp_path / "bag", spoil=spoil), str(tmp_path / "out"))
    assert result.exit_code == 0
    assert words.split()[1] in re.sub(r"\s+", " ", result.output)
    with open_bag(tmp_path / "out") as reader:
        assert reader.topics["/imu/data"].count == 599


def test_clock_that_goes_back_starts_the_estimate_anew(tmp_path):
    bag = write(tmp_path / "bag", spoil=lambda i: {
        "stamp": START + (i - 200 if i >= 300 else i) * STEP})
    assert call("process", bag, str(tmp_path / "out")).exit_code == 0
    with open_bag(tmp_path / "out") as reader:
        assert reader.topics["/imu/data"].count == 600


def test_convert_renames_and_selects(tmp_path):
    bag = write(tmp_path / "bag", "/robot/imu")
    result = call("convert", bag, str(tmp_path / "out"), "--topic", "/robot/imu",
                  "--remap", "/imu/data_raw:=/robot/imu")
    assert result.exit_code == 0, result.output
    with open_bag(tmp_path / "out") as reader:
        assert {t.name: t.count for t in reader.topics.values()} == {"/imu/data_raw": 600}


def test_info_repairs_a_truncated_recording(tmp_path):
    bag = write(tmp_path / "bag")
    file = tmp_path / "bag" / "bag_0.mcap"
    file.write_bytes(file.read_bytes()[:-100])
    result = call("info", bag, "--repair", str(tmp_path / "clean"))
    assert result.exit_code == 0 and "not closed properly" in result.output
    with open_bag(tmp_path / "clean") as reader:
        assert not reader.warnings and reader.count > 0


def test_topics_of_unknown_types_are_left_alone_and_kept_by_convert(tmp_path):
    """A recording of somebody's robot holds types that nobody has installed here."""
    types = get_typestore(Stores.ROS2_JAZZY)
    types.register(get_types_from_msg("float64 torque\nstring joint", "robot_msgs/msg/Joint"))
    joint = types.types["robot_msgs/msg/Joint"](torque=1.5, joint="knee")
    definition = (types.generate_msgdef("robot_msgs/msg/Joint", ros_version=2)[0],
                  types.hash_rihs01("robot_msgs/msg/Joint"))
    with BagWriter(tmp_path / "bag") as writer:
        for i in range(300):
            stamp = START + i * STEP
            writer.write("/joint", "robot_msgs/msg/Joint",
                         bytes(types.serialize_cdr(joint, "robot_msgs/msg/Joint")), stamp,
                         definition=definition)
            writer.write("/imu/data_raw", IMU.msgtype,
                         imu_message(stamp, "imu_link", [0, 0, 0], [0, 0, 9.81]), stamp)
    bag = str(tmp_path / "bag")
    assert "robot_msgs/Joint" in call("info", bag).output
    assert call("process", bag, str(tmp_path / "out")).exit_code == 0
    assert call("convert", bag, str(tmp_path / "copy")).exit_code == 0
    with open_bag(tmp_path / "copy") as reader:
        assert reader.topics["/joint"].count == 300
        *_, cdr = next(reader.messages(["/joint"]))
        assert types.deserialize_cdr(cdr, "robot_msgs/msg/Joint").joint == "knee"
        assert reader.definition("/joint") == definition
