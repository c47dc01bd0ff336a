"""Readings of phones, as phyphox and Sensor Logger give them."""

import numpy as np
import openpyxl
import pytest

from imu_fusion.errors import ImuFusionError, SampleError
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.sources.phyphox import PhyphoxExport
from imu_fusion.sources.phyphox_live import PhyphoxLive
from imu_fusion.sources.registry import recognise
from imu_fusion.sources.sensor_logger import SensorLoggerExport, SensorLoggerPush
from imu_fusion.sources.source import STANDARD_GRAVITY, is_number
from test.sources.exports import TIME, Server, batches, export, poll, sensor_logger
from test.sources.logs import read_parts, same, together


def test_all_dialects_of_phyphox_are_equal_and_its_clock_goes_on_in_a_pause():
    expected = read_parts(PhyphoxExport(), export())
    for delimiter, decimal in ((";", ","), ("\t", "."), ("\t", ","), (";", ".")):
        assert same(read_parts(PhyphoxExport(), export(delimiter, decimal)), expected)
    assert same(read_parts(PhyphoxExport(), export(long_names=False)), expected)
    mag = expected["imu/mag"]
    assert mag.stamp[0] == 1770000000_250_000_000
    assert mag.stamp[-1] == 1770000100_250_000_000 + 980_000_000
    assert np.linalg.norm(mag.mag, axis=1) == pytest.approx(np.full(50, 44.9e-6), abs=1e-6)


def test_an_export_in_another_language_is_the_same():
    words = {b"Time": b"Zeit", b"Acceleration": b"Beschleunigung", b"Gyroscope": b"Drehrate",
             b"Magnetic field": b"Feld"}
    files = {}
    for name, data in zip(("Kraft", "Drehung", "Feld", "meta/time"), export().values()):
        for english, german in words.items():
            data = data.replace(english, german)
        files[f"walk/{name}.csv"] = data
    assert recognise(files).name == "phyphox"
    assert same(read_parts(PhyphoxExport(), files), read_parts(PhyphoxExport(), export()))


def test_an_accelerometer_alone_is_said(tmp_path):
    part, data = next(iter(export().items()))
    (tmp_path / "walk").mkdir()
    (tmp_path / part).write_bytes(data)
    with pytest.raises(ImuFusionError, match="there is the accelerometer alone"):
        open_bag(tmp_path / "walk")


def test_an_excel_export_is_read_by_its_library(tmp_path):
    book = openpyxl.Workbook()
    book.remove(book.active)
    for part, data in export(delimiter=";").items():
        name = "Metadata Time" if part.endswith("time.csv") else part[5:-4]
        sheet = book.create_sheet(name)
        for line in data.decode().splitlines():
            cells = [c.strip('"') for c in line.split("," if "time.csv" in part else ";")]
            sheet.append([float(c) if is_number(c) else c for c in cells])
    book.save(tmp_path / "walk.xlsx")
    found = read_parts(PhyphoxExport(), {"walk.xlsx": (tmp_path / "walk.xlsx").read_bytes()})
    assert same(found, read_parts(PhyphoxExport(), export()))


@pytest.mark.parametrize("step", [0.03, 0.25, 2.0])
def test_what_phyphox_told_live_is_what_it_exports(step):
    source, server = PhyphoxLive(), Server()
    blocks = poll(source, server)
    for k in range(int(1 / step) + 6):
        server.now = k * step
        blocks += poll(source, server)
    found = together(blocks + source.finish())
    start_only = "\n".join(TIME.splitlines()[:2])
    assert same(found, read_parts(PhyphoxExport(), export(clock=start_only)))
    assert not source.lost and "All" in source.device


def test_phyphox_cleared_begins_anew_and_broken_answers_are_counted():
    source, server = PhyphoxLive(), Server()
    for now in (0.0, 0.2, 0.4, 0.6):
        server.now = now
        poll(source, server)
    server.session, server.now = "bb22", 0.1
    source.feed(b"<html>404</html>", "/get?x")
    for _ in range(3):
        again = poll(source, server)
    stamps = together(again or poll(source, server))
    assert sum(source.lost.values()) == 2
    assert all(log.stamp[0] <= 1770000000_350_000_000 for log in stamps.values())


@pytest.mark.parametrize("platform, standardised", [
    ("ios", False), ("ios", True), ("android", False)])
def test_a_phone_that_lies_flat_feels_g_upwards_on_either_system(platform, standardised):
    source = SensorLoggerExport()
    found = read_parts(source, sensor_logger(platform, standardised))
    imu = found["imu/data_raw"]
    assert imu.acc == pytest.approx(np.tile([0.0, 0.5, STANDARD_GRAVITY], (59, 1)))
    assert imu.gyr[0] == pytest.approx([0.1, 0.2, 0.3])
    assert imu.stamp[0] == 1_698_501_144_404_773_000    # beyond what a float tells apart
    assert found["imu/mag"].mag[0] == pytest.approx([20e-6, 0.0, -40e-6])
    fix, velocity = found["fix"], found["fix_velocity"]
    assert list(fix.status) == [0, -1] and np.diag(fix.cov_enu[0]) == pytest.approx([4, 4, 9])
    assert velocity.vel_world == pytest.approx(np.array([[4.0, 0.0, 0.0]]))
    assert velocity.cov_world[0, 0, 0] == pytest.approx(0.25)
    assert any("before the recording" in remark for remark in source.remarks)


def test_without_the_platform_the_sign_is_not_guessed():
    files = sensor_logger(without=("Metadata",))
    with pytest.raises(SampleError, match="log: Metadata.csv does not tell the platform"):
        read_parts(SensorLoggerExport(), files)
    found = read_parts(SensorLoggerExport(platform="ios"), files)
    assert found["imu/data_raw"].acc[0, 2] == pytest.approx(STANDARD_GRAVITY)


def test_pushed_out_of_order_is_what_is_exported():
    source, pushed = SensorLoggerPush(), batches()
    order = [0, 2, 1, 3, 6, 5, 4, *range(7, len(pushed))]
    found = together([block for k in order for block in source.feed(pushed[k])] + source.finish())
    expected = read_parts(SensorLoggerExport(), sensor_logger("android", without=("Location",)))
    assert same(found, expected) and not source.lost


def test_a_batch_that_never_comes_is_counted_and_the_rest_goes_on():
    source, pushed = SensorLoggerPush(), batches()
    for k, batch in enumerate(pushed):
        if k != 4:
            source.feed(batch)
    source.feed(pushed[4])
    assert source.lost["batches that did not come"] == 1
    assert source.lost["batches that came twice, or after those that had waited for them"] == 1
