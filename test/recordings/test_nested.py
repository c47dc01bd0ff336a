"""A message inside of a driver's own message is a topic, for whoever names the field."""

import struct

import numpy as np
import pytest
from click.testing import CliRunner

from imu_fusion import batch, cli
from imu_fusion.errors import TopicError
from imu_fusion.messages.convert import imu_message
from imu_fusion.messages.layouts import IMU
from imu_fusion.messages.typestore import TYPES
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.logs import read_log

IMU_TEXT = TYPES.generate_msgdef("sensor_msgs/msg/Imu", ros_version=2)[0]
DEFINITION = ("std_msgs/Header header\nuint8 GROUP=3   # a constant\nstring<=8[] labels\n"
              "Status status\nsensor_msgs/Imu imu\nfloat32[3] rest\n" + "=" * 80
              + "\nMSG: vendor/Status\nbool ok\nfloat64[<=2] values\n" + "=" * 80
              + "\nMSG: sensor_msgs/Imu\n" + IMU_TEXT)
FIRST = 1_700_000_000_000_000_000


class Cdr:
    """Writes CDR by its rules, beside the reader that is tested."""

    def __init__(self):
        self.data = b""

    def put(self, code, *values):
        size = struct.calcsize(code)
        self.data += bytes(-len(self.data) % size) + b"".join(
            struct.pack("<" + code, v) for v in values)
        return self

    def text(self, text):
        data = text.encode() + b"\0"
        self.put("I", len(data)).data += data
        return self

    def header(self, stamp, frame):
        return self.put("i", stamp // 10**9).put("I", stamp % 10**9).text(frame)


def message(stamp, inner, labels, values, gyr, acc):
    """A vendor's message; ``inner``: the stamp of its Imu."""
    cdr = Cdr().header(stamp, "outer").put("I", len(labels))
    for label in labels:
        cdr.text(label)
    cdr.put("?", True).put("I", len(values)).put("d", *values) if values else cdr.put(
        "?", True).put("I", 0)
    cdr.header(inner, "imu" if inner else "").put("d", 0, 0, 0, 1, -1, *[0] * 8)
    cdr.put("d", *gyr, *[0] * 9).put("d", *acc, *[0] * 9).put("f", 1, 2, 3)
    return b"\0\1\0\0" + cdr.data


def write(path, **changes):
    """100 Hz; strings and sequences of changing length ahead of the Imu."""
    with BagWriter(path) as writer:
        for k in range(300):
            stamp = FIRST + 10_000_000 * k
            cdr = message(stamp, 0 if changes.get("unset") else stamp + 1_000_000,
                          ["a" * (k % 5)] * (k % 3), [1.0] * (k % 3), [0.0, 0.0, 0.1 * k],
                          [0.0, 0.0, 9.81])
            writer.write("/vendor/data", "vendor/msg/Data", cdr[:60] if k == changes.get("cut")
                         else cdr, stamp, definition=(DEFINITION, "RIHS01_" + "0" * 64))
    return path


def test_the_field_is_a_topic(tmp_path):
    with open_bag(write(tmp_path / "bag")) as reader:
        log = read_log(reader, "vendor/data.imu")
        assert list(reader.topics) == ["/vendor/data", "/vendor/data.imu"]
    assert len(log) == 300 and log.frame_id == "imu"
    assert log.stamp[7] == FIRST + 71_000_000
    assert log.gyr[:, 2] == pytest.approx(0.1 * np.arange(300))
    expected = imu_message(int(log.stamp[7]), "imu", log.gyr[7], log.acc[7])
    with open_bag(tmp_path / "bag") as reader:
        reader.require("/vendor/data.imu", "sensor_msgs/msg/Imu")
        found = [m[3] for m in reader.messages(["/vendor/data.imu"])][7]
    assert np.array_equal(IMU.decode(found)[2], IMU.decode(expected)[2])


def test_a_stamp_that_is_unset_inside_is_that_of_the_message(tmp_path):
    with open_bag(write(tmp_path / "bag", unset=True)) as reader:
        log = read_log(reader, "/vendor/data.imu")
    assert log.stamp[7] == FIRST + 70_000_000 and log.frame_id == "outer"


def test_process_and_convert_take_it(tmp_path):
    write(tmp_path / "bag", cut=5)
    reports, _ = batch.process(tmp_path / "bag", tmp_path / "out", None, ["smoother"],
                               {"imu/data_raw": "/vendor/data.imu"})
    used = {r.node: r.used for r in reports}
    assert used["orientation_estimator"] == {"imu/data_raw": 299}
    result = CliRunner().invoke(cli.cli, [
        "convert", str(tmp_path / "bag"), str(tmp_path / "plain"), "--topic", "/vendor/data.imu",
        "--remap", "imu/data_raw:=/vendor/data.imu"])
    assert result.exit_code == 3 and "cannot be decoded" in result.output    # one was cut
    with open_bag(tmp_path / "plain") as reader:
        assert {n: t.count for n, t in reader.topics.items()} == {"/imu/data_raw": 299}


@pytest.mark.parametrize("name", ["/vendor/data.nothing", "/vendor/data.status",
                                  "/vendor/data.imu.orientation", "/other.imu"])
def test_other_fields_are_none(tmp_path, name):
    with open_bag(write(tmp_path / "bag")) as reader, pytest.raises(TopicError, match="no topic"):
        reader.require(name)
