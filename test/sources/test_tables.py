"""Tables: units, axes and times as described, and first descriptions that say what they guess."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from benchmarks.data import data_path
from imu_fusion import cli
from imu_fusion.errors import ImuFusionError, ParameterError
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.convert import convert
from imu_fusion.recordings.logs import read_log
from imu_fusion.sources.description import Description
from imu_fusion.sources.sketch import sketch
from imu_fusion.sources.source import EPOCH
from imu_fusion.sources.table import TableSource
from test.sources.logs import read

G = 9.80665


def table(text, description, strict=True):
    source = TableSource(Description.from_mapping(yaml.safe_load(description), "d.yaml"), strict)
    return read(source, text.encode(), "t.csv")


def test_units_counts_axes_and_frames():
    found = table(
        "n;ax;ay;az;gx;gy;gz;mx;my;mz;la;lo;h;vn;ve;vd;q1;q2;q3;q4\n"
        "1000;0;-2048;1024;90;0;0;0,5;0;0;475000000;85000000;400000;1000;2000;-500;0;0;0;1\n"
        "1001;0;0;2048;0;0;90;0,5;0;0;475000000;85000000;400000;0;0;0;0;0;1;0\n",
        """{delimiter: ";", decimal: ",", time: {column: n, unit: tick, tick: 0.002, start: 5.0},
            accelerometer: {columns: [ax, ay, az], unit: g, scale: 2048,
                            rotation: [0, 1, 0, -1, 0, 0, 0, 0, 1]},
            gyroscope: {columns: [gx, gy, gz], unit: deg/s},
            magnetometer: {columns: [mx, my, mz], unit: G},
            position: {columns: [la, lo, h], unit: 1e-7 deg, height_unit: mm},
            velocity: {columns: [vn, ve, vd], unit: mm/s, frame: ned},
            reference: {columns: [q1, q2, q3, q4]}}""")
    imu = found["imu/data_raw"]
    assert list(imu.stamp) == [7_000_000_000, 7_002_000_000]
    assert imu.acc == pytest.approx(np.array([[-G, 0, G / 2], [0, 0, G]]))
    assert imu.gyr == pytest.approx(np.array([[np.pi / 2, 0, 0], [0, 0, np.pi / 2]]))
    assert found["imu/mag"].mag[0] == pytest.approx([50e-6, 0, 0])
    fix = found["fix"]
    assert (fix.latitude_deg[0], fix.longitude_deg[0], fix.height[0]) == pytest.approx(
        (47.5, 8.5, 400.0))
    assert not fix.cov_enu.any()    # unknown
    assert found["fix_velocity"].vel_world[0] == pytest.approx([2.0, 1.0, 0.5])
    assert found["reference/pose"].quat_world_imu[1] == pytest.approx([0, 0, 1, 0])


@pytest.mark.parametrize("time, cells, expected", [
    ("{column: t, unit: us, wrap: 65536}", ["65530", "65535", "4"], [65530_000, 65535_000,
                                                                      65540_000]),
    ("{column: t, unit: iso8601}", ["1970-01-01T00:00:01.000000001Z", "1970/01/01 00:00:02,5",
                                    "1970-01-01T01:00:03+01:00"],
     [1_000_000_001, 2_500_000_000, 3_000_000_000]),
    ("{column: t, unit: iso8601, wrap: 86400}", ["23:59:58:250", "23:59:59.5", "0:00:00"],
     [86398_250_000_000, 86399_500_000_000, 86400_000_000_000]),
    ("{column: t, unit: ms, week: w}", ["0", "500", "1000"],
     [(315_964_800 + 7 * 86400 * 2200 - 18) * 10**9 + ms * 10**6 for ms in (0, 500, 1000)]),
    ("{rate: 400.0}", ["", "", ""], [0, 2_500_000, 5_000_000])])
def test_times(time, cells, expected):
    text = "t|w|x|y|z\n" + "".join(f"{cell}|2200|0|0|1\n" for cell in cells)
    found = table(text, f"""{{delimiter: "|", time: {time},
                  accelerometer: {{columns: [x, y, z], unit: g}}}}""")
    assert list(found["imu/data_raw"].stamp) == expected


def test_a_stream_loses_its_broken_lines_and_finds_its_header():
    source = TableSource(Description.from_mapping(yaml.safe_load(
        "{time: {column: t}, accelerometer: {columns: [x, y, z]}}"), "d.yaml"), strict=False)
    found = read(source, b"9.81\n.5,0,0\nt,x,y,z\n1,0,0,9\nnoise\n2,0,zero,9\n3,0,0,9\nt,x,y,z\n"
                         b"4,0,0,9\n")
    assert list(found["imu/data_raw"].stamp) == [10**9, 3 * 10**9, 4 * 10**9]
    assert sum(source.lost.values()) == 4


@pytest.mark.parametrize("description, words", [
    ("{time: {column: t}}", "names no sensors"),
    ("{time: {column: t}, accelerometer: {columns: [x, y]}}", "2 elements"),
    ("{time: {column: t}, accelerometer: {columns: [x, y, z], axis: 1}}", "'axis'"),
    ("{time: {column: t}, gyroscope: {columns: [x, y, z], rotation: [1, 0, 0, 0, 1, 0, 0, 1, 1]}}",
     "gyroscope: 'rotation' is not orthonormal"),
    ("{time: {column: t, unit: tick}, gyroscope: {columns: [x, y, z]}}", "time.tick"),
    ("{decimal: ',', time: {column: t}, gyroscope: {columns: [x, y, z]}}", "both delimiter and"),
    ("{time: {column: t}, velocity: {columns: [x, y]}}", "two columns"),
    ("{time: {column: t}, gyroscope: {columns: [x, y, z]}, parameters: {a: 1}}",
     "names no accelerometers")])
def test_a_wrong_description_is_named(description, words):
    with pytest.raises(ParameterError, match=words) as error:
        Description.from_mapping(yaml.safe_load(description), "d.yaml")
    assert "d.yaml" in str(error.value)


def numbers(seed, n=400):
    """Times in s, forces of a sensor that turns a little after it lay flat, rates, fields."""
    noise = np.random.default_rng(seed)
    t = np.arange(n) * 0.01
    angle = np.clip(t - 2.0, 0.0, None) * 0.5
    force = G * np.column_stack([np.sin(angle), 0 * t, np.cos(angle)])
    rate = np.column_stack([0 * t, np.where(t > 2.0, -0.5, 0.0), 0 * t])
    field = 48.0 * np.column_stack([np.cos(angle), 0 * t, -np.sin(angle)])
    return t, *(v + s * noise.normal(size=v.shape) for v, s in (
        (force, 0.02), (rate, 0.001), (field, 0.2)))


def written(header, *columns, delimiter=",", comma=False):
    rows = [delimiter.join(f"{v:.6f}".replace(".", "," if comma else ".") for v in row)
            for row in np.column_stack(columns)]
    return ("\n".join(([header] if header else []) + rows) + "\n").encode()


T, FORCE, RATE, MAG = numbers(1)


@pytest.mark.parametrize("data, unit, scale", [
    (written("time,acc_x,acc_y,acc_z", T, FORCE), "m/s^2", 1.0),
    (written("Timestamp;AccX;AccY;AccZ", T * 1e3, FORCE / G, delimiter=";", comma=True), "g", 1.0),
    (written("", T * 1e6, np.round(FORCE / G * 4096), RATE), "g", 4096.0),
    (written("t\tax\tay\taz", T, FORCE / G * 1e3, delimiter="\t"), "mg", 1.0)])
def test_what_is_guessed_is_marked_and_right(data, unit, scale):
    found = sketch(data, "t.csv")
    content = yaml.safe_load(found.to_yaml())
    assert not found.is_sure and "guess" in found.to_yaml()
    assert content["accelerometer"]["unit"] == unit
    assert content["accelerometer"].get("scale", 1.0) == scale
    source = TableSource(Description.from_mapping(content, "d"))
    imu = read(source, data, "t.csv")["imu/data_raw"]
    assert imu.acc[:100].mean(axis=0) == pytest.approx([0, 0, G], abs=0.05)
    assert np.median(np.diff(imu.stamp)) == pytest.approx(10_000_000)


@pytest.mark.parametrize("factor, whole, unit, scale", [
    (1.0, False, "rad/s", 1.0), (np.degrees(1.0), False, "deg/s", 1.0),
    (np.degrees(1.0) * 131.0, True, "deg/s", 131.0)])
@pytest.mark.parametrize("vector", ["acc", "mag"])
def test_the_unit_of_a_gyroscope_is_told_by_how_the_field_turns(factor, whole, unit, scale, vector):
    rate = RATE * factor
    names = ",".join(f"{vector}_{axis}" for axis in "xyz")
    found = sketch(written(f"time,{names},gyr_x,gyr_y,gyr_z", T, FORCE if vector == "acc" else MAG,
                           np.round(rate) if whole else rate), "t.csv")
    assert found.content["gyroscope"]["unit"] == unit
    assert found.content["gyroscope"].get("scale", 1.0) == pytest.approx(scale, rel=0.05)


def test_headers_of_some_loggers():
    xsens = sketch(b"// Update Rate: 100.0Hz\n// Firmware Version: 4.0.2\n" + written(
        "\t".join(["PacketCounter", "SampleTimeFine", *(f"{s}_{a}" for s in ("Acc", "Gyr", "Mag")
                                                       for a in "XYZ")]),
        np.arange(len(T)), 5000 + 1e4 * T, FORCE, RATE, MAG / 48.0, delimiter="\t"), "xsens.txt")
    assert xsens.content["time"]["tick"] == 1e-4 and xsens.content["skip_lines"] == 2
    assert xsens.content["gyroscope"]["unit"] == "rad/s"
    assert "fits no unit" in xsens.doubts["magnetometer"]
    euroc = sketch(written(
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
        "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]", 1.4e18 + 1e9 * T, RATE, FORCE),
                   "e")
    assert euroc.is_sure
    # Apple's sign: gravity points where it pulls. Nothing in the values tells it from a sensor
    # that lies on its face.
    apple = sketch(written(
        "time (s),accelerometerAccelerationX(G),accelerometerAccelerationY(G),"
        "accelerometerAccelerationZ(G),motionUserAccelerationX(G),motionUserAccelerationY(G),"
        "motionUserAccelerationZ(G)", T, -FORCE / G, 0 * FORCE), "a.csv")
    assert "is the sign wrong" in apple.doubts["accelerometer"]
    assert "motionUserAccelerationX(G)" in apple.unused


MICROS = (2 ** 32 - 2_000_000 + np.round(1e6 * T).astype(int)) % 2 ** 32


@pytest.mark.parametrize("data, begins", [
    # German, decimal comma, the degree sign of Windows, a line ahead of the names.
    ((b"Messung 4;;;\r\n" + written(
        "Zeit [ms];Beschl X [g];Beschl Y [g];Beschl Z [g];Dreh X [\xb0/s];Dreh Y [\xb0/s];"
        "Dreh Z [\xb0/s]", 1e3 * T, FORCE / G, np.degrees(RATE), delimiter=";", comma=True)
      .decode().encode("cp1252")), EPOCH),
    # A counter of 32 bits that begins anew, counts of a converter.
    (written("micros,ax,ay,az,gx,gy,gz", MICROS, np.round(FORCE / G * 8192),
             np.round(np.degrees(RATE) * 65.5)), EPOCH + 1000 * int(MICROS[0])),
    # Units in a line of their own, which also has brackets; each row ends with a delimiter.
    (b'"sep=\t"\n' + written("\t".join(
        ["S_Timestamp_Unix_CAL", *(f"S_{name}_{axis}_CAL" for name in ("Accel_WR", "Gyro")
                                   for axis in "XYZ")])
        + "\nms\tm/(s^2)\tm/(s^2)\tm/(s^2)\tdeg/s\tdeg/s\tdeg/s", 1.8e12 + 1e3 * T, FORCE,
        np.degrees(RATE), delimiter="\t").replace(b"\n", b"\t\n"), 1_800_000_000 * 10**9),
    # GPS week and the seconds in it; the line of units is shorter than the names.
    (written(" Week GPSTime AccX AccY AccZ GyroX GyroY GyroZ\n (sec) (m/s^2) (m/s^2) (m/s^2) "
             "(deg/s) (deg/s) (deg/s)", np.full(len(T), 2400), 3600 + T, FORCE, np.degrees(RATE),
             delimiter=" "), (315_964_800 + 2400 * 604_800 + 3600 - 18) * 10**9),
    # As AndroSensor writes it: its own form of a date is none, and its rows may be commented on.
    ("\n".join(["ACCELEROMETER X (m/s²)|ACCELEROMETER Y (m/s²)|ACCELEROMETER Z (m/s²)|GYROSCOPE X "
                "(rad/s)|GYROSCOPE Y (rad/s)|GYROSCOPE Z (rad/s)|Time since start in ms |YYYY-MO-DD"
                " HH-MI-SS_SSS", "# a mark"] + [
        "|".join([*(f"{v:.6f}" for v in row), f"{round(1e3 * t)}",
                  f"2026-03-04 10-00-{int(t):02d}_{round(1e3 * t) % 1000:03d}"])
        for t, *row in zip(T, *FORCE.T, *RATE.T)]).encode() + b"\n# the end\n", EPOCH),
    # Hours without a date; the force in g beside one without gravity.
    ("\n".join(["time,ax,ay,az,gFx,gFy,gFz,wx,wy,wz,"] + [
        f"10:00:{int(t):02d}:{round(1e3 * t) % 1000:03d},0.1,0,-0.1,"
        + ",".join(f"{v:.6f}" for v in row) + "," for t, *row in zip(
            T, *(FORCE / G).T, *RATE.T)]).encode() + b"\n", EPOCH + 36_000 * 10**9)],
    ids=["german", "counter", "units below", "gps week", "date that is none", "hours"])
def test_two_commands_suffice_for_strangers_logs(data, begins):
    description = Description.from_mapping(yaml.safe_load(sketch(data, "t.csv").to_yaml()), "d")
    source = TableSource(description)
    imu = read(source, data, "t.csv")["imu/data_raw"]
    assert imu.stamp == pytest.approx(begins + np.round(1e9 * T), abs=1e6)
    assert imu.acc == pytest.approx(FORCE, abs=0.01)
    assert imu.gyr == pytest.approx(RATE, abs=0.02)
    assert not source.remarks


def test_times_that_fall_back_are_said():
    text = "t,x,y,z\n65530,0,0,1\n65535,0,0,1\n4,0,0,1\n9,0,0,1\n3,0,0,1\n"
    source = TableSource(Description.from_mapping(yaml.safe_load(
        "{time: {column: t, unit: ms}, accelerometer: {columns: [x, y, z], unit: g}}"), "d.yaml"))
    read(source, text.encode(), "t.csv")
    (said,) = source.remarks
    assert "2 times fall back, the first in line 4 by 65.531 s" in said and "time.wrap" in said


def test_force_without_gravity_is_doubted():
    found = sketch(written("t (s),Acc X (m/s^2),Acc Y (m/s^2),Acc Z (m/s^2)", T,
                           FORCE - [0, 0, G]), "t.csv")
    assert "gravity is not in it" in found.doubts["accelerometer"]
    linear = sketch(written("t (s),Linear Acc X (g),Linear Acc Y (g),Linear Acc Z (g)", T,
                            FORCE / G), "t.csv")
    assert "accelerometer" not in linear.content


def run(*arguments):
    result = CliRunner().invoke(cli.cli, [str(a) for a in arguments], catch_exceptions=False)
    return result.exit_code, result.output


def test_a_table_that_tells_all_needs_one_command_and_another_one_two(tmp_path):
    sure = tmp_path / "sure.csv"
    sure.write_bytes(written(
        "Time (s),Gyroscope X (rad/s),Gyroscope Y (rad/s),Gyroscope Z (rad/s),Accelerometer X "
        "(m/s^2),Accelerometer Y (m/s^2),Accelerometer Z (m/s^2)", T, RATE, FORCE))
    code, output = run("convert", sure, tmp_path / "one")
    assert code == 0 and "400 of /imu/data_raw" in output
    assert "400 messages" in run("info", sure)[1]
    doubtful = tmp_path / "log.csv"
    doubtful.write_bytes(written("time,ax,ay,az,gx,gy,gz", T, FORCE / G, np.degrees(RATE)))
    code, output = run("convert", doubtful, tmp_path / "two")
    assert code == 1 and "imu_fusion describe" in output and not (tmp_path / "two").exists()
    code, output = run("describe", doubtful, "--out", tmp_path / "log.yaml")
    assert code == 0 and "guess" in (tmp_path / "log.yaml").read_text()
    assert run("describe", doubtful, "--out", tmp_path / "log.yaml")[0] == 1    # not replaced
    assert run("convert", doubtful, tmp_path / "two", "--description",
               tmp_path / "log.yaml")[0] == 0
    with open_bag(tmp_path / "one") as a, open_bag(tmp_path / "two") as b:
        one, two = read_log(a, "imu/data_raw"), read_log(b, "imu/data_raw")
    assert two.acc == pytest.approx(one.acc, abs=1e-4)
    assert two.gyr == pytest.approx(one.gyr, abs=1e-4)


def test_a_failed_convert_leaves_nothing_and_touches_nothing(tmp_path):
    source = tmp_path / "log.csv"
    source.write_text("t,x,y,z\n0,0,0,1\n1,0,0,one\n")
    (tmp_path / "log.yaml").write_text("{time: {column: t}, accelerometer: {columns: [x, y, z]}}")
    convert(data_path("xio/sensor_data.csv") if data_path("xio/sensor_data.csv").exists() else
            _sure(tmp_path / "other.csv"), tmp_path / "out")
    before = {f: f.read_bytes() for f in (tmp_path / "out").iterdir()}
    with pytest.raises(ImuFusionError, match=r"log\.csv, line 3, column 'z': 'one'"):
        convert(source, tmp_path / "out", tmp_path / "log.yaml", overwrite=True)
    with pytest.raises(ImuFusionError):
        convert(source, tmp_path / "new", tmp_path / "log.yaml")
    assert {f: f.read_bytes() for f in (tmp_path / "out").iterdir()} == before
    assert not [f for f in tmp_path.iterdir() if f.name.startswith((".", "new"))]


def _sure(path: Path) -> Path:
    path.write_bytes(written("Time (s),Accelerometer X (g),Accelerometer Y (g),Accelerometer Z (g)",
                             T, FORCE / G))
    return path


def test_a_px4_log_is_forward_left_up_and_its_estimate_agrees(tmp_path):
    source = data_path("px4_ulog/sample_log_small.ulg")
    if not source.exists():
        pytest.skip("px4_ulog is not at hand: set IMU_FUSION_DATA")
    with open_bag(source) as reader:
        logs = {topic: read_log(reader, topic) for topic in reader.topics}
    imu, pose, mag = (logs[t] for t in ("/imu/data_raw", "/onboard_ekf/pose", "/imu/mag"))
    from imu_fusion.geometry.rotation_arrays import rotation_matrices
    at = np.clip(np.searchsorted(pose.stamp, imu.stamp), 0, len(pose) - 1)
    up = rotation_matrices(pose.quat_world_imu[at])[:, 2, :]
    # The autopilot's own attitude turns the forces upwards.
    assert (up * imu.acc).sum(axis=1).mean() == pytest.approx(G, rel=0.05)
    norm = np.linalg.norm(mag.mag, axis=1)
    assert 20e-6 < np.median(norm) < 70e-6
    assert logs["/fix"].cov_enu[:, 0, 0].min() > 0


def test_as_many_rows_of_one_width_as_of_another():
    """Found by benchmarks/fuzz.py."""
    assert sketch(b"1,2\n" * 3 + b"1,2,3,4\n" * 3, "t.csv").unused == ["1", "2"]
