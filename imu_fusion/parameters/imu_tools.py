"""Parameter files of imu_tools (imu_filter_madgwick, imu_complementary_filter) in our words.

Those filters have gains where ours has noise, and switches for what ours finds by itself: what has
a counterpart is translated, and of all the rest it is said why it has none.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from imu_fusion.errors import ParameterError
from imu_fusion.parameters.declare import flatten
from imu_fusion.parameters.file import load

#: Their name: (ours, factor or None). Angles of theirs are radians.
_SAME = {"world_frame": ("world_frame", None), "fixed_frame": ("fixed_frame", None),
         "publish_tf": ("publish_tf", None), "declination": ("declination_deg", 180.0 / math.pi),
         "yaw_offset": ("alignment.yaw_offset_deg", 180.0 / math.pi),
         "remove_gravity_vector": ("remove_gravity_vector", None),
         "do_bias_estimation": ("fusion.estimate_bias", None)}
_MAG_BIAS = ("mag_bias_x", "mag_bias_y", "mag_bias_z")
_GAIN = "there is no gain: sensor.* and fusion.* state noise, and the filter weighs by it"
#: Their name: (the value that asks for nothing, why it has no counterpart).
_NONE: dict[str, tuple[Any, str]] = {
    "gain": (None, _GAIN), "zeta": (None, "no gain for the gyroscope's bias either: "
                                    "sensor.gyro_bias_walk says how fast it may drift"),
    "gain_acc": (None, _GAIN), "gain_mag": (None, _GAIN), "bias_alpha": (None, _GAIN),
    "do_adaptive_gain": (True, "accelerations are always told from gravity"),
    "orientation_stddev": (0.0, "the covariance is estimated, in imu/data"),
    "orientation_variance": (0.0, "the covariance is estimated, in imu/data"),
    "use_mag": (True, "the magnetometer is used if it is there: remap imu/mag to a topic that does "
                      "not exist to leave it out"),
    "use_magnetic_field_msg": (True, "only sensor_msgs/MagneticField is read"),
    "stateless": (False, "an orientation without the gyroscope is not made"),
    "constant_dt": (0.0, "time steps are those of the stamps"),
    "reverse_tf": (False, "the transform goes from fixed_frame to the Imu's frame"),
    "publish_debug_topics": (False, "imu/rpy/filtered is always published"),
}


@dataclass(frozen=True)
class Translation:
    """``values``: dotted names of ours to values; ``left_out``: a text for each parameter that has
    no counterpart and was not at the value that asks for nothing; ``unknown``: names that are not
    imu_tools' either."""

    values: dict[str, Any] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)


def translate(path: str) -> Translation:
    """What a parameter file of imu_tools means here.

    Raises:
        ParameterError: it cannot be read, is empty, or a value is not of its kind.
    """
    nodes = load(path)
    given = {name: value for body in nodes.values() for name, value in flatten(body).items()}
    if not given:
        raise ParameterError(f"{path}: holds no parameters; expected a node name with "
                             "ros__parameters below it, such as imu_filter:")
    return _translated(given, path)


def _translated(given: Mapping[str, Any], source: str) -> Translation:
    result = Translation()
    for name, value in given.items():
        if name in _SAME:
            ours, factor = _SAME[name]
            result.values[ours] = value if factor is None else _number(source, name, value) * factor
        elif name in _NONE:
            nothing, why = _NONE[name]
            if nothing is None or value != nothing:
                result.left_out.append(f"{name}: {value!r}: {why}")
        elif name not in _MAG_BIAS:
            result.unknown.append(name)
    if any(name in given for name in _MAG_BIAS):
        result.values["sensor.mag_offset"] = [
            _number(source, name, given.get(name, 0.0)) for name in _MAG_BIAS]
    return result


def _number(source: str, name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ParameterError(f"{source}: parameter '{name}': {value!r} is not a number")
    return float(value)
