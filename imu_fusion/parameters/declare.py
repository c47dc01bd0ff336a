"""Parameters of estimators and nodes: declared once, as frozen dataclasses.

Name, default, unit, bounds and meaning live in the dataclass field. ROS
parameter declarations, YAML parsing, command line help, the tables of the docs and the records
that compiled kernels read (:mod:`imu_fusion.parameters.record`) are all derived from it.

    @dataclass(frozen=True)
    class Sensor(Parameters):
        gyro_noise_density: float = param(1e-3, unit="rad/s/sqrt(Hz)", low=0, doc="...")

    @dataclass(frozen=True)
    class OrientationParams(Parameters):
        method: str = param("fusion", choices=("fusion", "gyro_mag"), doc="...")
        sensor: Sensor = Sensor()

A field that holds Parameters is a group: its parameters are ``sensor.gyro_noise_density`` in
ROS, YAML and messages, ``params.sensor.gyro_noise_density`` in Python. A field whose type allows
``None`` is *unset* by default: the estimator finds the value itself.
"""

import dataclasses
import functools
import math
import reprlib
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, NoReturn, Self, TypeGuard

from imu_fusion.errors import ParameterError


def param(default: Any = dataclasses.MISSING, *, doc: str, unit: str = "", low: float | None = None,
          high: float | None = None, choices: tuple[str, ...] | None = None,
          length: int | tuple[int, ...] | None = None, read_only: bool = True,
          path: bool = False) -> Any:
    """Declare one parameter as a dataclass field.

    Args:
        default: value when nothing is given; ``None`` means unset. Without one the
            parameter is required.
        doc: meaning, one sentence.
        unit: unit of the value as it is set.
        low, high: inclusive bounds, of every element for tuples.
        choices: permitted strings.
        length: required number of elements of a tuple, or a tuple of permitted ones.
        read_only: whether a running node refuses to change it.
        path: whether it names a file; relative ones are relative to the parameter file.
    """
    return dataclasses.field(default=default, metadata=dict(
        doc=doc, unit=unit, low=low, high=high, choices=choices, length=length,
        read_only=read_only, path=path))


@dataclasses.dataclass(frozen=True)
class ParameterInfo:
    """What is known of one parameter; ``kind`` is float, int, bool, str or tuple of one."""

    name: str
    kind: object
    element: type
    is_tuple: bool
    optional: bool
    default: object
    doc: str
    unit: str
    low: float | None
    high: float | None
    choices: tuple | None
    length: int | tuple | None
    read_only: bool
    path: bool

    def describe_bounds(self) -> str:
        """The permitted values in words, for messages and tables."""
        if self.choices:
            return "one of " + ", ".join(map(str, self.choices))
        parts = []
        if self.low is not None and self.high is not None:
            parts.append(f"{self.low:g} to {self.high:g}")
        elif self.low is not None:
            parts.append(f"at least {self.low:g}")
        elif self.high is not None:
            parts.append(f"at most {self.high:g}")
        if self.length is not None:
            lengths = self.length if isinstance(self.length, tuple) else (self.length,)
            parts.append(" or ".join(map(str, lengths)) + " elements")
        return ", ".join(parts)

    @property
    def unset(self) -> Any:
        """What stands for "unset" (or for an empty list) in ROS, which has no such values: nan, -1,
        an empty string, or a list of one of these. None where the parameter always has a value."""
        if not (self.optional or (self.is_tuple and self.length is None)):
            return None
        stand_in = {float: math.nan, int: -1, str: "", bool: None}[self.element]
        return (stand_in,) if self.is_tuple else stand_in

    def _is_unset(self, value: Any) -> bool:
        if self.optional and (value is None or value == "null"):    # rcl reads null as a string
            return True
        unset = self.unset
        if unset is None or isinstance(value, (bool, bytes)):
            return False
        if self.is_tuple:
            if isinstance(value, str) or not hasattr(value, "__len__") or len(value) != 1:
                return False
            (value,), (unset,) = value, unset
        return value == unset or (self.element is float and isinstance(value, float)
                                  and math.isnan(value))

    def check(self, value: Any, source: str = "") -> Any:
        """Return ``value`` in this parameter's type, or raise ParameterError."""
        where = f" (from {source})" if source else ""

        def refuse(why):
            bounds = self.describe_bounds()
            allowed = f"; allowed: {bounds}" if bounds else ""
            unit = f" {self.unit}" if self.unit else ""
            raise ParameterError(
                f"parameter '{self.name}'{where}: {reprlib.repr(value)} {why}{allowed}{unit}")

        if self._is_unset(value):
            return None if self.optional else ()
        if value is None:
            refuse("is not a value")
        if not self.is_tuple:
            return self._check_element(value, refuse)
        if self._may_be_one() and isinstance(value, (int, float)) and not isinstance(value, bool):
            value = (value,)
        if isinstance(value, (str, bytes)) or not hasattr(value, "__iter__"):
            refuse(f"is not a list of {self.element.__name__}")
        result = tuple(self._check_element(v, refuse) for v in value)
        if self.length is not None:
            lengths = self.length if isinstance(self.length, tuple) else (self.length,)
            if len(result) not in lengths:
                refuse(f"has {len(result)} elements")
        return result

    def _may_be_one(self) -> bool:
        """Whether a tuple of one stands for all elements: then a plain number does too."""
        return isinstance(self.length, tuple) and 1 in self.length

    def _check_element(self, value: Any, refuse: Callable[[str], NoReturn]) -> Any:
        if self.element is bool:
            if not isinstance(value, bool) and type(value).__name__ not in ("bool_", "bool"):
                refuse("is not true or false")
            return bool(value)
        if self.element is str:
            if not isinstance(value, str):
                refuse("is not a string")
            if self.choices and value not in self.choices:
                refuse("is not permitted")
            return value
        if isinstance(value, (bool, str)) or not hasattr(value, "__float__"):
            refuse(f"is not {'an integer' if self.element is int else 'a number'}")
        try:
            number = float(value)
        except OverflowError:    # an integer of hundreds of digits
            refuse("is out of bounds")
        if math.isnan(number):
            refuse("is not a number")
        if self.element is int:
            if not number.is_integer():
                refuse("is not an integer")
            number = int(value)
        if (self.low is not None and number < self.low) or (
                self.high is not None and number > self.high):
            refuse("is out of bounds")
        return number


def split_type(annotation: Any) -> tuple[Any, bool, bool]:
    """(element type, is tuple, optional) of a field's annotation."""
    optional = False
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union:
        arguments = [a for a in typing.get_args(annotation) if a is not type(None)]
        optional = True
        (annotation,) = arguments
    if typing.get_origin(annotation) is tuple:
        return typing.get_args(annotation)[0], True, optional
    return annotation, False, optional


@dataclasses.dataclass(frozen=True)
class Parameters:
    """Base of all parameter dataclasses; validates every field when made.

    ``OLD_NAMES`` maps dotted names of earlier versions to what they are called now.
    """

    OLD_NAMES: ClassVar[Mapping[str, str]] = {}

    def __post_init__(self) -> None:
        for field, kind in fields_of(type(self)):
            if not is_group(kind):
                object.__setattr__(self, field.name,
                                   _info(field, kind).check(getattr(self, field.name)))
        idle = self.idle()
        defaults = {info.name: info for info in self.infos()} if idle else {}
        for name, info in defaults.items():
            why = next((why for key, why in idle.items()
                        if name == key or (key.endswith(".") and name.startswith(key))), None)
            if why is not None and self.get(name) != info.default:
                raise ParameterError(f"parameter '{name}': does nothing {why}; leave it out")

    def idle(self) -> Mapping[str, str]:
        """Parameters that do nothing under the values chosen: dict of dotted name (or of the prefix
        of a group, ending in a dot) to the reason, as in "with method 'gyro_mag'". Set to
        anything but their default, they are refused."""
        return {}

    @classmethod
    def infos(cls) -> list[ParameterInfo]:
        """A list of ParameterInfo, in order of declaration, with dotted names."""
        result = []
        for field, kind in fields_of(cls):
            if is_group(kind):
                # The group's defaults are those of the instance that the field holds.
                default = (None if field.default is dataclasses.MISSING else field.default)
                for info in kind.infos():
                    if default is not None:
                        info = dataclasses.replace(info, default=default.get(info.name))
                    result.append(dataclasses.replace(info, name=f"{field.name}.{info.name}"))
            else:
                result.append(_info(field, kind))
        return result

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], source: str = "",
                     ignore: Sequence[str] = ()) -> Self:
        """Make parameters from a mapping, nested or with dotted names.

        Args:
            values: mapping of names to values.
            source: where they come from, for error messages.
            ignore: names (or prefixes ending in a dot) that belong to somebody else.

        Raises:
            ParameterError: unknown or missing name, wrong type, value out of bounds, or a
                parameter that does nothing.
        """
        flat = flatten(values)
        known = {info.name: info for info in cls.infos()}
        where = f" (from {source})" if source else ""
        accepted = {}
        for name, value in flat.items():
            if name in known:
                accepted[name] = known[name].check(value, source)
            elif not any(name == i or (i.endswith(".") and name.startswith(i)) for i in ignore):
                raise ParameterError(unknown_parameter(name, [cls]) + where)
        missing = [name for name, info in known.items()
                   if info.default is dataclasses.MISSING and name not in flat]
        if missing:
            raise ParameterError(f"missing parameters: {', '.join(missing)}{where}")
        try:
            return cls._made(accepted)
        except ParameterError as error:
            raise ParameterError(f"{error}{where}") from None

    @classmethod
    def _made(cls, flat: Mapping[str, Any]) -> Self:
        """From dotted names, of which the missing ones keep their defaults."""
        own = {}
        for field, kind in fields_of(cls):
            if is_group(kind):
                inner = {name.partition(".")[2]: value for name, value in flat.items()
                         if name.startswith(field.name + ".")}
                if field.default is dataclasses.MISSING:
                    own[field.name] = kind._made(inner)
                elif inner:
                    own[field.name] = field.default.replace(**inner)
            elif field.name in flat:
                own[field.name] = flat[field.name]
        return cls(**own)

    def get(self, name: str) -> Any:
        """The value of a dotted name."""
        value = self
        for part in name.split("."):
            value = getattr(value, part)
        return value

    def to_mapping(self) -> dict[str, Any]:
        """Dotted names and values, without what is unset."""
        pairs = ((info.name, self.get(info.name)) for info in self.infos())
        return {name: list(value) if isinstance(value, tuple) else value
                for name, value in pairs if value is not None}

    def replace(self, **changes: Any) -> Self:
        """A validated copy with changes, by field or by dotted name."""
        own: dict[str, Any] = {}
        inner: dict[str, dict[str, Any]] = {}
        for name, value in changes.items():
            first, dot, rest = name.partition(".")
            if dot:
                inner.setdefault(first, {})[rest] = value
            else:
                own[first] = value
        for name, values in inner.items():
            own[name] = own.get(name, getattr(self, name)).replace(**values)
        return dataclasses.replace(self, **own)


def fields_of(cls: type) -> tuple[tuple[dataclasses.Field, Any], ...]:
    """(dataclass field, its annotation) of each field, in order."""
    if cls not in _FIELDS:
        hints = typing.get_type_hints(cls)
        _FIELDS[cls] = tuple((field, hints[field.name]) for field in dataclasses.fields(cls))
    return _FIELDS[cls]


_FIELDS: dict[type, tuple[tuple[dataclasses.Field, Any], ...]] = {}


def is_group(kind: Any) -> TypeGuard[type[Parameters]]:
    """Whether an annotation is that of a group of parameters."""
    return isinstance(kind, type) and issubclass(kind, Parameters)


@functools.cache
def _info(field: dataclasses.Field, kind: Any) -> ParameterInfo:
    element, is_tuple, optional = split_type(kind)
    return ParameterInfo(name=field.name, kind=kind, element=element, is_tuple=is_tuple,
                         optional=optional, default=field.default, **field.metadata)


def unknown_parameter(name: str, classes: Iterable[type[Parameters]]) -> str:
    """What to say of a name that none of the Parameters ``classes`` has."""
    for cls in classes:
        if name in cls.OLD_NAMES:
            return f"parameter '{name}' is called '{cls.OLD_NAMES[name]}' now"
    known = sorted(info.name for cls in classes for info in cls.infos())
    return f"unknown parameter '{name}'; known: {', '.join(known)}"


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Dotted names of a nested mapping: ``{'a': {'b': 1}}`` becomes ``{'a.b': 1}``."""
    flat = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat.update(flatten(value, name + "."))
        else:
            flat[name] = value
    return flat


def markdown_table(cls: type[Parameters]) -> str:
    """The parameters of ``cls`` as the rows of a Markdown table."""
    lines = ["| parameter | default | unit | allowed | meaning |", "|---|---|---|---|---|"]
    for info in cls.infos():
        default = "unset" if info.default is None else info.default
        if isinstance(default, tuple):
            default = list(default)
        lines.append(f"| `{info.name}` | {default} | {info.unit} | "
                     f"{info.describe_bounds()} | {info.doc} |")
    return "\n".join(lines)
