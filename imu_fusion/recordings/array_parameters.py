"""The parameter file of the acceleration field estimator for a table of accelerometers.

The description of the table (:mod:`imu_fusion.sources.description`) also holds what the estimator
must know of each sensor, and ``parameters`` of its own.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import yaml

from imu_fusion.errors import SampleError
from imu_fusion.estimation.acceleration_field.params import AccelerometerParams, Sensor
from imu_fusion.messages.layouts import NANOSECONDS
from imu_fusion.parameters.declare import Parameters, flatten
from imu_fusion.sources import units
from imu_fusion.sources.description import Description
from imu_fusion.streams.acceleration_field import NODE, NODE_PARAMETERS, FieldConfiguration


class _Dumper(yaml.SafeDumper):
    """Quotes all strings: the parser of ROS takes a bare y, n or on for a truth value."""


_Dumper.add_representer(str, lambda dumper, text: dumper.represent_scalar(
    "tag:yaml.org,2002:str", text, style='"'))


def array_parameters(description: Description, stamps: np.ndarray, source: str) -> str:
    """The text of the parameter file.

    Args:
        description: with accelerometers. stamps: (n,) int64 ns of one of them.
        source: names the description in errors.

    Raises:
        ImuFusionError: the estimator cannot work with such sensors or parameters.
    """
    values = _values(description, stamps, source)
    # An array that cannot work is refused before anything is written.
    FieldConfiguration.from_mapping(values, source).make_estimator()
    return yaml.dump({NODE: {"ros__parameters": values}}, Dumper=_Dumper, sort_keys=False,
                     default_flow_style=None, width=100)


def _values(description: Description, stamps: np.ndarray, source: str) -> dict[str, Any]:
    """Nested ROS parameters of the estimator; the sample rate from the stamps if not given."""
    scale = units.LENGTH[description.table.position_unit]
    arrays = {}
    for name in description.array:
        params = AccelerometerParams.from_mapping(description.own[name],
                                                  f"{source}: accelerometers.{name}")
        params = params.replace(position=tuple(scale * v for v in params.position))
        arrays[name] = {"position": list(params.position), **_changed(params)}
    values: dict[str, Any] = {"accelerometers": {"names": list(arrays), **arrays}}
    flat = flatten(description.parameters)
    if "gyroscope" in description.sensors:
        gyroscope = Sensor.from_mapping(
            {f"gyro_{name}": value for name, value in description.own["gyroscope"].items()},
            f"{source}: gyroscope")
        values["use_gyro"] = True
        flat = {f"sensor.{name}": value for name, value in _changed(gyroscope).items()} | flat
    if "sample_rate" not in flat:
        step = np.median(np.diff(stamps))
        if step <= 0:
            raise SampleError("the times of the table do not increase; is time.unit right?")
        flat["sample_rate"] = float(NANOSECONDS / step)
    known = {info.name: info for cls in NODE_PARAMETERS for info in cls.infos()}
    for name, value in flat.items():
        # In the types that ROS asks for: 1 is no floating point number there.
        if name in known:
            value = known[name].check(value, "parameters")
        values[name] = list(value) if isinstance(value, tuple) else value
    return values


def _changed(params: Parameters) -> Mapping[str, Any]:
    """The parameters that differ from their defaults."""
    defaults = type(params)().to_mapping()
    return {name: value for name, value in params.to_mapping().items()
            if value != defaults.get(name)}
