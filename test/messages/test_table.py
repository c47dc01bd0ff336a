"""Accelerometer arrays from CSV."""

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from imu_fusion import batch
from imu_fusion.cli import cli
from imu_fusion.errors import ParameterError, SampleError
from imu_fusion.messages.bag import BagWriter, open_bag
from imu_fusion.messages.layouts import IMU
from imu_fusion.messages.table import convert_table
from imu_fusion.simulation.rigid_body_impact import PAPER_AXES, PAPER_POSITIONS, simulate

NAMES = ("top", "left", "front", "back")


def description(**changes):
    content = {
        "time": {"column": "t", "unit": "ms"}, "sample_rate": 1000.0,
        "points": [0.0, 0.0, 0.75], "gravity": 9.8,
        "initial": {"mode": "given", "angular_velocity": [5.0, 5.0, 5.0]},
        "accelerometers": {name: {
            "columns": [f"{name}_{a}" for a in "xyz"], "unit": "g",
            "position": PAPER_POSITIONS[k].tolist(), "axes": PAPER_AXES[k].ravel().tolist(),
            "bias_sd": 0.0} for k, name in enumerate(NAMES)}}
    return {**content, **changes}


@pytest.fixture(scope="module")
def motion():
    return simulate(duration=0.6)


@pytest.fixture
def files(motion, tmp_path):
    readings = motion.readings(PAPER_POSITIONS, PAPER_AXES) / 9.80665
    lines = [",".join(["t", *(f"{n}_{a}" for n in NAMES for a in "xyz"), "comment"])]
    for t, row in zip(motion.t, readings.reshape(len(motion.t), -1)):
        lines.append(",".join([f"{1e3 * t:.6f}", *(repr(float(v)) for v in row), ""]))
    cells = lines[101].split(",")
    lines[101] = ",".join([cells[0], "", *cells[2:]])  # one empty cell
    (tmp_path / "head.csv").write_text("\n".join(lines))
    (tmp_path / "head.yaml").write_text(yaml.safe_dump(description()))
    return tmp_path


def test_csv_to_field(files, motion):
    """The whole way of a biomechanist: CSV, convert, process."""
    result = CliRunner().invoke(cli, [
        "convert", str(files / "head.csv"), str(files / "bag"), "--columns",
        str(files / "head.yaml")], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    parameters = files / "bag" / "acceleration_field.yaml"
    assert str(parameters) in result.output
    reports, _ = batch.process(files / "bag", files / "out", parameters)
    with open_bag(files / "out") as reader:
        rows = IMU.decode_many([m[3] for m in reader.messages(["/acceleration_field/imu"])])[2]
    assert len(rows) == len(motion.t)
    assert np.abs(rows[:, IMU["angular_velocity"]] - motion.omega).max() < 0.05
    with open_bag(files / "bag") as reader:
        assert reader.topics["/accelerometers/top"].count == len(motion.t) - 1


@pytest.mark.parametrize("change, error, match", [
    ({"time": {"column": "time", "unit": "ms"}}, SampleError, "column 'time'.*it has t"),
    ({"time": {"column": "t", "unit": "min"}}, SampleError, "unit 'min'.*ms"),
    ({"time": {"column": "top_x", "unit": "s"}}, SampleError, "does not go forwards"),
    ({"accelerometers": {"top": {"columns": ["top_x"], "unit": "g"}}}, SampleError, "need 3"),
    ({"accelerometers": {"top": {"columns": ["comment"] * 3, "unit": "G"}}}, SampleError,
     "unit 'G'"),
    ({"sample_rat": 5.0}, ParameterError, "sample_rat"),
    ({"accelerometers": None}, SampleError, "needs 'time'")])
def test_mistakes_are_named(files, change, error, match):
    (files / "head.yaml").write_text(yaml.safe_dump(description(**change)))
    with pytest.raises(error, match=match), BagWriter(files / "bag") as writer:
        convert_table(files / "head.csv", files / "head.yaml", writer)


def test_text_in_a_cell_is_named_by_row(files):
    text = (files / "head.csv").read_text().splitlines()
    text[5] = text[5].replace(text[5].split(",")[3], "n/a", 1)
    (files / "head.csv").write_text("\n".join(text))
    with pytest.raises(SampleError, match="row 6, column 'top_z': 'n/a'"), \
            BagWriter(files / "bag") as writer:
        convert_table(files / "head.csv", files / "head.yaml", writer)
