"""Parameters: declared once, checked everywhere, with errors that name the culprit."""

from dataclasses import dataclass

import pytest
import yaml

from imu_fusion.errors import ParameterError
from imu_fusion.parameters.declare import Parameters, markdown_table, param
from imu_fusion.parameters.file import load, parameters_for


@dataclass(frozen=True)
class Initial(Parameters):
    mode: str = param("rest", choices=("rest", "given"), doc="Start.")


@dataclass(frozen=True)
class Example(Parameters):
    noise: float = param(1e-3, unit="rad/s", low=0.0, high=1.0, doc="Noise.")
    count: int = param(3, low=1, doc="Count.")
    method: str = param("fusion", choices=("fusion", "gyro_mag"), doc="Method.")
    active: bool = param(True, doc="Switch.")
    limits: tuple[float, ...] | None = param(None, length=3, low=0.0, doc="Limits.")
    ranges: tuple[float, ...] | None = param(None, length=(1, 3), low=0.0, doc="Ranges.")
    surface: str = param("", path=True, doc="File.")
    initial: Initial = Initial()


@dataclass(frozen=True)
class Other(Parameters):
    speed: float = param(1.0, doc="Speed.")


def test_values_are_converted_and_dotted_names_reach_their_fields():
    example = Example.from_mapping({"noise": 1, "limits": [1, 2, 3], "initial": {"mode": "given"}})
    assert example.noise == 1.0 and isinstance(example.noise, float)
    assert example.limits == (1.0, 2.0, 3.0)
    assert example.initial.mode == "given"
    assert Example.from_mapping(example.to_mapping()) == example


@pytest.mark.parametrize("values, words", [
    ({"noise": 2.0}, r"'noise'.*2.0 is out of bounds; allowed: 0 to 1 rad/s"),
    ({"noise": "high"}, "'noise'.*not a number"),
    ({"noise": float("nan")}, "'noise'.*not a number"),
    ({"noise": True}, "'noise'.*not a number"),
    ({"noise": None}, "'noise'.*not a value"),
    ({"count": 2.5}, "'count'.*not an integer"),
    ({"count": float("inf")}, "'count'.*not an integer"),
    ({"count": 0}, "'count'.*at least 1"),
    ({"method": "magic"}, "'method'.*one of fusion, gyro_mag"),
    ({"active": "yes"}, "'active'.*true or false"),
    ({"limits": [1.0, 2.0]}, "'limits'.*has 2 elements.*3 elements"),
    ({"limits": [1.0, 2.0, -1.0]}, "'limits'.*out of bounds"),
    ({"limits": 4.0}, "'limits'.*not a list of float"),
    ({"ranges": [1.0, 2.0]}, "'ranges'.*has 2 elements.*1 or 3 elements"),
    ({"ranges": "3"}, "'ranges'.*not a list of float"),
    ({"ranges": True}, "'ranges'.*not a list of float"),
    ({"initial": {"mode": "fast"}}, "'initial.mode'.*rest, given"),
    ({"nosie": 0.1}, "unknown parameter 'nosie'.*known: .*noise"),
])
def test_bad_values_are_refused_with_name_value_and_bounds(values, words):
    with pytest.raises(ParameterError, match=words):
        Example.from_mapping(values, source="file.yaml")


def test_a_number_is_a_list_where_one_stands_for_all():
    assert Example.from_mapping({"ranges": 4}).ranges == (4.0,)


def test_a_parameter_without_default_is_required():
    @dataclass(frozen=True)
    class Required(Parameters):
        radius: float = param(doc="Radius.")
        width: float = param(1.0, doc="Width.")

    assert Required.from_mapping({"radius": 3}).radius == 3.0
    with pytest.raises(ParameterError, match=r"missing parameters: radius \(from file.yaml\)"):
        Required.from_mapping({"width": 3}, source="file.yaml")


def test_dataclass_is_checked_however_it_is_made():
    with pytest.raises(ParameterError, match="'noise'"):
        Example(noise=-1.0)
    with pytest.raises(ParameterError, match="'noise'"):
        Example().replace(noise=-1.0)


def test_file_of_ros_parameters_with_wildcard_and_namespace(tmp_path):
    (tmp_path / "hill.yaml").touch()
    file = tmp_path / "p.yaml"
    file.write_text("/**:\n  ros__parameters:\n    noise: 0.5\n    somebody: 1\n"
                    "    use_sim_time: true\n"
                    "/robot/estimator:\n  ros__parameters:\n    count: 7\n    speed: 2.0\n"
                    "    surface: hill.yaml\n"
                    "other:\n  ros__parameters: {x: 1}\n")
    example, other = parameters_for([Example, Other], "estimator", file)
    assert other.speed == 2.0
    assert (example.noise, example.count) == (0.5, 7)
    assert example.surface == str(tmp_path / "hill.yaml")
    assert parameters_for([Example], "absent", file)[0].count == 3
    assert parameters_for([Example], "estimator") == [Example()]
    with pytest.raises(ParameterError, match="unknown parameter 'speed'"):
        parameters_for([Example], "estimator", file)


@pytest.mark.parametrize("text, words", [
    ("a: [1", "not YAML"), ("- 1", "node names"), ("estimator: 5", "estimator"),
    ("estimator:\n  ros__parameters: {wrong: 1}", "unknown parameter 'wrong'.*p.yaml"),
])
def test_bad_files_are_named(tmp_path, text, words):
    file = tmp_path / "p.yaml"
    file.write_text(text)
    with pytest.raises(ParameterError, match=words):
        parameters_for([Example], "estimator", file)
    with pytest.raises(ParameterError, match="nowhere.yaml"):
        parameters_for([Example], "estimator", tmp_path / "nowhere.yaml")


def test_table_lists_every_parameter_with_unit_and_bounds():
    table = markdown_table(Example)
    assert "| `noise` | 0.001 | rad/s | 0 to 1 | Noise. |" in table
    assert "| `limits` | unset |" in table and "`initial.mode`" in table


def test_a_file_as_launch_ros_writes_it_is_read(tmp_path):
    """launch_ros dumps its lists as tuples, with a tag of Python's."""
    path = tmp_path / "launch_params.yaml"
    path.write_text(yaml.dump({"/**": {"ros__parameters": {"axis": (1.0, 2.0), "names": ("a",)}}}))
    assert "!!python/tuple" in path.read_text()
    assert load(path) == {"**": {"axis": [1.0, 2.0], "names": ["a"]}}
