"""Damaged exports: a broken line costs itself, and what is lost is said."""

import io
import zipfile

import pytest
import yaml
from click.testing import CliRunner

from benchmarks.fuzz_devices import write_device
from imu_fusion.cli import cli
from imu_fusion.errors import INCOMPLETE, ImuFusionError, SampleError
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.sources.description import Description
from imu_fusion.sources.gpx import Gpx
from imu_fusion.sources.table import TableSource
from test.sources.exports import export, zipped
from test.sources.logs import read
from test.sources.test_exports import LOCATION
from test.sources.test_splitting import STREAMS

TEXTS = ["phyphox", "phyphox_location", "sensor_logger", "avanode_imu", "avanode_gnss", "table"]


def counts(path):
    """{topic: messages}, and what is lost, of the export that a file belongs to."""
    folder = next((p for p in (path, *path.parents) if p.name in ("walk", "log")), path)
    with open_bag(folder) as reader:
        return {topic: info.count for topic, info in reader.topics.items()}, reader.losses


@pytest.mark.parametrize("kind", TEXTS)
@pytest.mark.parametrize("damage", ["zeros", "junk", "two in one", "a quote without end", "cut"])
def test_a_broken_line_costs_itself(tmp_path, kind, damage):
    file = write_device(kind, tmp_path)
    before, lost = counts(file)
    assert not lost
    lines = file.read_bytes().splitlines(keepends=True)
    at = len(lines) // 2
    if damage == "cut":
        lines[-1] = lines[-1][:len(lines[-1]) // 4]
    else:
        line = lines[at]
        lines[at] = {"zeros": line[:3] + bytes(len(line) - 4) + line[-1:],
                     "junk": b",".join([b"?"] * 3 + line.split(b",")[3:]),
                     "a quote without end": b'"' + b"1" * 200_000 + line[-1:],
                     "two in one": line.rstrip(b"\r\n") + b","}[damage]
    file.write_bytes(b"".join(lines))
    after, lost = counts(file)
    (said,) = lost
    assert "1 lines that cannot be read, the first: " in said and f"{file}, line " in said
    # A line that ran on takes another one along; where a force is missing one is interpolated.
    assert all(count - 2 <= after[topic] <= count for topic, count in before.items())


def test_a_broken_time_of_an_experiment_is_told(tmp_path):
    file = write_device("phyphox_time", tmp_path)
    before, _ = counts(file)
    file.write_bytes(file.read_bytes().replace(b'"PAUSE",.5E0', b'"PAUSE",.5X0'))
    after, (said,) = counts(file)
    assert after == before and f"{file}, line 3" in said


def test_a_track_is_read_up_to_its_damage():
    whole = STREAMS["gpx"][1]
    for broken in (whole[:len(whole) * 3 // 4], whole.replace(b'lat="47.3"', b'lat="<47.3"')):
        source = Gpx()
        assert list(read(source, broken)["fix"].latitude_deg) == [47.0, 47.1, 47.2]
        assert sum(source.lost.values()) == 1
    source = Gpx()
    found = read(source, whole.replace(b'lat="47.3"', b'lat="4X.3"'))["fix"]
    assert list(found.latitude_deg) == [47.0, 47.1, 47.2, 47.4]
    assert source.lost == {"track points that cannot be read": 1}


DESCRIPTION = {"time": {"column": "t"}, "accelerometer": {"columns": ["x", "y", "z"]}}


def table(text, **description):
    source = TableSource(Description.from_mapping(DESCRIPTION | description, "d.yaml"))
    return read(source, text.encode(), "t.csv"), source


def rows(count, broken=()):
    return "t,x,y,z\n" + "".join(
        f"{k}.5,0,{'?' if k in broken else 1},9\n" for k in range(count))


def test_so_many_broken_lines_are_a_wrong_description():
    assert len(table(rows(40, broken=(3, 7, 9, 11, 13, 39)))[0]["imu/data_raw"]) == 34
    with pytest.raises(SampleError, match=r"t\.csv, line 5, column 'y': '\?' is not a number"):
        table(rows(40, broken=(3, 7, 9, 11, 13, 15, 39)))
    with pytest.raises(SampleError, match="line 2, column 'y'"):    # told before the end
        TableSource(Description.from_mapping(DESCRIPTION, "d.yaml")).feed(
            rows(3000, broken=range(3000)).encode(), "t.csv")


def test_a_broken_line_has_its_time_where_times_are_counted():
    found, _ = table(rows(40, broken=(3, 17)), time={"rate": 10.0})
    assert list(found["imu/data_raw"].stamp // 100_000_000) == [
        k for k in range(40) if k not in (3, 17)]


def test_a_last_line_that_was_cut_off_says_nothing_of_the_others():
    found, source = table(rows(3) + "3.5,0,")
    assert len(found["imu/data_raw"]) == 3
    (said,) = source.lost
    assert "line 5: 3 cells, column 'z' is missing" in said


def test_text_in_utf_16_is_read_as_any_other(tmp_path):
    (tmp_path / "d.yaml").write_text(yaml.safe_dump(DESCRIPTION))
    (tmp_path / "t.csv").write_text(rows(9))
    (tmp_path / "u.csv").write_text(rows(9), encoding="utf-16")
    found = []
    for name in ("t.csv", "u.csv"):
        with open_bag(tmp_path / name, tmp_path / "d.yaml") as reader:
            found.append(list(reader.messages()))
    assert found[0] == found[1] and len(found[0]) == 9
    (tmp_path / "u.csv").write_text(rows(9), encoding="utf-16-le")    # without its mark
    with pytest.raises(ImuFusionError, match="zeros"):
        open_bag(tmp_path / "u.csv", tmp_path / "d.yaml")


def test_a_damaged_file_of_an_archive_costs_no_other(tmp_path):
    data = bytearray(zipped(export()))
    with zipfile.ZipFile(io.BytesIO(bytes(data))) as archive:
        entry = archive.getinfo("walk/Magnetometer.csv")
        at = entry.header_offset + 30 + len(entry.filename) + entry.compress_size // 2
    (tmp_path / "whole.zip").write_bytes(data)
    data[at:at + 4] = b"\xff" * 4
    (tmp_path / "walk.zip").write_bytes(data)
    with open_bag(tmp_path / "whole.zip") as whole, open_bag(tmp_path / "walk.zip") as reader:
        assert reader.topics["/imu/data_raw"].count == whole.topics["/imu/data_raw"].count
        assert any("walk/Magnetometer.csv" in text for text in reader.losses)


def test_what_macos_leaves_beside_is_no_part_of_an_export(tmp_path):
    files = export()
    beside = {f"__MACOSX/walk/._{name.rpartition('/')[2]}": b"\0\5\x16\7\0\2" + bytes(100)
              for name in files}
    for name, content in (("plain", files), ("mac", beside | files)):
        (tmp_path / f"{name}.zip").write_bytes(zipped(content))
    with open_bag(tmp_path / "plain.zip") as plain, open_bag(tmp_path / "mac.zip") as mac:
        assert list(plain.messages()) == list(mac.messages()) and not mac.damaged


def test_a_sensor_that_gave_nothing_costs_no_other(tmp_path):
    """A phone without a magnetometer, or that never knew where it was."""
    files = export()
    (tmp_path / "walk.zip").write_bytes(zipped(files | {
        "walk/Magnetometer.csv": files["walk/Magnetometer.csv"].partition(b"\n")[0] + b"\n",
        "walk/Location.csv": LOCATION.encode()}))
    with open_bag(tmp_path / "walk.zip") as reader:
        assert set(reader.topics) == {"/imu/data_raw"} and not reader.damaged
        assert sum("no rows of numbers" in text for text in reader.warnings) == 2


def test_what_is_lost_shows_in_the_exit_code(tmp_path):
    file = write_device("table", tmp_path)
    file.write_bytes(file.read_bytes()[:-20])
    for arguments in (["info", file], ["convert", file, tmp_path / "out"]):
        result = CliRunner().invoke(cli, [str(word) for word in arguments])
        assert result.exit_code == INCOMPLETE and "1 lines that cannot be read" in result.output
