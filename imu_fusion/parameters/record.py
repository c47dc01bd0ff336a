"""Parameters as compiled kernels read them: one-element structured arrays.

The dtype follows from the dataclass, so a parameter is declared in one place; it is part of a
kernel's signature, so a changed declaration compiles anew.
"""

from typing import Any

import numpy as np

from imu_fusion.parameters.declare import Parameters, fields_of, is_group, split_type

_DTYPES: dict[type[Parameters], np.dtype] = {}


def record_dtype(cls: type[Parameters]) -> np.dtype:
    """The structured dtype of a Parameters class.

    float: f8, nan where unset; int: i8; bool: bool; a tuple of numbers: an array of its (largest)
    length, nan where unset, one value standing for all; a group: a nested record. Strings,
    tuples without a length, unset integers and groups of nothing else are for the estimator, not
    for its kernel: left out.
    """
    if cls in _DTYPES:
        return _DTYPES[cls]
    fields: list[tuple[Any, ...]] = []
    for field, kind in fields_of(cls):
        if is_group(kind):
            # An empty record inside of an aligned one ends numpy 1.26 by a division by zero.
            if record_dtype(kind).names:
                fields.append((field.name, record_dtype(kind)))
            continue
        element, is_tuple, optional = split_type(kind)
        length = field.metadata["length"]
        if element is str or (is_tuple and length is None) or (optional and element is not float):
            continue
        size = (max(length) if isinstance(length, tuple) else length,) if is_tuple else ()
        fields.append((field.name, {float: "f8", int: "i8", bool: "?"}[element], size))
    return _DTYPES.setdefault(cls, np.dtype(fields, align=True))


def record(params: Parameters, **derived: Any) -> np.ndarray:
    """Parameters as a one-element array of :func:`record_dtype`.

    Args:
        params: parameters.
        derived: further fields, name to float, int or array, behind those of the dataclass: what
            the estimator works out from the parameters for its kernel.
    """
    dtype = record_dtype(type(params))
    if derived:
        values = {name: np.asarray(value) for name, value in derived.items()}
        dtype = np.dtype([*((name, dtype[name]) for name in dtype.names or ()),
                          *((name, v.dtype, v.shape) for name, v in values.items())], align=True)
        result = np.zeros(1, dtype)
        for name, v in values.items():
            result[name][0] = v
    else:
        result = np.zeros(1, dtype)
    _fill(result, params)
    return result


def _fill(target: Any, params: Parameters) -> None:
    for name in record_dtype(type(params)).names or ():
        value = getattr(params, name)
        if isinstance(value, Parameters):
            _fill(target[name], value)
        else:
            target[name] = np.nan if value is None else value
