"""A trajectory beside a radar: geometry worked out by hand, and the AvaNode's ranges."""

import csv

import numpy as np
import pytest
from click.testing import CliRunner

from imu_fusion.cli import cli
from imu_fusion.errors import BagError, EstimationError
from imu_fusion.estimation.avalanche.radar import RadarLog, Secant, gates_of, range_differences
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.recordings.radar import read_radar
from imu_fusion.report.radar import read_seen
from test.sources.test_exports import at_hand, convert

RADAR = (47.306584, 11.380406, 1900.881)
#: A slope of 3 in 4 that comes down towards the radar and passes 60 m beside it.
DOWN = np.array([0.0, -0.8, -0.6])
START = np.array([60.0, 400.0, 300.0])


def test_ranges_lie_on_the_secant_where_they_are_measured():
    way = np.linspace(0.0, 480.0, 481)
    position = START + way[:, None] * DOWN
    secant = Secant.through(position)
    distance, cosine = secant.project(np.linalg.norm(position, axis=1))
    assert distance == pytest.approx(way, abs=1e-6)
    # What a radar sees of 10 m/s down the slope is the change of the range.
    seen = -np.gradient(np.linalg.norm(position, axis=1), way) * 10.0
    assert (seen / cosine)[1:-1] == pytest.approx(10.0, abs=0.01)
    assert np.isnan(secant.project(np.array([59.0]))[0]).all()


def test_a_slope_that_leads_away_is_projected_too():
    position = START + np.linspace(0.0, 100.0, 11)[:, None] * -DOWN
    distance, _ = Secant.through(position).project(np.linalg.norm(position, axis=1))
    assert distance == pytest.approx(np.linspace(0.0, 100.0, 11), abs=1e-6)
    with pytest.raises(EstimationError, match="no slope secant"):
        Secant.through(position[:1])


def test_gates_come_in_their_order_with_the_median_velocity():
    log = RadarLog(np.array([1.0, 1.5, 3.0, 4.0]), np.array([310.0, 324.0, 260.0, 262.0]),
                   np.array([20.0, 22.0, np.nan, np.nan]))
    first, second = gates_of(log, 25.0)
    assert (first.range, first.time, first.velocity) == (312.5, 1.0, 21.0)
    assert (second.range, second.time) == (262.5, 3.0) and np.isnan(second.velocity)


def test_a_table_tells_its_columns_times_and_errors(tmp_path):
    table = tmp_path / "gates.csv"
    table.write_text("t,Time [s],Range [m],Speed [m/s]\n0,1.5,650,21\n1,4,625,\n")
    time, range_, velocity = read_radar(table, 10**18)
    assert list(time) == [1.5, 4.0] and list(range_) == [650.0, 625.0]
    assert velocity[0] == 21.0 and np.isnan(velocity[1])
    table.write_text("Time,Distance_to_radar[m]\n2001-09-09 01:46:41.5,650\n1000000002.25,650\n")
    assert list(read_radar(table, 10**18)[0]) == [1.5, 2.25]
    for text, words in (("Time,Range [km]\n", "expected m"), ("Time,x\n", "no column of range"),
                        ("time,range\n1,far\n", "line 2: range is 'far'"),
                        ("time,range\n1,1_0\n", "range is '1_0'"),
                        ("time,range\n\u0663,1\n", "time is"),
                        ("time,range\n1e300,1\n", "time is '1e300'"),
                        ("time,range\n", "holds no row"), ("time,range\n1\n", "range is ''")):
        table.write_text(text)
        with pytest.raises(BagError, match=words):
            read_radar(table, 0)


@pytest.mark.parametrize("node, rows, ground", [("C07", slice(0, 450), 2252.42),
                                                ("C10", slice(0, 480), 2255.55),
                                                ("C10", slice(-300, None), 2042.14)])
def test_ranges_are_those_of_the_authors(tmp_path, node, rows, ground):
    """They took the heights of their terrain, with which the fixes' differ by up to 25 m: where
    the node lies still that is one number, and all ranges follow from it."""
    source = at_hand(f"avanode/220222_{node}_avalanche_GPS.txt")
    assert convert(source, tmp_path / "bag")[0] == 0
    radar = LocalFrame(*RADAR)
    seen = read_seen(tmp_path / "bag", radar)
    latitude, longitude, _ = radar.to_geodetic(seen.position)
    place = radar.to_enu(latitude, longitude, ground)
    log = RadarLog(*read_radar(at_hand(f"avanode/220222_{node}_radarCS.csv"), seen.start))
    assert np.abs(range_differences(seen.time, place, log)[rows]).max() < 0.02
    # Its velocities are the fixes'.
    assert seen.speed == pytest.approx(log.velocity, abs=2e-3)


def test_a_smoothed_descent_is_where_its_fixes_are(tmp_path):
    """Without an Imu: within what it says of itself, where the node lay still within two metres."""
    source = at_hand("avanode/220222_C10_avalanche_GPS.txt")
    assert convert(source, tmp_path / "bag")[0] == 0
    result = CliRunner().invoke(cli, ["process", str(tmp_path / "bag"), str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    radar = LocalFrame(*RADAR)
    raw, smoothed = (read_seen(tmp_path / name, radar) for name in ("bag", "out"))
    assert len(raw.time) == len(smoothed.time)
    with open_bag(tmp_path / "out") as bag:
        sd = np.sqrt(read_log(bag, "smoother/fix").cov_enu.diagonal(0, 1, 2))
    assert np.all(np.abs(raw.position - smoothed.position) < 3.0 * sd)
    still = np.linalg.norm(raw.position - raw.position[-1], axis=1) < 5.0
    assert np.abs(raw.range - smoothed.range)[still].max() < 2.0


def test_the_command_writes_a_report_with_boxes(tmp_path):
    source = at_hand("avanode/220222_C10_avalanche_GPS.txt")
    assert convert(source, tmp_path / "bag")[0] == 0
    gates = tmp_path / "gates.csv"
    with at_hand("avanode/220222_C10_radarCS.csv").open() as stream:
        rows = list(csv.reader(stream))
    gates.write_text("\n".join(",".join(row) for row in rows[::40]))
    (tmp_path / "plane.yaml").write_text(
        "{type: plane, origin: {latitude: 47.312, longitude: 11.3833, height: 2255.0}, "
        "slope_deg: 36.0, aspect_deg: 200.0}")
    for more in ([], ["--surface", str(tmp_path / "plane.yaml")]):
        result = CliRunner().invoke(cli, [
            "radar", str(tmp_path / "bag"), "--place", *map(str, RADAR), "--gates", str(gates),
            "--out", str(tmp_path / "radar.html"), *more])
        assert result.exit_code == 0, result.output
        assert "range less the radar's" in result.output
        assert "range gates" in (tmp_path / "radar.html").read_text()
