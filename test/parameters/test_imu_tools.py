"""Parameter files of imu_tools: translated, or said why not, all of them at once."""

import math

import pytest
import yaml
from click.testing import CliRunner

from imu_fusion import cli
from imu_fusion.errors import ParameterError
from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.parameters.file import parameters_for
from imu_fusion.parameters.imu_tools import translate
from imu_fusion.streams.orientation_messages import OrientationOutputParams

#: The keys of imu_filter_madgwick's own example, with values that mean something.
MADGWICK = """
imu_filter:
  ros__parameters:
    stateless: false
    use_mag: false
    publish_tf: true
    reverse_tf: false
    fixed_frame: "odom"
    constant_dt: 0.01
    publish_debug_topics: false
    world_frame: "ned"
    gain: 0.1
    zeta: 0.0
    mag_bias_x: 1.0e-6
    mag_bias_z: -2.0e-6
    declination: 0.05
    yaw_offset: 1.5707963
    orientation_stddev: 0.02
    remove_gravity_vector: true
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "imu_filter.yaml"
    path.write_text(MADGWICK)
    return path


def test_what_has_a_counterpart_is_translated_with_its_unit(file):
    values = translate(str(file)).values
    assert values == {
        "publish_tf": True, "fixed_frame": "odom", "world_frame": "ned",
        "declination_deg": pytest.approx(math.degrees(0.05)),
        "alignment.yaw_offset_deg": pytest.approx(90.0, abs=1e-5),
        "remove_gravity_vector": True, "sensor.mag_offset": [1e-6, 0.0, -2e-6]}


def test_all_that_has_none_is_named_unless_it_asks_for_nothing(file):
    result = translate(str(file))
    assert [line.partition(":")[0] for line in result.left_out] == [
        "use_mag", "constant_dt", "gain", "zeta", "orientation_stddev"]
    assert result.unknown == []


def test_the_command_writes_a_file_that_the_node_takes(file, tmp_path):
    out = tmp_path / "ours.yaml"
    done = CliRunner().invoke(cli.cli, ["translate", str(file), "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert done.output.count("no counterpart: ") == 5
    params, output = parameters_for((OrientationParams, OrientationOutputParams),
                                    "orientation_estimator", out)
    assert params.world_frame == "ned" and output.publish_tf
    assert params.sensor.mag_offset == (1e-6, 0.0, -2e-6)
    again = CliRunner().invoke(cli.cli, ["translate", str(file), "--out", str(out)])
    assert again.exit_code == 1 and "cannot be written" in again.output


def test_printed_it_is_yaml_and_unknown_names_are_an_error(file):
    file.write_text(MADGWICK + "    magic: 1\n    more_magic: 2\n")
    done = CliRunner().invoke(cli.cli, ["translate", str(file)])
    assert done.exit_code == 1
    assert [line for line in done.output.splitlines() if "unknown" in line] == [
        "unknown to imu_tools: magic", "unknown to imu_tools: more_magic"]
    text = done.output[done.output.index("orientation_estimator:"):]
    assert yaml.safe_load(text)["orientation_estimator"]["ros__parameters"]["world_frame"] == "ned"


def test_the_bias_of_the_complementary_filter_can_be_switched_off(tmp_path):
    path = tmp_path / "complementary.yaml"
    path.write_text("complementary_filter: {ros__parameters: {do_bias_estimation: false}}")
    result = translate(str(path))
    assert result.values == {"fusion.estimate_bias": False} and not result.left_out


@pytest.mark.parametrize("content, text", [
    ("", "holds no parameters"),
    ("imu_filter: {ros__parameters: {declination: east}}", "'declination': 'east' is not a num")])
def test_files_that_say_nothing_are_refused(tmp_path, content, text):
    path = tmp_path / "x.yaml"
    path.write_text(content)
    with pytest.raises(ParameterError, match=text):
        translate(str(path))
