"""Trajectories for AvaFrame."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from imu_fusion.errors import BagError, TopicError
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.messages.convert import fix_message
from imu_fusion.messages.layouts import FIX, ODOMETRY
from imu_fusion.recordings.avaframe import COLUMNS, export_avaframe
from imu_fusion.recordings.bag_writer import BagWriter

PLACE = LocalFrame(47.31, 11.38, 1900.0)
SPEED = 20.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Five seconds down a slope of 30 deg to the north-east, faster and faster, tumbling."""
    path = tmp_path_factory.mktemp("avaframe") / "bag"
    down = np.array([np.sqrt(0.375), np.sqrt(0.375), -0.5])
    with BagWriter(path) as writer:
        for i in range(501):
            t, stamp = 0.01 * i, 10**18 + i * 10_000_000
            velocity, position = (SPEED + 2.0 * t) * down, (SPEED * t + t * t) * down
            turn = Rotation.from_rotvec([0.0, 10.0 * t, 1.0])
            values = np.zeros(ODOMETRY.size)
            values[ODOMETRY["position"]] = position
            values[ODOMETRY["orientation"]] = turn.as_quat()
            values[ODOMETRY["linear"]] = turn.inv().apply(velocity)
            (cdr,) = ODOMETRY.encode_block(np.array([stamp]), "world", values[None], "ball")
            writer.write("/smoother/odometry", ODOMETRY.msgtype, cdr, stamp)
            writer.write("/smoother/fix", FIX.msgtype, fix_message(
                stamp, "ball", *map(float, PLACE.to_geodetic(position))), stamp)
    return path


def table(path):
    assert path.read_text().splitlines()[0] == ",".join(COLUMNS)
    return dict(zip(COLUMNS, np.loadtxt(path, delimiter=",", skiprows=1).T))


def test_lengths_speeds_and_accelerations_are_those_of_the_motion(recording, tmp_path):
    assert export_avaframe(recording, tmp_path / "a.csv") == 51
    rows = table(tmp_path / "a.csv")
    assert rows["time"] == pytest.approx(np.arange(51) * 0.1)
    assert rows["velocityMag"] == pytest.approx(SPEED + 2.0 * rows["time"], abs=1e-5)
    assert rows["uAcc"] == pytest.approx(2.0, abs=1e-4)
    way = SPEED * rows["time"] + rows["time"] ** 2
    assert rows["trajectoryLengthXYZ"] == pytest.approx(way, abs=1e-4)
    assert rows["trajectoryLengthXY"] == pytest.approx(way * np.sqrt(0.75), abs=1e-4)


def test_on_a_map_places_move_as_velocities_say(recording, tmp_path):
    """Grid north of the Austrian system is 0.8 deg off at this place."""
    pytest.importorskip("pyproj")
    export_avaframe(recording, tmp_path / "b.csv", "EPSG:31254")
    rows = table(tmp_path / "b.csv")
    for place, velocity in (("X", "ux"), ("Y", "uy"), ("Z", "uz")):
        mean = 0.5 * (rows[velocity][1:] + rows[velocity][:-1])
        assert np.diff(rows[place]) / 0.1 == pytest.approx(mean, abs=0.02)
    assert 230_000 < rows["Y"][0] < 260_000


def test_what_is_not_there_is_named(recording, tmp_path):
    with pytest.raises(BagError, match="no reference system 'EPSG:1'"):
        pytest.importorskip("pyproj")
        export_avaframe(recording, tmp_path / "c.csv", "EPSG:1")
    with BagWriter(tmp_path / "empty") as writer:
        writer.write("/fix", FIX.msgtype, fix_message(1, "g", 47.0, 11.0, 0.0), 1)
    with pytest.raises(TopicError, match="smoother/odometry"):
        export_avaframe(tmp_path / "empty", tmp_path / "d.csv")
