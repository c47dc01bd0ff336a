"""Topics that estimators need: found, of another type, or missing, in words that help."""

from click.testing import CliRunner

from imu_fusion.cli import cli
from imu_fusion.messages.convert import imu_message
from imu_fusion.messages.layouts import IMU, MAG, VECTOR3
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.inputs import find_inputs
from test.recordings.test_bag import START, STEP, imu


def write(path, types):
    """A recording with some messages on each topic; what is in them does not matter here."""
    with BagWriter(path) as writer:
        for topic, msgtype in types.items():
            for i in range(3):
                writer.write(topic, msgtype, imu(i), START + i * STEP)
    return path


def found(path, required, optional=()):
    with open_bag(path) as reader:
        return (*find_inputs(reader, required, dict(optional)), reader.warnings)


def test_an_optional_topic_of_another_type_is_left_out_and_said(tmp_path):
    """As old drivers publish the magnetic field."""
    bag = write(tmp_path / "bag", {"/imu/data_raw": IMU.msgtype, "/imu/mag": VECTOR3.msgtype})
    names, missing, warnings = found(bag, {"imu/data_raw": IMU.msgtype}, {"imu/mag": MAG.msgtype})
    assert names == {"imu/data_raw": "/imu/data_raw"} and not missing
    assert warnings == ["topic '/imu/mag' is geometry_msgs/msg/Vector3Stamped, expected "
                        "sensor_msgs/msg/MagneticField; it is left out"]


def test_a_required_topic_of_another_type_is_missing_and_says_what_would_fit(tmp_path):
    bag = write(tmp_path / "bag", {"/imu/data_raw": VECTOR3.msgtype, "/imu": IMU.msgtype})
    names, missing, _ = found(bag, {"imu/data_raw": IMU.msgtype})
    assert not names and "is geometry_msgs/msg/Vector3Stamped" in missing
    assert "add --remap imu/data_raw:=/imu" in missing


def test_one_accelerometer_of_an_array_is_no_imu(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for i in range(3):
            writer.write("/accelerometers/front", IMU.msgtype, imu_message(
                START + i * STEP, "head", None, [0.0, 0.0, 9.81]), START + i * STEP)
    result = CliRunner().invoke(cli, ["process", str(tmp_path / "bag"), str(tmp_path / "out")])
    assert result.exit_code == 1 and "imu/data_raw" in result.output
    assert "--remap" not in result.output and "/accelerometers/front" not in result.output
    assert "it has accelerometers of an array" in result.output
