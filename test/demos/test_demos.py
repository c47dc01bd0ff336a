"""Each demo to its end, through its nodes: what it says, what it records, and its report."""

import re

import pytest
from click.testing import CliRunner

from imu_fusion import cli
from imu_fusion.demos import DEMOS
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.report.html import scripts

# Topic that is recorded and its messages, words of the report, and what is said.
SHOWN = {
    "orientation": ("/imu/data", 56_380, "Orientation", "through three ROS 2 processes"),
    "impact": ("/acceleration_field/imu", 3_750, "Acceleration field", "batch, smoothed"),
    "head": ("/acceleration_field/imu", 1_801, "Acceleration field", "peak angular velocity"),
    "drive": ("/smoother/odometry", 54_858, "Trajectory", "bit for bit"),
    "jump": ("/smoother/odometry", 2_701, "Jump", "bit for bit"),
    "avalanche": ("/smoother/odometry", 11_926, "On the slope", "bit for bit")}


@pytest.mark.slow
@pytest.mark.parametrize("name", DEMOS)
def test_a_demo_comes_to_its_end_and_shows_what_it_found(name, tmp_path):
    topic, count, title, words = SHOWN[name]
    result = CliRunner().invoke(cli.cli, ["demo", name, "--out", str(tmp_path)],
                                catch_exceptions=False)
    assert result.exit_code == 0 and words in result.output, result.output
    page = (tmp_path / "report.html").read_text()
    assert scripts() in page and len(page) > len(scripts()) + 2e5    # whole, and with its data
    assert title in page
    with open_bag(tmp_path / "recording") as reader:
        assert reader.topics[topic].count == count
    if name in ("head", "jump", "avalanche"):
        assert "SIMULATED" in result.output
    if name == "head":
        errors = re.findall(r"peak .*?([+-]\d+\.\d+) % *│\n", result.output)
        assert len(errors) == 2 and max(abs(float(error)) for error in errors) < 3.0
    if name == "jump":
        (error,) = re.findall(r"jump length.*?([+-]\d+\.\d+) *│\n", result.output)
        assert abs(float(error)) < 0.4  # four sigma of the stated 0.1 m
