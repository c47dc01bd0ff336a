"""The recordings in bags/: as described, readable by foreign tools, in SI units and our frames."""

import hashlib
import importlib
import json
import os
import struct
import sys
from pathlib import Path

import mcap.reader
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from imu_fusion.evaluation.orientation_error import moving_at
from imu_fusion.messages.convert import string_value
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log

ROOT = Path(__file__).resolve().parent.parent
BAGS = ROOT / "bags"
MANIFEST = json.loads((BAGS / "manifest.json").read_text())
REAL = sorted(name for name in MANIFEST if "simulated" not in name)
BROAD = sorted(name for name in MANIFEST if name.startswith("broad_"))
SOURCE = Path(os.environ.get("IMU_FUSION_DATA", ROOT.parent / "shared" / "data"))

sys.path.insert(0, str(BAGS))
make_bags = importlib.import_module("make_bags")
sys.path.remove(str(BAGS))


@pytest.mark.parametrize("name", MANIFEST)
def test_files_are_those_that_the_readme_describes(name):
    entry = MANIFEST[name]
    path = BAGS / name / entry["file"]
    assert hashlib.sha256(path.read_bytes()).hexdigest() == entry["sha256"]
    readme = (BAGS / "README.md").read_text()
    recording = make_bags.RECORDINGS[name]
    assert entry["sha256"] in readme and entry["content_sha256"] in readme
    assert recording.attribution in readme
    assert (BAGS / recording.licence_file).stat().st_size > 1000
    assert recording.licence_file in readme


def test_the_readme_holds_the_table_of_the_manifest_and_all_is_small():
    assert make_bags.tables(MANIFEST) in (BAGS / "README.md").read_text()
    assert set(MANIFEST) == set(make_bags.RECORDINGS)
    assert sum(p.stat().st_size for p in BAGS.rglob("*") if p.is_file()) < 30e6


def test_licences_are_those_of_the_sources():
    licence = {name: (BAGS / r.licence_file).read_text()
               for name, r in make_bags.RECORDINGS.items()}
    assert all("Attribution 4.0 International" in licence[name] for name in BROAD)
    assert "Paul Riseborough" in licence["px4_plane"]
    assert "rtklibexplorer" in licence["drive_0708"]
    assert "Carlsson" in licence["mimu4444"]


@pytest.mark.parametrize("name", MANIFEST)
def test_foreign_readers_find_the_same_messages(name):
    path = BAGS / name / MANIFEST[name]["file"]
    expected = {topic: info["count"] for topic, info in MANIFEST[name]["topics"].items()}
    with open(path, "rb") as stream:
        summary = mcap.reader.make_reader(stream).get_summary()
    counts = {summary.channels[i].topic: n
              for i, n in summary.statistics.channel_message_counts.items()}
    assert counts == expected
    store = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([path.parent], default_typestore=store) as reader:
        assert {topic: info.msgcount for topic, info in reader.topics.items()} == expected
        # One message of each type through the foreign decoder: header and values where we say.
        for connection in reader.connections:
            _, log_time, data = next(reader.messages([connection]))
            message = reader.deserialize(data, connection.msgtype)
            if connection.msgtype == "std_msgs/msg/Bool":
                assert isinstance(message.data, (bool, np.bool_))
                continue
            if connection.msgtype == "std_msgs/msg/String":
                truth = json.loads(message.data)
                if connection.topic == "/reference/jump":
                    assert truth["length"] > 80
                elif connection.topic == "/reference/impact":
                    assert 100 < truth["peak_linear_acceleration"] < 1000
                else:
                    assert [*truth] == list("123456") and sorted(truth.values()) == [
                        *truth.values()]
                continue
            stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            assert stamp == log_time
            if connection.msgtype == "sensor_msgs/msg/Imu":
                assert message.orientation_covariance[0] == -1
                assert message.header.frame_id == "imu_link"
                assert message.linear_acceleration_covariance[0] == 0


@pytest.fixture(scope="module")
def logs():
    cache = {}

    def load(name, topic):
        if (name, topic) not in cache:
            with open_bag(BAGS / name) as reader:
                cache[name, topic] = read_log(reader, topic)
        return cache[name, topic]
    return load


@pytest.mark.parametrize("name", REAL)
def test_units_are_si(logs, name):
    imu = logs(name, "imu/data_raw")
    assert np.all(np.diff(imu.stamp) > 0)
    # At its quietest second the specific force is gravity, whatever the scale errors of
    # consumer accelerometers: 2 %, and nothing turns faster than the noise and bias.
    window = int(1e9 / np.median(np.diff(imu.stamp)))
    norm = np.linalg.norm(imu.acc, axis=1)[: len(imu) // window * window].reshape(-1, window)
    quiet = np.argmin(norm.std(axis=1))
    assert norm[quiet].mean() == pytest.approx(9.81, rel=0.02)
    gyr = imu.gyr[quiet * window:(quiet + 1) * window]
    assert np.linalg.norm(gyr.mean(axis=0)) < np.radians(3)
    # rad/s; in degrees it would exceed this. The gyroscopes of mimu4444 clip at 34.9 rad/s.
    assert np.abs(imu.gyr).max() < 40
    if "/imu/mag" in MANIFEST[name]["topics"]:
        field = np.linalg.norm(logs(name, "imu/mag").mag, axis=1)
        assert 20e-6 < np.median(field) < 70e-6


@pytest.mark.parametrize("name", BROAD)
def test_broad_reference_carries_gravity_up_and_the_field_north_and_down(logs, name):
    """A quaternion in another order, or its inverse, fails here."""
    imu, mag, pose = (logs(name, t) for t in ("imu/data_raw", "imu/mag", "reference/pose"))
    assert np.all(np.diff(imu.stamp) == 3_500_000)
    np.testing.assert_array_equal(mag.stamp, imu.stamp)
    assert np.linalg.norm(pose.quat_world_imu, axis=1) == pytest.approx(1, abs=1e-6)
    rows = np.searchsorted(imu.stamp, pose.stamp)
    rotation = Rotation.from_quat(pose.quat_world_imu)
    up = rotation.apply(imu.acc[rows]).mean(axis=0)
    # Accelerations average out over minutes; 0.3 m/s^2 is 2 degrees.
    np.testing.assert_allclose(up, [0, 0, 9.81], atol=0.3)
    east, north, vertical = np.median(rotation.apply(mag.mag[rows]), axis=0) * 1e6
    # Berlin: declination 4 deg, horizontal 19 uT, vertical -46 uT; the lab bends that.
    assert north > 10 and vertical < -25 and abs(east) < 0.5 * north


@pytest.mark.parametrize("name", BROAD)
def test_movement_mask_marks_the_turning(logs, name):
    imu = logs(name, "imu/data_raw")
    with open_bag(BAGS / name) as reader:
        changes = [(t, cdr[4] != 0) for _, _, t, cdr in reader.messages(["/reference/moving"])]
    stamp, value = zip(*changes)
    assert stamp[0] == imu.stamp[0]
    moving = moving_at(imu.stamp, stamp, value)
    rate = np.linalg.norm(imu.gyr, axis=1)
    assert np.median(rate[moving]) > 20 * np.median(rate[~moving])
    assert 0.4 < moving.mean() < 0.8


def test_onboard_attitude_agrees_with_gravity_and_turns_with_the_gyroscope(logs):
    """Right frames: in slow flight the force points up, and rates follow the gyroscope."""
    imu, pose = logs("px4_plane", "imu/data_raw"), logs("px4_plane", "onboard_ekf/pose")
    rotation = Rotation.from_quat(pose.quat_world_imu)
    rows = np.searchsorted(imu.stamp, pose.stamp).clip(0, len(imu) - 1)
    up = rotation.apply(imu.acc[rows]).mean(axis=0)
    assert up[2] == pytest.approx(9.81, abs=0.8) and np.hypot(up[0], up[1]) < 2
    dt = np.diff(pose.stamp) * 1e-9
    rate = (rotation[:-1].inv() * rotation[1:]).as_rotvec() / dt[:, None]
    for axis in range(3):
        # README of the data: 0.95 / 0.97 / 0.84 for derived body rates.
        assert np.corrcoef(rate[:, axis], imu.gyr[rows[:-1], axis])[0, 1] > 0.7


def test_gnss_velocity_is_the_rate_of_the_position(logs):
    for name, tolerance in (("drive_0708", 0.2), ("px4_plane", 1.5)):
        fix, velocity = logs(name, "fix"), logs(name, "fix_velocity")
        np.testing.assert_array_equal(fix.stamp, velocity.stamp)
        dt = np.diff(fix.stamp) * 1e-9
        # Metres per degree at this latitude, spherical: 0.5 % off at most.
        metres = np.radians(1) * 6371e3
        north = np.diff(fix.latitude_deg) * metres / dt
        east = np.diff(fix.longitude_deg) * metres * np.cos(np.radians(fix.latitude_deg[0])) / dt
        up = np.diff(fix.height) / dt
        mean = 0.5 * (velocity.vel_world[1:] + velocity.vel_world[:-1])
        error = np.column_stack([east, north, up]) - mean
        assert np.all(np.median(np.abs(error), axis=0) < tolerance)
    drive = logs("drive_0708", "fix")
    sd = np.sqrt(np.diagonal(drive.cov_enu, axis1=1, axis2=2))
    assert 0.005 < np.median(sd) < 0.03  # RTK: 1-2 cm
    assert set(np.unique(drive.status)) == {0, 2}


def test_accelerometers_of_an_array_agree_while_it_is_still(logs):
    accelerometers = [logs("mimu4444", f"accelerometers/imu{k}") for k in range(8)]
    still = np.array([log.acc[:500].mean(axis=0) for log in accelerometers])
    # Calibrated to 1 % of gravity, and in the same axes.
    assert np.linalg.norm(still, axis=1) == pytest.approx(9.81, rel=0.01)
    assert np.abs(still - still.mean(axis=0)).max() < 0.1


@pytest.mark.skipif(not SOURCE.exists(), reason="the sources are not here (IMU_FUSION_DATA)")
def test_making_a_recording_again_gives_the_same_messages(tmp_path):
    recording = make_bags.RECORDINGS["px4_plane"]
    directory = make_bags.write_recording(recording, SOURCE, tmp_path)
    assert make_bags.content_hash(directory) == MANIFEST["px4_plane"]["content_sha256"]


def test_aerospace_angles_become_forward_left_up_in_east_north_up():
    """Hand-worked: level heading north looks along +y; pitch up raises the nose; roll right
    lowers the right wing."""
    yaw_pitch_roll = [[0, 0, 0], [90, 0, 0], [0, 30, 0], [0, 0, 30]]
    rotation = Rotation.from_quat(make_bags.enu_flu_from_euler(yaw_pitch_roll))
    nose, left = rotation.apply([1, 0, 0]), rotation.apply([0, 1, 0])
    np.testing.assert_allclose(nose[:2], [[0, 1, 0], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(nose[2], [0, np.cos(np.pi / 6), 0.5], atol=1e-12)
    np.testing.assert_allclose(left[0], [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(left[3], [-np.cos(np.pi / 6), 0, 0.5], atol=1e-12)


def test_the_public_mat_files_are_read_like_the_npz(tmp_path):
    from scipy.io import savemat

    rng = np.random.default_rng(5)
    values = {"imu_gyr": rng.normal(size=(8, 3)), "imu_acc": rng.normal(size=(8, 3)),
              "imu_mag": rng.normal(size=(8, 3)), "opt_quat": rng.normal(size=(8, 4)),
              "sampling_rate": 285.714, "movement": np.arange(8) > 3}
    savemat(tmp_path / "trial.mat", values)
    np.savez(tmp_path / "other.npz", gyr=values["imu_gyr"], acc=values["imu_acc"],
             mag=values["imu_mag"], quat=values["opt_quat"], fs=285.714, mov=values["movement"])
    from_mat = make_bags.read_broad(tmp_path / "trial.npz")
    from_npz = make_bags.read_broad(tmp_path / "other.npz")
    assert from_mat.keys() == from_npz.keys()
    for key in from_npz:
        np.testing.assert_array_equal(from_mat[key], from_npz[key])


def test_the_public_files_of_the_drive_are_read_like_the_csv(tmp_path, logs):
    """The first lines of the public log and solution, against the recording made from the CSV.

    The tag file is made here (a header of 60 bytes, tick, start in whole and fractional
    seconds, then pairs of tick and position): it stretches the ticks by 1.0003, as the
    stamps of the recording do.
    """
    (tmp_path / "imu_1934.csv").write_text(
        "0.119,0.027,1.013,-0.671,3.082,0.198,261906\n"
        "0.116,0.031,0.985,-0.359,0.946,0.168,261916\n"
        "0.114,0.032,1.009,0.999,-3.815,0.191,261926\n"
        "0.128,0.023,1.017,-0.526,1.640,0.031,261937\n"
        "0.120,0.026,0.99")
    duration_ms = 21.007
    (tmp_path / "imu_1934.csv.tag").write_bytes(
        b"TIMETAG".ljust(60, b"\0") + struct.pack("<IId", 5, 1752003261, 0.729)
        + struct.pack("<II", 10, 40) + struct.pack("<II", round(duration_ms), 160))
    stamp, table = make_bags.read_public_drive_imu(tmp_path / "imu_1934.csv")
    imu = logs("drive_0708", "imu/data_raw")[:3]
    # A tag in whole milliseconds moves a stamp by less than 10 us here.
    assert np.abs(stamp - imu.stamp).max() < 10_000
    for i, axis in enumerate("xyz"):
        np.testing.assert_array_equal(table[f"acc_{axis}"], imu.acc[:, i])
        np.testing.assert_array_equal(table[f"gyr_{axis}"], imu.gyr[:, i])

    (tmp_path / "gnss_1934_sf.pos").write_text(
        "%  GPST  latitude(deg) longitude(deg) height(m) Q ns sdn sde sdu ...\n"
        "2025/07/08 19:34:18.499 40.0966268 -105.1474483 1601.4740000 1.0000000 21.0000000 "
        "0.0098995 0.0098995 0.0100000 0.0 0.0 0.0 0.0 0.0 0.0100000 -0.0020000 0.0090000 "
        "0.0586899 0.0586899 0.0586899 0.0 0.0 0.0\n"
        "2025/07/08 19:34:18.749 40.0966268 -105.1474483 1601.4760000 1.0000000 21.0000000 "
        "0.0098995 0.0098995 0.0100000 0.0 0.0 0.0 0.0 0.0 0.0010000 0.0020000 -0.0060000 "
        "0.0558614 0.0558614 0.0558614 0.0 0.0 0.0\n")
    stamp, table = make_bags.read_public_drive_gnss(tmp_path / "gnss_1934_sf.pos")
    fix, velocity = logs("drive_0708", "fix")[:2], logs("drive_0708", "fix_velocity")[:2]
    np.testing.assert_array_equal(stamp, fix.stamp)
    np.testing.assert_array_equal(table["lat_deg"], fix.latitude_deg)
    np.testing.assert_array_equal(table["height_m"], fix.height)
    np.testing.assert_allclose(table["sd_n"] ** 2, fix.cov_enu[:, 1, 1], rtol=1e-12)
    for i, name in enumerate(("vel_e", "vel_n", "vel_u")):
        np.testing.assert_array_equal(table[name], velocity.vel_world[:, i])


def test_the_simulated_jump_is_made_by_the_simulation_and_tells_its_truth(logs, tmp_path):
    directory = make_bags.write_recording(make_bags.RECORDINGS["jump_simulated"], SOURCE, tmp_path)
    with open_bag(directory) as reader:
        again, pose = read_log(reader, "imu/data_raw"), read_log(reader, "reference/pose")
    imu = logs("jump_simulated", "imu/data_raw")
    np.testing.assert_array_equal(imu.stamp, again.stamp)
    # Other versions of scipy integrate to the same 1e-9.
    np.testing.assert_allclose(imu.acc, again.acc, atol=1e-6)
    with open_bag(BAGS / "jump_simulated") as reader:
        ((_, _, _, cdr),) = reader.messages(["/reference/jump"])
    truth = json.loads(string_value(cdr))
    # The truth of the file against its poses: speed by differences over 20 ms.
    for name in ("takeoff", "touchdown"):
        i = int(np.searchsorted(pose.stamp, truth[f"{name}_stamp"]))
        step = pose.position_world[i + 1] - pose.position_world[i - 1]
        assert np.linalg.norm(step) / 0.02 == pytest.approx(truth[f"{name}_speed"], abs=0.5)
