"""Each format against what its documentation, or an independent writer, says."""

import re
import struct

import numpy as np
import pytest
from pyubx2 import GET, UBXMessage

from imu_fusion.errors import ImuFusionError
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.sources.gnss import Receiver
from imu_fusion.sources.source import EPOCH
from imu_fusion.sources.ulog import Ulog
from imu_fusion.sources.ximu3 import Ximu3, Ximu3Csv
from test.sources.exports import export, sensor_logger, zipped
from test.sources.logs import read, read_parts, same, ulog
from test.sources.test_splitting import escaped, nmea, solution


def test_a_solution_of_a_u_blox_is_utc_degrees_and_east_north_up():
    message = UBXMessage(
        "NAV", "NAV-PVT", GET, year=2022, month=2, day=22, hour=7, min=51, second=37,
        nano=-100_000_000, validDate=1, validTime=1, fixType=3, gnssFixOk=1, lat=47.3119640,
        lon=11.3832481, height=2_321_428, hAcc=1500, vAcc=2500, velN=35, velE=29, velD=27, sAcc=400)
    found = read(Receiver(), message.serialize())
    fix, velocity = found["fix"], found["fix_velocity"]
    assert fix.stamp[0] == 1645516297_000_000_000 - 100_000_000    # date -u -d ... +%s
    assert (fix.latitude_deg[0], fix.longitude_deg[0]) == pytest.approx((47.3119640, 11.3832481))
    assert fix.height[0] == pytest.approx(2321.428) and fix.status[0] == 0
    assert np.diag(fix.cov_enu[0]) == pytest.approx([1.5**2, 1.5**2, 2.5**2])
    assert velocity.vel_world[0] == pytest.approx([0.029, 0.035, -0.027])
    assert np.diag(velocity.cov_world[0]) == pytest.approx([0.16] * 3)


def test_a_u_blox_without_fix_says_so_and_has_no_velocity():
    message = UBXMessage("NAV", "NAV-PVT", GET, year=2022, month=2, day=22, validDate=1,
                         validTime=1, fixType=2, gnssFixOk=1)
    found = read(Receiver(), message.serialize())
    assert list(found["fix"].status) == [-1] and "fix_velocity" not in found


def test_nmea_is_ellipsoidal_and_its_accuracies_come_from_gst():
    data = (nmea("GPRMC,083600.50,A,4717.11437,N,00833.91522,W,10.0,90.0,091202,,,A")
            + nmea("GPGGA,083600.50,4717.11437,N,00833.91522,W,1,08,1.01,499.6,M,48.0,M,,")
            + nmea("GPGST,083600.50,,,,,2.0,3.0,4.0"))
    found = read(Receiver(), data)
    fix, velocity = found["fix"], found["fix_velocity"]
    assert fix.stamp[0] == 1039422960_500_000_000    # 2002-12-09 08:36:00.5 UTC
    assert fix.latitude_deg[0] == pytest.approx(47 + 17.11437 / 60)
    assert fix.longitude_deg[0] == pytest.approx(-(8 + 33.91522 / 60))
    assert fix.height[0] == pytest.approx(547.6)
    assert np.diag(fix.cov_enu[0]) == pytest.approx([9.0, 4.0, 16.0])    # east, north, up
    assert velocity.vel_world[0] == pytest.approx([10 * 1852 / 3600, 0.0, 0.0], abs=1e-9)
    assert velocity.cov_world[0, 2, 2] > 50**2    # nothing is known of the vertical


# Types of ESF-MEAS and ESF-RAW, and what they measure: gyroscope x, y, z in 2^-12 deg/s,
# accelerometer x, y, z in 2^-10 m/s^2, temperature.
AXES = [kind << 24 | value * 1024 & 0xFFFFFF for kind, value in (
    (14, 3), (13, 2), (5, 1), (16, -4), (17, 5), (18, 6), (12, 2500))]


def test_measurements_of_a_u_blox_are_put_together_by_their_time():
    def frame(tag, words):
        return UBXMessage(0x10, 0x02, GET, payload=struct.pack(
            f"<IHH{len(words)}I", tag, len(words) << 11, 0, *words)).serialize()

    source = Receiver()
    imu = read(source, frame(100, AXES[:6]) + frame(110, AXES[:3]) + frame(110, AXES[3:])
               + frame(120, AXES[:3]) + frame(130, AXES[3:]))["imu/data_raw"]
    assert list(imu.stamp - EPOCH) == [100_000_000, 110_000_000] and not source.lost
    assert imu.gyr[1] == pytest.approx(np.radians([0.75, 0.5, 0.25]))
    assert imu.acc[1] == pytest.approx([-4.0, 5.0, 6.0])


def test_raw_readings_of_a_u_blox_keep_the_time_of_the_chip():
    """Two samples a frame, of which the tags of 24 bits begin anew."""
    def frame(ms, tags):
        words = [ms, *(part for tag in tags for word in AXES for part in (word, tag))]
        return UBXMessage(0x10, 0x03, GET, payload=struct.pack(f"<{len(words)}I", *words)
                          ).serialize()

    ticks = [2**24 - 300, 2**24 - 44, 212, 468]    # 10 ms
    source = Receiver()
    imu = read(source, frame(5000, ticks[:2]) + frame(5020, ticks[2:]))["imu/data_raw"]
    assert list(imu.stamp - EPOCH) == [5_000_000_000 + 10_000_000 * k for k in range(4)]
    assert imu.gyr[3] == pytest.approx(np.radians([0.75, 0.5, 0.25]))
    assert imu.acc[3] == pytest.approx([-4.0, 5.0, 6.0]) and not source.lost
    # A quarter of an hour later: the receiver's milliseconds tell how often the tags turned.
    later = read(source, frame(900_000, [1000, 1256]))["imu/data_raw"]
    assert list(later.stamp - EPOCH) == [900_000_000_000, 900_010_000_000]


def gga(at):
    return nmea(f"GPGGA,{at},4717.1,N,00833.9,E,1,08,1.0,499.6,M,48.0,M,,")


def test_nmea_waits_for_its_date_in_a_file_and_passes_midnight():
    rmc = "GPRMC,{},A,4717.1,N,00833.9,E,1.0,90.0,{},,,A"
    data = (gga("235959.00") + gga("000000.00") + nmea(rmc.format("000001.00", "010125"))
            + gga("000001.00") + gga("235959.50") + gga("000000.50"))
    midnight = 1735689600    # 2025-01-01
    expected = [midnight - 1, midnight, midnight + 1, midnight + 86399.5, midnight + 86400.5]
    source = Receiver()
    assert list(read(source, data)["fix"].stamp / 1e9) == expected and not source.lost
    live = Receiver(strict=False)
    assert list(read(live, data)["fix"].stamp / 1e9) == expected[2:]
    assert sum(live.lost.values()) == 2


def test_sentences_without_checksums_are_known_and_told(tmp_path):
    (tmp_path / "log.txt").write_bytes(re.sub(rb"\*..", b"", gga("120000.00") + gga("120001.00")))
    with pytest.raises(ImuFusionError, match="2 sentences of NMEA whose checksum is wrong"):
        open_bag(tmp_path / "log.txt")


def test_nmea_without_any_date_is_of_some_day_and_says_so():
    source = Receiver()
    fix = read(source, gga("120000.00") + gga("120001.00"))["fix"]
    assert list(np.diff(fix.stamp)) == [10**9]
    assert (fix.stamp[0] // 10**9 - 43_200) % 86_400 == 0 and "told no date" in source.remarks[-1]


def test_nmea_beside_ubx_adds_nothing_twice():
    data = solution(1) + nmea("GPGGA,050601.00,4717.1,N,00833.9,E,1,08,1.0,499.6,M,48.0,M,,"
                              ) + solution(2)
    assert len(read(Receiver(), data)["fix"]) == 2


def test_x_imu3_binary_and_text_say_the_same():
    values = 1.5, -2.5, 90.0, 0.0, 0.5, 1.0
    us = 0x0A0ADBDB    # bytes that are escaped
    binary = read(Ximu3(), escaped(struct.pack("<BQ6f", 0xC9, us, *values)))
    text = read(Ximu3(), b"I,%d,1.5,-2.5,90,0,.5,1\r\n" % us)
    assert same(binary, text)
    imu = binary["imu/data_raw"]
    assert imu.stamp[0] == EPOCH + 1000 * us
    assert imu.gyr[0] == pytest.approx(np.radians([1.5, -2.5, 90.0]))
    assert imu.acc[0] == pytest.approx([0.0, 4.903325, 9.80665])


INERTIAL = (b"Timestamp (us),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),"
            b"Accelerometer X (g),Accelerometer Y (g),Accelerometer Z (g)\n"
            + b"".join(b"%d,1.5,-2.5,90,0,0.5,1\n" % (10_000 * k) for k in range(9)))
HIGH_G = b"Timestamp (us),X (g),Y (g),Z (g)\n10,0,0,1\n20,0,0,1\n"


def test_a_session_of_an_x_imu3_is_the_same_as_csv():
    """The files are those that x-io's own converter (ximu3.FileConverter) makes."""
    mag = b"Timestamp (us),X (a.u.),Y (a.u.),Z (a.u.)\n" + b"".join(
        b"%d,0.5,0,-1\n" % (20_000 * k) for k in range(4))
    messages = b"".join([*(b"I,%d,1.5,-2.5,90,0,0.5,1\r\n" % (10_000 * k) for k in range(9)),
                         *(b"M,%d,0.5,0,-1\r\n" % (20_000 * k) for k in range(4))])
    source = Ximu3Csv()
    found = read_parts(source, {"s/Inertial.csv": INERTIAL, "s/Magnetometer.csv": mag,
                                "s/HighGAccelerometer.csv": HIGH_G})
    expected = read(Ximu3(), messages)
    assert set(found) == set(expected) and any("50 uT" in text for text in source.remarks)
    for topic, log in expected.items():
        assert list(found[topic].stamp) == list(log.stamp)
        assert found[topic].flat() == pytest.approx(log.flat(), rel=1e-12)


@pytest.mark.parametrize("name, files, taken", [
    ("walk.zip", {"walk.zip": zipped(export())}, "phyphox"),
    ("log.zip", {"log.zip": zipped(sensor_logger())}, "Sensor Logger"),
    ("log", sensor_logger(), "Sensor Logger"), ("walk", export(), "phyphox"),
    ("a.bin", {"a.bin": solution(1) + solution(2) + solution(3)}, "u-blox"),
    ("session", {"session/Inertial.csv": INERTIAL, "session/HighGAccelerometer.csv": HIGH_G},
     "x-IMU3"),
    ("a.log", {"a.log": b"".join(b"I,%d,0,0,0,0,0,1\r\n" % k for k in range(9))}, "x-IMU3")])
def test_formats_are_recognised_by_content(tmp_path, name, files, taken):
    for part, data in files.items():
        (tmp_path / part).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / part).write_bytes(data)
    with open_bag(tmp_path / name) as reader:
        assert taken in reader.format and reader.count == sum(1 for _ in reader.messages())
        logs = {topic: read_log(reader, topic) for topic in reader.topics}
    assert all((np.diff(log.stamp) >= 0).all() for log in logs.values())


def test_a_ulog_that_is_cut_ends(tmp_path):
    """In its definitions pyulog would step back for ever."""
    header = b"ULog\x01\x12\x35\x01" + bytes(8)
    (tmp_path / "cut.ulg").write_bytes(header + b"\xff\xff\x00" + bytes(300))
    with pytest.raises(ImuFusionError, match=r"cut\.ulg"):
        open_bag(tmp_path / "cut.ulg")


def test_a_ulog_without_a_field_says_which_and_keeps_the_rest(tmp_path):
    broken = ulog().replace(b"float[3] gyro_rad;", b"float[3] gyro_rat;")
    (tmp_path / "log.ulg").write_bytes(broken)
    with open_bag(tmp_path / "log.ulg") as reader:
        assert set(reader.topics) == {"/fix", "/fix_velocity"}
        assert any("there is no 'gyro_rad[0]'" in text for text in reader.losses)
    (tmp_path / "log.ulg").write_bytes(broken.replace(b"float eph;", b"float eps;"))
    with pytest.raises(ImuFusionError, match=r"log\.ulg: .*'gyro_rad\[0\]'.*'eph'"):
        open_bag(tmp_path / "log.ulg")


def test_a_ulog_of_single_sensors_is_an_imu_too():
    combined, apart = (read(Ulog(), ulog(apart), "log.ulg") for apart in (False, True))
    imu = apart["imu/data_raw"]
    # The last rate has no force after it.
    assert set(combined) == set(apart) and len(imu) == len(combined["imu/data_raw"]) > 190
    assert list(imu.stamp) == list(combined["imu/data_raw"].stamp)
    assert imu.gyr[7] == pytest.approx([0.1, 0.0, -0.2]) and imu.acc[7] == pytest.approx(
        [0.0, 0.0, 9.81])


def test_samples_whose_stamps_no_message_can_hold_are_left_out_and_counted(tmp_path):
    """builtin_interfaces/Time ends in 2038."""
    point = '<trkpt lat="47.0" lon="8.5"><ele>400</ele><time>%s-01-02T03:04:0%dZ</time></trkpt>'
    years = ["2026", "2026", "2039", "1969", "2261"]
    (tmp_path / "track.gpx").write_text("<gpx><trk><trkseg>" + "".join(
        point % (year, k) for k, year in enumerate(years)) + "</trkseg></trk></gpx>")
    with open_bag(tmp_path / "track.gpx") as reader:
        assert len(read_log(reader, "fix")) == 2 and reader.damaged
        assert "3 samples stamped before 1970 or after 2038" in reader.warnings[0]


def test_an_archive_that_unpacks_without_end_is_refused(tmp_path):
    (tmp_path / "bomb.zip").write_bytes(zipped({
        "Accelerometer.csv": b'"Time (s)","X (m/s^2)"\n' + b"0" * (1 << 26)}))
    with pytest.raises(ImuFusionError, match="unpacks to more than"):
        open_bag(tmp_path / "bomb.zip")
    (tmp_path / "cut.zip").write_bytes(zipped(export())[:300] + b"PK\5\6" + bytes(18))
    with pytest.raises(ImuFusionError, match=r"cut\.zip"):
        open_bag(tmp_path / "cut.zip")
