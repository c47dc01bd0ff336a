"""Exports of phyphox and AvaNode become recordings; what they do not tell is not made up."""

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks.data import data_path
from imu_fusion import batch, cli
from imu_fusion.messages.convert import attitude_log
from imu_fusion.messages.layouts import ODOMETRY
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.sources.source import EPOCH

LOCATION = ('"Time (s)","Latitude (°)","Longitude (°)","Height (m)","Velocity (m/s)",'
            '"Direction (°)","Horizontal Accuracy (m)","Vertical Accuracy (°)"\n')
AVANODE_GNSS = ("#microcontroller time [micro seconds],iTow[ms],utc[year:month:day:hour:minute:"
                "second],fixType[0-5],longitude[deg],latitude[deg],height[mm],velN[mm/s],"
                "velE[mm/s],velD[mm/s],height[m]\n")
AVANODE_IMU = ("#C03LData001.txt#\n#Device is a Leader\n#Data contains time in (mus) acceleration "
               "acc[xyz] in (LSB/g), rotation rates gyro[xyz](deg/s),flux densities mag[xyz] in "
               "(muT)#\n#first row contains Date, factor acc[xyz],factor gyro[xyz], factor "
               "mag[xyz], sync signal (micro s),SensorId#\n#,2048,16.40,5,28440908,2#\n")


def phone(folder, **files):
    """A phone's export: the x axis of the force rises by 1 m/s^2 in 10 ms, the rest is constant."""
    folder.mkdir()
    texts = {"Accelerometer": '"Time (s)","X (m/s^2)","Y (m/s^2)","Z (m/s^2)"\n'
             + "".join(f"{0.01 * k:.9E},{k},-2E0,9.81\n" for k in range(1, 6)),
             "Gyroscope": '"Time (s)","X (rad/s)","Y (rad/s)","Z (rad/s)"\n'
             + "".join(f"{0.01 * k + 0.005:.9E},{k},0.2,-0.3\n" for k in range(0, 6)),
             "Magnetometer": '"Time (s)","X (µT)","Y (µT)","Z (µT)"\n0.02,20,-3.5,-40\n'} | files
    for name, text in texts.items():
        (folder / f"{name}.csv").write_text(text, encoding="utf-8")
    return folder


def convert(source, out):
    """Exit code, and the one line of an error."""
    result = CliRunner().invoke(cli.cli, ["convert", str(source), str(out)],
                                catch_exceptions=False)
    return result.exit_code, result.output.strip().splitlines()[-1]


def logs(source, out):
    assert convert(source, out)[0] == 0
    with open_bag(out) as reader:
        return {topic: read_log(reader, topic) for topic in reader.topics}


def test_a_phone_s_force_is_brought_to_the_times_of_its_gyroscope(tmp_path):
    found = logs(phone(tmp_path / "walk"), tmp_path / "out")
    assert set(found) == {"/imu/data_raw", "/imu/mag"}
    # 5 ms lies before the first sample of the force, 55 ms after its last: both are left out.
    imu = found["/imu/data_raw"]
    assert list(imu.stamp - EPOCH) == [15_000_000, 25_000_000, 35_000_000, 45_000_000]
    assert imu.gyr == pytest.approx(np.array([[k, 0.2, -0.3] for k in (1, 2, 3, 4)]))
    assert imu.acc == pytest.approx(np.array([[k, -2.0, 9.81] for k in (1.5, 2.5, 3.5, 4.5)]))
    assert found["/imu/mag"].mag == pytest.approx(np.array([[2e-5, -3.5e-6, -4e-5]]), abs=1e-15)


def test_a_gap_of_the_accelerometer_is_not_bridged(tmp_path):
    times = [0.01, 0.02, 0.03, 0.04, 0.14]
    text = ('"Time (s)","X (m/s^2)","Y (m/s^2)","Z (m/s^2)"\n'
            + "".join(f"{t},0,0,9.81\n" for t in times))
    gyr = ('"Time (s)","X (rad/s)","Y (rad/s)","Z (rad/s)"\n'
           + "".join(f"{t},0,0,0\n" for t in (0.015, 0.035, 0.09)))
    found = logs(phone(tmp_path / "walk", Accelerometer=text, Gyroscope=gyr), tmp_path / "out")
    assert list(found["/imu/data_raw"].stamp - EPOCH) == [15_000_000, 35_000_000]


def test_a_phone_s_accuracies_become_covariances_and_invalid_ones_no_fix(tmp_path):
    rows = ("1,43.5,1.4,157,-1,-1,500,300\n"     # no speed
            "2,43.5,1.4,157,0.5,-1,35,-1\n"      # height not valid; speed without direction
            "3,43.5,1.4,157,2,90,-1,10\n"        # position not valid; 2 m/s eastward
            "4,,,,2,180,5,10\n")                 # no position; 2 m/s southward
    found = logs(phone(tmp_path / "walk", Location=LOCATION + rows), tmp_path / "out")
    fix, velocity = found["/fix"], found["/fix_velocity"]
    assert list(fix.status) == [0, -1, -1]
    assert np.diag(fix.cov_enu[0]) == pytest.approx([500.0 ** 2, 500.0 ** 2, 300.0 ** 2])
    assert (fix.latitude_deg[0], fix.longitude_deg[0], fix.height[0]) == (43.5, 1.4, 157.0)
    assert list(velocity.stamp - EPOCH) == [3_000_000_000, 4_000_000_000]
    assert velocity.vel_world == pytest.approx(np.array([[2.0, 0, 0], [0, -2.0, 0]]), abs=1e-12)
    # The vertical speed is not exported: its standard deviation says that nothing is known.
    assert np.sqrt(velocity.cov_world[0, 2, 2]) >= 50.0


def test_avanode_counts_become_units_and_a_repeated_field_is_no_reading(tmp_path):
    source = tmp_path / "C03.txt"
    source.write_text(AVANODE_IMU
                      + "4294967000,2048,0,-1024,164,0,-16,100,-50,0,1\n"
                      + "4294967200,0,0,2048,0,0,0,100,-50,0,1\n"
                      + "104,0,0,2048,0,0,0,105,-50,0,1\n"  # the 32 bit counter began anew
                      + "#Closed reed switch for more than 2 seconds: Exit Loop\n")
    found = logs(source, tmp_path / "out")
    imu, mag = found["/imu/data_raw"], found["/imu/mag"]
    assert list(imu.stamp - EPOCH) == [4294967000_000, 4294967200_000, 4294967400_000]
    assert imu.acc[0] == pytest.approx([9.80665, 0.0, -9.80665 / 2])
    assert imu.gyr[0] == pytest.approx(np.radians([10.0, 0.0, -16 / 16.4]))
    assert list(mag.stamp - EPOCH) == [4294967000_000, 4294967400_000]
    assert mag.mag == pytest.approx(np.array([[20e-6, -10e-6, 0], [21e-6, -10e-6, 0]]))


def test_avanode_gnss_is_utc_metres_and_east_north_up(tmp_path):
    source = tmp_path / "C07.txt"
    source.write_text(AVANODE_GNSS
                      + "1,201115700,0:0:0:0:0:0,0,0,0,0,0,0,0,0\n"  # no date, no fix
                      + "2,201115800,2022:2:22:7:51:37,2,11.38,47.31,0,1,2,3,0\n"  # no height
                      + "3,201115900,2022:2:22:7:51:37,3,11.3832481,47.3119640,2321428,"
                        "35,29,27,0\n")
    found = logs(source, tmp_path / "out")
    fix, velocity = found["/fix"], found["/fix_velocity"]
    # date -u -d '2022-02-22 07:51:37' +%s
    assert list(fix.stamp) == [1645516297_800_000_000, 1645516297_900_000_000]
    assert list(fix.status) == [-1, 0]
    assert (fix.latitude_deg[1], fix.longitude_deg[1]) == (47.3119640, 11.3832481)
    assert fix.height[1] == pytest.approx(2321.428)
    assert not fix.cov_enu.any()  # unknown
    assert velocity.vel_world == pytest.approx(np.array([[0.029, 0.035, -0.027]]))


GYROSCOPE = '"Time (s)","X (rad/s)","Y (rad/s)","Z (rad/s)"\n'


@pytest.mark.parametrize("files, words", [
    ({"Gyroscope": GYROSCOPE.replace("rad/s", "°/s") + "0.02,0,0,0\n"},
     "Gyroscope.csv: column 'X' is in '°/s', expected rad/s"),
    ({"Gyroscope": GYROSCOPE + "0.02,0,0,0\n0.03,0,zero,0\n"},
     "Gyroscope.csv, line 3, column 'Y': 'zero' is not a number"),
    ({"Gyroscope": GYROSCOPE + "0.02,0,0\n"}, "Gyroscope.csv, line 2: 3 cells, column 'Z'"),
    ({"Gyroscope": GYROSCOPE + ",0,0,0\n"}, "Gyroscope.csv, line 2, column 'Time'"),
    ({"Gyroscope": GYROSCOPE}, "Gyroscope.csv: no rows"),
    ({"Gyroscope": GYROSCOPE.replace(",", "|") + "0.02|0|0|0\n"}, "Gyroscope.csv: no column"),
    ({"Gyroscope": GYROSCOPE + "9,0,0,0\n"}, "no time in common"),
    ({"Accelerometer": GYROSCOPE.replace("rad/s", "m/s^2") + "1,0,0,9\n2,0,0,9\n2,0,0,9\n"},
     "Accelerometer.csv, line 3: no later time follows"),
    ({"Location": LOCATION + "1,4300.5,1.4,157,-1,-1,500,300\n"},
     "Location.csv, line 2: latitude 4300.5"),
])
def test_errors_of_an_export_name_file_line_and_column(tmp_path, files, words):
    code, line = convert(phone(tmp_path / "walk", **files), tmp_path / "out")
    assert code == 1 and words in line, line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("text, words", [
    (AVANODE_IMU + "28499269,61,71\n", "line 6: 3 cells, column 'acc z' is missing"),
    (AVANODE_IMU.replace("2048", "0") + "1,1,1,1,1,1,1,1,1,1,1\n", "line 5: factors"),
    (AVANODE_IMU.rsplit("#,", 1)[0] + "1,1,1,1,1,1,1,1,1,1,1\n", "no line '#date,factor acc"),
    (AVANODE_GNSS + "2,1,2022:13:22:7:51:37,3,11.38,47.31,0,1,2,3,0\n",
     "line 2, column 'utc': '2022:13:22:7:51:37'"),
    (AVANODE_GNSS + f"2,1,{9 * 10**30}:1:22:7:51:37,3,11.38,47.31,0,1,2,3,0\n",
     "is not a date"),
    (AVANODE_GNSS.replace("height[mm]", "h[mm]") + "2,1,2022:1:22:7:51:37,3,1,4,0,1,2,3,0\n",
     "column 'height' is in 'm', expected mm"),
])
def test_errors_of_a_log_name_file_line_and_column(tmp_path, text, words):
    (tmp_path / "log.txt").write_text(text)
    code, line = convert(tmp_path / "log.txt", tmp_path / "out")
    assert code == 1 and words in line and "log.txt" in line, line


def test_other_text_and_folders_are_refused_as_before(tmp_path):
    (tmp_path / "README.txt").write_text("Hello\n")
    assert "not a recording" in convert(tmp_path / "README.txt", tmp_path / "out")[1]
    (tmp_path / "folder").mkdir()
    assert "not a recording" in convert(tmp_path / "folder", tmp_path / "out")[1]


def at_hand(name):
    path = data_path(name)
    if not path.exists():
        pytest.skip(f"{name} is not at hand: set IMU_FUSION_DATA")
    return path


def test_an_avalanche_log_agrees_with_itself(tmp_path):
    """Positions that are differenced give the logged velocities: units, order and signs."""
    found = logs(at_hand("avanode/220222_C07_avalanche_GPS.txt"), tmp_path / "out")
    fix, velocity = found["/fix"], found["/fix_velocity"]
    assert (np.diff(fix.stamp) == 100_000_000).all()
    north = np.radians(fix.latitude_deg - fix.latitude_deg[0]) * 6.37e6
    east = (np.radians(fix.longitude_deg - fix.longitude_deg[0]) * 6.39e6
            * np.cos(np.radians(fix.latitude_deg)))
    moved = np.column_stack([east, north, fix.height])[-1] - [0.0, 0.0, fix.height[0]]
    ran = velocity.vel_world.sum(axis=0) * 0.1
    # 300 m down an avalanche; the receiver's two solutions part by 25 m on it. A component that is
    # swapped, turned round or in other units would be 100 m off.
    assert ran == pytest.approx(moved, abs=35.0)
    assert np.linalg.norm(moved) > 200.0


def test_a_pure_imu_log_gives_orientation_and_says_why_no_trajectory(tmp_path):
    source = at_hand("avanode/C03LData001.txt")
    assert convert(source, tmp_path / "bag")[0] == 0
    reports, _ = batch.process(tmp_path / "bag", tmp_path / "out")
    skipped = {report.node: report.skipped for report in reports}
    assert "no messages on 'fix'" in skipped["smoother"]
    with open_bag(tmp_path / "out") as reader:
        assert not [topic for topic in reader.topics if "smoother" in topic]
        log = read_log(reader, "/imu/data", attitude_log)
    assert len(log) == 5561
    # It lies still, z up within 3 degrees: 2120 counts of 2048 per g on z, 68 and 69 beside.
    tilt = 2 * np.hypot(log.quat_world_imu[:, 0], log.quat_world_imu[:, 1])
    assert np.degrees(np.median(tilt)) < 5.0


def test_a_log_with_a_wrong_factor_is_told_by_gravity(tmp_path):
    """C03F lies still, but its header makes 1.9 g of that."""
    source = at_hand("avanode/C03FData001.txt")
    assert convert(source, tmp_path / "bag")[0] == 0
    result = CliRunner().invoke(cli.cli, ["info", str(tmp_path / "bag")])
    assert "far from gravity" in result.output


@pytest.mark.slow
def test_an_indoor_walk_claims_no_better_position_than_its_fixes(tmp_path):
    """Accuracies of 22 to 670 m that wander, as docs/smoother.md says to declare them."""
    assert convert(at_hand("phone_walk"), tmp_path / "bag")[0] == 0
    (tmp_path / "phone.yaml").write_text(
        "smoother: {ros__parameters: {gnss.position_error_sd: [22.0, 22.0, 22.0], "
        "gnss.position_error_tau: 60.0}}\n")
    reports, _ = batch.process(tmp_path / "bag", tmp_path / "out", tmp_path / "phone.yaml",
                               without=["orientation_estimator"])
    (report,) = [r for r in reports if r.node == "smoother"]
    assert not report.skipped
    with open_bag(tmp_path / "out") as reader:
        values = np.array([ODOMETRY.decode(message[3])[2]
                           for message in reader.messages(["/smoother/odometry"])])
    cov = values[:, ODOMETRY["pose_covariance"]].reshape(-1, 6, 6)
    sd = np.sqrt(np.diagonal(cov, axis1=1, axis2=2)[:, :2])
    # Errors that wander do not average out: the best stretch is worth about the best fix.
    assert sd.min() > 15.0 and sd.max() < 700.0
