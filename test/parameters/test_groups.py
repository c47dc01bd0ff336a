"""Groups of parameters: dotted names, old names, parameters that do nothing, records of kernels."""

from dataclasses import dataclass

import numpy as np
import pytest

from imu_fusion.errors import ParameterError
from imu_fusion.kernels import njit
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.parameters.record import record
from imu_fusion.sensors.params import sensor


@dataclass(frozen=True)
class Sensor(Parameters):
    gyro_noise_density: float = sensor("gyro_noise_density", 3e-4)
    gyro_range: tuple[float, ...] | None = sensor("gyro_range", None)


@dataclass(frozen=True)
class Example(Parameters):
    OLD_NAMES = {"gyro_range": "sensor.gyro_range"}

    method: str = param("fast", choices=("fast", "slow"), doc="How.")
    steps: int = param(3, low=1, doc="How many.")
    careful: bool = param(True, doc="Whether.")
    sensor: Sensor = Sensor(gyro_noise_density=1e-3)

    def idle(self):
        return {"steps": "with method 'slow'"} if self.method == "slow" else {}


def test_a_group_keeps_the_defaults_of_its_holder():
    found = {info.name: info.default for info in Example.infos()}
    assert found["sensor.gyro_noise_density"] == 1e-3
    assert Example().sensor.gyro_noise_density == 1e-3
    assert Example.from_mapping({"sensor.gyro_range": [2.0]}).sensor == Sensor(1e-3, (2.0,))


def test_nested_and_dotted_names_are_the_same():
    nested = Example.from_mapping({"sensor": {"gyro_range": [1.0, 2.0, 3.0]}, "steps": 4})
    assert nested == Example.from_mapping({"sensor.gyro_range": [1.0, 2.0, 3.0], "steps": 4})
    assert nested.get("sensor.gyro_range") == (1.0, 2.0, 3.0)
    assert Example.from_mapping(nested.to_mapping()) == nested
    assert nested.replace(**{"sensor.gyro_range": None, "steps": 3}) == Example()


@pytest.mark.parametrize("values, text", [
    ({"gyro_range": 1.0}, "'gyro_range' is called 'sensor.gyro_range' now"),
    ({"method": "slow", "steps": 5}, "'steps': does nothing with method 'slow'; leave it out"),
    ({"sensor.gyro_noise": 1.0}, "unknown parameter 'sensor.gyro_noise'; known: .*sensor.gyro_ran"),
    ({"sensor": {"gyro_range": [0.0]}}, r"'sensor.gyro_range'.*\[0.0\] is out of bounds"),
])
def test_wrong_names_are_refused_with_the_remedy(values, text):
    with pytest.raises(ParameterError, match=text) as error:
        Example.from_mapping(values, "some.yaml")
    assert "(from some.yaml)" in str(error.value)


def test_a_default_that_does_nothing_may_be_given():
    """A dump of all parameters can be loaded again."""
    assert Example.from_mapping({"method": "slow", "steps": 3}).method == "slow"


@njit
def _read(par):
    p = par[0]
    return (p.sensor.gyro_noise_density, p.sensor.gyro_range[1], p.steps, p.careful,
            p.frame[2])


def test_kernels_read_the_record_by_name():
    values = _read(record(Example.from_mapping({"sensor.gyro_range": [2.0]}), frame=np.arange(3.0)))
    assert values == (1e-3, 2.0, 3, True, 2.0)
    assert np.isnan(_read(record(Example(), frame=np.zeros(3)))[1])


@dataclass(frozen=True)
class Words(Parameters):
    name: str = param("a", doc="What it is called.")


@dataclass(frozen=True)
class Named(Parameters):
    words: Words = Words()
    steps: int = param(3, doc="How many.")


@njit
def _steps(par):
    return par[0].steps


def test_a_group_of_words_is_no_part_of_the_record():
    """numpy 1.26, which is Ubuntu 24.04's, dies of an empty record in it: the whole process."""
    found = record(Named())
    assert found.dtype.names == ("steps",) and _steps(found) == 3
