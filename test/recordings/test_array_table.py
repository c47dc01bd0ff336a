"""Tables become recordings: units, axes and positions as described, and errors that name them."""

import re

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from imu_fusion import batch, cli
from imu_fusion.errors import ImuFusionError
from imu_fusion.messages.layouts import IMU
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.convert import convert

G = 9.80665
SPIN = 5.0  # rad/s about the vertical
STEP_MS = 10
PLACES_MM = {"front": (150, 0, 0), "left": (0, 100, 0), "back": (-150, 0, 0), "top": (0, 0, 80)}
# Sensor x up, y right (body -y), z forward (body x): right-handed would be z = x cross y.
AXES = [0.0, 0.0, 1.0, 0.0, -1.0, 0.0, 1.0, 0.0, 0.0]


def field_at(place_mm):
    """Specific force of a body that spins about the vertical through its origin."""
    x, y, _ = 1e-3 * np.array(place_mm, dtype=float)
    return np.array([-SPIN ** 2 * x, -SPIN ** 2 * y, G])


def describe(**changes):
    sensors = {name: {"columns": [f"{name}_{axis}" for axis in "xyz"], "unit": "g",
                      "position": list(place), "bias_sd": 1e-6, "range": 500.0}
               for name, place in PLACES_MM.items()}
    sensors["top"]["axes"] = AXES
    return {"time": {"column": "t", "unit": "ms", "start": 1.7e9}, "position_unit": "mm",
            "accelerometers": sensors,
            "gyroscope": {"columns": ["wx", "wy", "wz"], "unit": "deg/s"},
            "parameters": {"points": [0, 0, 1], "initial": {
                "mode": "given", "angular_velocity": [0, 0, SPIN]}}} | changes


def write(folder, description, rows=200, replace=lambda text: text):
    names = ["t"] + [f"{n}_{a}" for n in PLACES_MM for a in "xyz"] + ["wx", "wy", "wz"]
    values = np.concatenate([
        np.reshape(AXES, (3, 3)) @ field_at(place) if name == "top" else field_at(place)
        for name, place in PLACES_MM.items()]) / G
    lines = [",".join(names)]
    lines += [",".join([str(STEP_MS * i), *(f"{v:.9f}" for v in values), "0", "0",
                        f"{np.degrees(SPIN):.9f}"]) for i in range(rows)]
    (folder / "run.csv").write_text(replace("\n".join(lines) + "\n"))
    (folder / "run.yaml").write_text(yaml.safe_dump(description))
    return folder / "run.csv", folder / "run.yaml", folder / "bag"


def test_a_spinning_body_comes_out_of_its_table(tmp_path):
    source, description, out = write(tmp_path, describe())
    result = CliRunner().invoke(cli.cli, ["convert", str(source), str(out), "--csv",
                                          str(description)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    with open_bag(out) as reader:
        for name, place in PLACES_MM.items():
            messages = [cdr for *_, cdr in reader.messages([f"/accelerometers/{name}"])]
            stamps, _, values = IMU.decode_many(messages)
            felt = values[:, IMU["linear_acceleration"]]
            if name == "top":
                felt = felt @ np.reshape(AXES, (3, 3))
            assert felt == pytest.approx(np.tile(field_at(place), (200, 1)), abs=1e-7)  # 9 digits
            assert np.all(values[:, IMU["angular_velocity_covariance"].start] == -1)
            assert stamps.tolist() == [1_700_000_000_000_000_000 + STEP_MS * 1_000_000 * i
                                       for i in range(200)]
    reports, _ = batch.process(out, tmp_path / "estimates", tmp_path / "bag.yaml")
    assert {r.node: r.written for r in reports}["acceleration_field_estimator"]
    with open_bag(tmp_path / "estimates") as reader:
        _, _, values = IMU.decode_many(
            [cdr for *_, cdr in reader.messages(["/acceleration_field/imu"])])
    assert len(values) == 200
    # Noise-free readings of 9 digits: position in mm, axes and units all enter these.
    assert values[-1, IMU["angular_velocity"]] == pytest.approx([0, 0, SPIN], abs=1e-3)
    assert values[-1, IMU["linear_acceleration"]] == pytest.approx([0, 0, G], abs=1e-3)
    parameters = yaml.safe_load((tmp_path / "bag.yaml").read_text())[
        "acceleration_field_estimator"]["ros__parameters"]
    assert parameters["sample_rate"] == 100.0
    assert parameters["accelerometers"]["front"]["position"] == [0.15, 0.0, 0.0]
    assert parameters["points"] == [0.0, 0.0, 1.0]  # ROS wants floats


def test_nanosecond_stamps_are_exact_and_rates_stand_in_for_times(tmp_path):
    description = describe(time={"column": "t", "unit": "s"})
    source, file, out = write(tmp_path, description, replace=lambda text: text.replace(
        "\n0,", "\n1700000000.123456789,").replace("\n10,", "\n1700000000.133456789,"), rows=2)
    convert(source, out, file)
    with open_bag(out) as reader:
        assert next(reader.messages(["/imu/data_raw"]))[2] == 1_700_000_000_123_456_789
    source, file, out = write(tmp_path, describe(time={"rate": 400.0}), rows=3)
    convert(source, out, file, overwrite=True)
    with open_bag(out) as reader:
        assert [m[2] for m in reader.messages(["/imu/data_raw"])] == [0, 2_500_000, 5_000_000]


def test_numbered_columns_white_space_and_fewer_axes(tmp_path):
    description = {
        "delimiter": "space", "header": False, "skip_lines": 2, "time": {"column": 1},
        "accelerometers": {f"s{k}": {"columns": [2 * k + 2, 2 * k + 3], "position": place,
                                     "measured_axes": ["x", "z"] if k < 3 else ["x", "y"]}
                           for k, place in enumerate([[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1],
                                                      [-0.1, 0, 0], [0, -0.1, 0], [0, 0, -0.1]])}}
    (tmp_path / "d.yaml").write_text(yaml.safe_dump(description))
    (tmp_path / "t.txt").write_text("made by\nsomebody\n" + "".join(
        f"{i * 1e-3:.3f}   " + " ".join(str(v) for v in range(12)) + "\n" for i in range(5)))
    convert(tmp_path / "t.txt", tmp_path / "bag", tmp_path / "d.yaml")
    with open_bag(tmp_path / "bag") as reader:
        _, _, values = IMU.decode(next(reader.messages(["/accelerometers/s2"]))[3])
    assert values[IMU["linear_acceleration"]].tolist() == [4.0, 0.0, 5.0]


def without(name):
    changed = describe()
    del changed["accelerometers"]["front"][name]
    return changed


def sensor(**changes):
    changed = describe()
    changed["accelerometers"]["front"] |= changes
    return changed


FLAT = describe()
for _k, _name in enumerate(FLAT["accelerometers"]):
    FLAT["accelerometers"][_name]["position"] = [10.0 * _k, 0.0, 0.0]


@pytest.mark.parametrize("description, replace, words", [
    (sensor(columns=["front_x", "front_y", "nope"]), None,
     "no column 'nope'; there are: t, front_x"),
    (sensor(columns=["front_x", "front_y"]), None,
     "front: 2 columns for the measured axes x, y, z"),
    (without("columns"), None, "front: 'columns' must list"),
    (sensor(unit="gee"), None, "accelerometers.front.*'gee'.*one of m/s\\^2, g, mg"),
    (sensor(positon=[1, 2, 3]), None, "unknown parameter 'positon'.*accelerometers.front"),
    (sensor(axes=[1.0] * 9), None, "not orthonormal"),
    (describe(position_unit="furlong"), None, "'position_unit'.*'furlong'.*m, cm, mm, in"),
    (describe(time={"column": "t", "unit": "h"}), None, "'time.unit'.*'h'"),
    (describe(time={}), None, "either time.column or time.rate"),
    (describe(gyroscope={"columns": ["wx", "wy", "wz"], "unit": "rpm"}), None,
     "gyroscope.*'rpm'.*rad/s, deg/s"),
    (describe(parameters={"methd": "ao"}), None, "unknown parameter 'methd'"),
    (describe(delimiter="::"), None, "delimiter '::'"),
    (describe(accelerometers={}), None, "names no accelerometers"),
    (describe(accelerometers={}, gyroscope={}, parameters={}), None, "names no sensors"),
    (FLAT, None, "collinear"),
    (describe(), lambda t: re.sub(r"\n20,[^,]+", "\n20,oops", t),
     "line 4, column 'front_x': 'oops' is not a number"),
    (describe(), lambda t: t.replace("\n20,", "\n20,1,", 1), "line 4: 17 cells, more than the 16"),
    (describe(), lambda t: t.replace("\n20,", "\nnoon,", 1), "line 4, column 't': 'noon'"),
    (describe(), lambda t: t.replace("\n20,", "\n20\n21,", 1), "line 4: 1 cells"),
    (describe(time={"column": "t", "unit": "ms"}), lambda t: t.replace("\n0,", "\n-20,", 1),
     "give time.start"),
    (describe(), lambda t: t.splitlines()[0], "0 rows"),
])
def test_what_is_wrong_is_named_and_nothing_is_written(tmp_path, description, replace, words):
    source, file, out = write(tmp_path, description, rows=5, replace=replace or (lambda t: t))
    with pytest.raises(ImuFusionError, match=words):
        convert(source, out, file)
    assert not out.exists() and not (tmp_path / "bag.yaml").exists()


def test_an_existing_parameter_file_is_not_replaced_unasked(tmp_path):
    source, file, out = write(tmp_path, describe(), rows=3)
    (tmp_path / "bag.yaml").write_text("mine")
    with pytest.raises(ImuFusionError, match="bag.yaml: exists already"):
        convert(source, out, file)
    assert (tmp_path / "bag.yaml").read_text() == "mine"


def test_without_positions_there_are_the_samples_and_no_parameters(tmp_path):
    """No table tells where its sensors sit: what describe makes of it can be converted."""
    names = [f"{name}_{axis}" for name in ("front", "left", "top", "back") for axis in "xyz"]
    (tmp_path / "run.csv").write_text("t_ms," + ",".join(names) + "\n" + "".join(
        f"{i}" + ",0.01,0.02,1" * 4 + "\n" for i in range(9)))
    for arguments in (["describe", "run.csv", "--out", "run.yaml"],
                      ["convert", "run.csv", "run", "--description", "run.yaml"]):
        result = CliRunner().invoke(cli.cli, [
            str(tmp_path / word) if word.startswith("run") else word for word in arguments],
            catch_exceptions=False)
        assert result.exit_code == 0, result.output
    assert "no 'position' of the accelerometers" in result.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "run.csv", "run.yaml"]
    with open_bag(tmp_path / "run") as reader:
        assert set(reader.topics) == {f"/accelerometers/{name}" for name in (
            "front", "left", "top", "back")}
        _, _, values = IMU.decode_many([m[3] for m in reader.messages(["/accelerometers/left"])])
    assert values[0, IMU["linear_acceleration"]] == pytest.approx([0.01 * G, 0.02 * G, G])
