"""Hostile recordings: what a file claims is not believed, and nothing of it is carried out. Broken
files of each kind by the thousand: ``python -m benchmarks.fuzz``."""

import contextlib
import random
import shutil
import sqlite3
import struct
from pathlib import Path

import lz4.frame
import pytest
import zstandard

from benchmarks.fuzz import KINDS, mutated, outcome, write_db3
from imu_fusion.errors import INCOMPLETE, ImuFusionError
from imu_fusion.messages.layouts import IMU, MAG
from imu_fusion.recordings import mcap_records, ros1_records
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.streams.registry import STAGES
from imu_fusion.surfaces.file import load_surface
from test.recordings.doors import rows_of, run, through
from test.recordings.raw_mcap import channel, chunk, in_chunk, mcap, message, schema, text
from test.recordings.test_bag import START, STEP, imu, write

HOSTILE = Path(__file__).parents[3] / "shared" / "cases" / "hostile"


@pytest.mark.parametrize("definition", [
    "a/A x", "float64 " * 5000, "\0\xff", "float64[99999999999] x", "float64 x\n" * 3000,
    "string class\nint8 __init__"])
def test_definitions_are_handed_on_and_not_interpreted(tmp_path, definition):
    file = mcap(tmp_path / "t.mcap", schema("a/msg/A", definition), channel("/a"),
                message(b"\0\1\0\0" + bytes(40)), schema(IMU.msgtype, "", 2), channel("/imu", 2),
                message(imu(0), 2))
    assert through("info", file, None).exit_code == 0
    assert through("convert", file, tmp_path / "out").exit_code == 0
    with open_bag(tmp_path / "out") as reader:
        assert {t.name: t.count for t in reader.topics.values()} == {"/a": 1, "/imu": 1}


@pytest.mark.parametrize("name", ["", "/a\n/b", "/a\x1b[31m", "/a\u202eb"])
def test_names_that_are_none_are_not_shown_raw(tmp_path, name):
    file = mcap(tmp_path / "t.mcap", schema(IMU.msgtype), channel(name), message(imu(0)))
    result = through("info", file, None)
    assert result.exit_code == 1 and "\x1b" not in result.output and len(
        result.output.splitlines()) == 1


def test_a_chunk_unpacks_within_a_bound_that_can_be_raised(tmp_path, monkeypatch):
    opcode, content = schema("a/msg/A", " " * 60_000_000, 2)
    unpacked = struct.pack("<BQ", opcode, len(content)) + content
    size = len(unpacked)
    for name, packed in (("zstd", zstandard.compress(unpacked)),
                         ("lz4", lz4.frame.compress(unpacked))):
        file = mcap(tmp_path / f"{name}.mcap", schema(IMU.msgtype), channel("/imu"),
                    message(imu(0)), chunk(name, packed, size))
        assert through("info", file, None).exit_code == 0
        monkeypatch.setenv("IMU_FUSION_MAX_CHUNK_MB", "50")
        result = through("info", file, None)
        assert result.exit_code == INCOMPLETE and "IMU_FUSION_MAX_CHUNK_MB" in result.output
        assert "--max-chunk-mb" in result.output
        assert run("--max-chunk-mb", "70", "info", file).exit_code == 0
        # What it says is not what it unpacks to.
        lying = mcap(tmp_path / "lying.mcap", schema(IMU.msgtype), channel("/imu"),
                     message(imu(0)), chunk(name, packed, 1000))
        assert "another size than the 1000 bytes" in through("info", lying, None).output
        monkeypatch.delenv("IMU_FUSION_MAX_CHUNK_MB")


def test_a_chunk_of_zeros_is_no_million_of_records(tmp_path):
    assert list(mcap_records.records(bytes(100))) == [(mcap_records.NONE, bytes(100))]
    assert list(ros1_records.records(bytes(100))) == [({}, bytes(100))]


@pytest.mark.parametrize("length", [0, 2**31 - 1, 2**32 - 1])
def test_lengths_inside_of_messages_are_not_believed(tmp_path, length):
    cdr = bytearray(imu(0))
    cdr[12:16] = struct.pack("<I", length)
    file = mcap(tmp_path / "t.mcap", schema(IMU.msgtype), channel("/imu"), message(bytes(cdr)),
                *(message(imu(i), log_time=START + i * STEP) for i in range(20)))
    result = through("info", file, None)
    assert result.exit_code == INCOMPLETE and "1 messages cannot be decoded" in result.output


@pytest.mark.parametrize("log_time", [0, 1, 2**63, 2**64 - 1])
def test_log_times_at_the_ends_of_their_range(tmp_path, log_time):
    file = mcap(tmp_path / "t.mcap", schema(IMU.msgtype), channel("/imu"),
                message(imu(0), log_time=log_time), message(imu(1)))
    assert through("info", file, None).exit_code == 0
    assert through("convert", file, tmp_path / "out").exit_code == 0
    assert sorted(row[2] for row in rows_of(tmp_path / "out")[0]) == sorted([log_time, START])


def test_log_times_below_zero_are_zero(tmp_path):
    file = write_db3(tmp_path)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    before, _ = rows_of(file)
    with sqlite3.connect(file) as database:
        database.execute("update messages set timestamp = timestamp - ?", (START + STEP,))
    result = through("info", file, None)
    assert result.exit_code == 0 and "those below zero are read as zero" in result.output
    assert through("convert", file, tmp_path / "out").exit_code == 0
    after, _ = rows_of(tmp_path / "out")
    assert after[0][2] == 0 and [row[3] for row in after] == [row[3] for row in before]
    with open_bag(file) as reader:    # as the replayer asks for them
        assert len(list(reader.messages(None, reader.start_time, reader.end_time))) == len(before)


def test_metadata_is_a_hint(tmp_path):
    bag = write(tmp_path / "bag", 30)
    good = (bag / "metadata.yaml").read_text()
    for content, words in (
            ("", "is not used"), ("[1]", "is not used"), ("a: &a [*a]", "contains itself"),
            ("[" * 3000, "is not used"), ("!!python/object/apply:os.system [x]", "is not used"),
            (good.replace("bag_0.mcap", "gone_0.mcap"), "gone_0.mcap, which is not there"),
            (good.replace("bag_0.mcap", "../../etc/passwd"), "passwd, which is not there")):
        (bag / "metadata.yaml").write_text(content)
        rows, reader = rows_of(bag)
        assert len(rows) == 40 and words in " ".join(reader.warnings) and not reader.damaged
    for content in (good, good.replace("message_count: 30", "message_count: 99999999999999999999"),
                    good.replace("depth: 10", "depth: deep")):
        (bag / "metadata.yaml").write_text(content)
        rows, reader = rows_of(bag)
        assert len(rows) == 40 and not reader.warnings
    (bag / "metadata.yaml").write_text(good)
    shutil.copy(bag / "bag_0.mcap", bag / "bag_1.mcap")
    rows, reader = rows_of(bag)
    assert len(rows) == 40 and "bag_1.mcap is not named" in reader.warnings[0]


@pytest.mark.parametrize("again", [
    (4, struct.pack("<HH", 1, 1) + text("/other", "cdr", "")), schema(MAG.msgtype)])
def test_a_number_that_is_used_again_is_no_sample_of_the_first(tmp_path, again):
    """In a chunk and outside of them, with a summary that knows the last one only, and without."""
    head, one, two = (schema(IMU.msgtype), channel("/imu")), message(imu(0)), message(
        imu(1), log_time=START + STEP)
    for file in (mcap(tmp_path / "a.mcap", *head, one, again, two),
                 mcap(tmp_path / "b.mcap", in_chunk(*head, one), in_chunk(again, two))):
        rows, reader = rows_of(file)
        assert [row[3] for row in rows if row[0] == "/imu"] == [imu(0)]
        assert reader.damaged and "is defined anew" in " ".join(reader.warnings)


def test_what_a_database_only_claims_is_neither_waited_for_nor_passed_over(tmp_path):
    file = write_db3(tmp_path)
    with sqlite3.connect(file) as database:
        database.execute("update messages set topic_id = 77 where id % 3 = 0")
        database.execute("update messages set data = 'text' where id = 10")
    result = through("info", file, None)
    assert result.exit_code == INCOMPLETE
    assert "160 messages are of a topic (77)" in result.output and "no bytes" in result.output
    with sqlite3.connect(file) as database:
        database.execute("alter table messages rename to others")
        database.execute("create view messages as with recursive c(x) as (select 1 union all "
                         "select x + 1 from c) select x as id, 1 as topic_id, x as timestamp, "
                         "x'00' as data from c")
    result = through("info", file, None)
    assert result.exit_code == 1 and "no tables" in result.output


@pytest.mark.parametrize("kind", KINDS)
def test_mutations_are_read_or_refused(tmp_path, kind):
    make, read = KINDS[kind]
    file = make(tmp_path)
    data = file.read_bytes()
    rng = random.Random(f"quick {kind}")
    assert outcome(read, file) == "read"
    for _ in range(40):
        broken, done = mutated(data, rng, file.suffix)
        file.write_bytes(broken)
        assert outcome(read, file) in ("read", "refused"), done


@pytest.mark.skipif(not HOSTILE.exists(), reason="the collection is not there")
@pytest.mark.parametrize("file", sorted(
    p for folder in ("fuzz/*", "natural", "hand") for p in HOSTILE.glob(f"{folder}/*")
    if p.suffix != ".txt"), ids=lambda p: f"{p.parent.name}/{p.name}")
def test_every_collected_file_is_read_or_refused_in_a_line(tmp_path, file):
    for door in ("info", "convert"):
        result = through(door, file, tmp_path / door)
        if result.exit_code == 1:
            (line,) = [t for t in result.output.splitlines() if t.startswith("imu_fusion: ")]
            assert file.name in line or file.parent.name in line


@pytest.mark.skipif(not HOSTILE.exists(), reason="the collection is not there")
@pytest.mark.parametrize("table", sorted(HOSTILE.glob("csv/*.csv")), ids=lambda p: p.stem)
def test_every_collected_table_is_read_or_refused_in_a_line(tmp_path, table):
    result = run("convert", table, tmp_path / "out", "--description", table.with_suffix(".yaml"))
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert (tmp_path / "out").exists() == (result.exit_code != 1)
    if result.exit_code == 1:
        (line,) = [t for t in result.output.splitlines() if t.startswith("imu_fusion: ")]
        assert table.stem in line or "known: " in line


@pytest.mark.skipif(not HOSTILE.exists(), reason="the collection is not there")
@pytest.mark.parametrize("file", sorted(HOSTILE.glob("csv/*.*.yaml")), ids=lambda p: p.stem)
def test_every_collected_parameter_or_surface_file_is_read_or_refused(file):
    for read in ([load_surface] if ".surface." in file.name else
                 [stage.prepare for stage in STAGES.values()]):
        with contextlib.suppress(ImuFusionError):
            read(file)
