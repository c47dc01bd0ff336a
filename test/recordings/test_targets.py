"""What is written never takes with it what was read, nor what is no recording; whole or not at
all."""

import os
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from imu_fusion.cli import cli
from imu_fusion.errors import BagError
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.bag_writer import BagWriter
from imu_fusion.recordings.mcap_writer import McapWriter
from imu_fusion.recordings.targets import refuse_source, whole_file, why_not_replaced
from test.recordings.test_bag import IMU, START, imu, write


def contents(folder: Path):
    """Every file below a folder and its bytes."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def names_of_the_source(bag: Path):
    """Ways to name a recording, or something that holds or lies in it."""
    (bag.parent / "link").symlink_to(bag)
    hard = bag.parent / "hard"
    shutil.copytree(bag, hard, copy_function=os.link)
    return [bag, bag.parent / "." / "bag", bag.parent / "link", hard, bag / "inside", bag.parent,
            bag / "bag_0.mcap"]


@pytest.mark.parametrize("command", ["process", "pipeline", "convert"])
def test_no_command_destroys_its_source(tmp_path, command):
    bag = write(tmp_path / "bag", 20)
    outs = names_of_the_source(bag)
    before = contents(tmp_path)
    for source in (bag, bag / "bag_0.mcap"):
        for out in outs:
            if source.is_file() and out.name == "inside":
                continue    # beside the file
            result = CliRunner().invoke(cli, [command, str(source), str(out), "--overwrite"])
            assert result.exit_code == 1 and "would be destroyed" in result.output, (out, result)
    assert contents(tmp_path) == before


def test_repair_and_report_do_not_write_over_their_source(tmp_path):
    bag = write(tmp_path / "bag", 20)
    before = contents(tmp_path)
    for arguments in (["info", str(bag), "--repair", str(bag)],
                      ["report", str(bag), "--out", str(bag / "bag_0.mcap")],
                      ["calibrate", "noise", str(bag), "--out", str(bag / "bag_0.mcap")],
                      ["calibrate", "noise", str(bag), "--plot", str(bag / "metadata.yaml")]):
        result = CliRunner().invoke(cli, arguments)
        assert result.exit_code == 1 and "choose another name" in result.output
    assert contents(tmp_path) == before


def test_what_is_of_another_kind_is_not_replaced(tmp_path):
    bag = write(tmp_path / "bag", 20)
    notes = tmp_path / "notes.txt"
    notes.write_text("what took years")
    before = contents(tmp_path)
    result = CliRunner().invoke(cli, ["report", str(bag), "--out", str(notes)])
    assert result.exit_code == 1 and "is something else" in result.output
    with pytest.raises(BagError, match="is something else"), whole_file(notes, "# Noise") as part:
        part.write_text("# Noise of another")
    assert contents(tmp_path) == before
    for _ in range(2):    # a report takes the place of the one before
        assert CliRunner().invoke(cli, ["report", str(bag), "--out", str(tmp_path / "r.html")]
                                  ).exit_code == 0


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    file = tmp_path / "file.txt"
    for there in ("", "before"):
        with pytest.raises(BagError, match="file.txt: cannot be written"), whole_file(file) as part:
            part.write_text("half")
            raise OSError(28, "No space left on device")
        assert file.exists() == bool(there) and list(tmp_path.iterdir()) == [file] * bool(there)
        file.write_text("before")
    (tmp_path / "link").symlink_to(file)
    with whole_file(tmp_path / "link") as part:
        part.write_text("after")
    assert file.read_text() == "after" and (tmp_path / "link").is_symlink()
    with pytest.raises(BagError, match="cannot be written"), whole_file(file / "x") as part:
        part.write_text("")


def test_several_results_go_where_none_of_the_recordings_lies(tmp_path):
    first, second = write(tmp_path / "first", 20), write(tmp_path / "out" / "first", 20)
    (tmp_path / "table").mkdir()
    (tmp_path / "table" / "summary.csv").write_text("of somebody")
    before = contents(tmp_path)
    for out, words in (("out", "would be destroyed"), ("table", "exists already")):
        result = CliRunner().invoke(cli, [
            "process", str(first), str(second / "first_0.mcap"), str(tmp_path / out),
            *(["--overwrite"] if out == "out" else [])])
        assert result.exit_code == 1 and words in result.output
    assert contents(tmp_path) == before


def test_a_description_is_not_taken_for_the_parameter_file_that_is_made(tmp_path):
    table, description = tmp_path / "run.csv", tmp_path / "run.yaml"
    table.write_text("t,x,y,z\n0,0,0,9.8\n1,0,0,9.8\n")
    places = {"a": "[0, 0, 1]", "b": "[0, 1, 0]", "c": "[1, 0, 0]", "d": "[-1, 0, 0]"}
    text = "time: {column: t}\naccelerometers:\n" + "".join(
        f"  {name}: {{columns: [x, y, z], position: {place}}}\n" for name, place in places.items())
    description.write_text(text)
    result = CliRunner().invoke(cli, ["convert", "--csv", str(description), str(table),
                                      str(tmp_path / "run"), "--overwrite"])
    assert result.exit_code == 0 and "run_parameters.yaml" in result.output, result.output
    assert description.read_text() == text
    assert "position" in (tmp_path / "run_parameters.yaml").read_text()


def test_a_folder_of_recordings_is_not_a_recording(tmp_path):
    bag = write(tmp_path / "bag", 20)
    folder = tmp_path / "monday"
    folder.mkdir()
    for name in ("first", "second", "third"):
        shutil.copy(bag / "bag_0.mcap", folder / f"{name}.mcap")
    assert "folder of files" in why_not_replaced(folder)
    shutil.copy(bag / "metadata.yaml", folder)
    assert "does not name first.mcap" in why_not_replaced(folder)
    before = contents(folder)
    result = CliRunner().invoke(cli, ["convert", str(bag), str(folder), "--overwrite"])
    assert result.exit_code == 1 and "monday: exists and is not empty" in result.output
    assert contents(folder) == before
    (bag / "metadata.yaml").write_text("[1, 2]")
    assert "does not describe a recording" in why_not_replaced(bag)
    (bag / "metadata.yaml").unlink()
    assert why_not_replaced(bag) == ""    # what a recorder leaves that was killed


@pytest.mark.parametrize("there", ["nothing", "an empty folder", "a recording"])
def test_a_result_appears_whole_or_not_at_all(tmp_path, there):
    out = tmp_path / "out"
    if there == "an empty folder":
        out.mkdir()
    elif there == "a recording":
        write(out, 7)
    before = contents(tmp_path), sorted(tmp_path.iterdir())

    def fail():
        with BagWriter(out, overwrite=True, whole=True) as writer:
            writer.write("/imu", IMU.msgtype, imu(0), START)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert (contents(tmp_path), sorted(tmp_path.iterdir())) == before
    with BagWriter(out, overwrite=True, whole=True) as writer:
        writer.write("/imu", IMU.msgtype, imu(0), START)
        assert not (out / "metadata.yaml").exists() or there == "a recording"
        if there == "a recording":
            with open_bag(out) as reader:
                assert reader.count == 10
    with open_bag(out) as reader:
        assert reader.count == 1 and not reader.warnings
    assert sorted(p.name for p in out.iterdir()) == ["metadata.yaml", "out_0.mcap"]
    assert list(tmp_path.iterdir()) == [out]


def test_what_a_live_recording_replaces_goes_when_it_is_complete(tmp_path):
    out = write(tmp_path / "out", 7)
    writer = BagWriter(out, overwrite=True)
    writer.write("/imu", IMU.msgtype, imu(0), START)
    (aside,) = (p for p in tmp_path.iterdir() if p != out)
    with open_bag(aside) as reader:
        assert reader.count == 10
    writer.close()
    assert list(tmp_path.iterdir()) == [out]
    with open_bag(out) as reader:
        assert reader.count == 1


def test_a_failed_convert_can_be_repeated(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    source = write(tmp_path / "source", 20)
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(McapWriter, "finish", full)
        result = CliRunner().invoke(cli, ["convert", str(source), str(out)])
    assert result.exit_code == 1 and "No space left" in result.output
    assert list(tmp_path.iterdir()) == [source]
    assert CliRunner().invoke(cli, ["convert", str(source), str(out)]).exit_code == 0


def test_sources_are_told_apart_from_others(tmp_path):
    bag = write(tmp_path / "bag", 3)
    refuse_source(bag, tmp_path / "bag2")
    refuse_source(bag, tmp_path / "other" / "bag")
    with pytest.raises(BagError, match="would be destroyed"):
        refuse_source(bag, tmp_path / "bag2" / ".." / "bag")
