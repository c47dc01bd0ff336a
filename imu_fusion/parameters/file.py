"""ROS 2 parameter files, read without ROS: the same file serves nodes and batch."""

from collections.abc import Container, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import yaml

from imu_fusion.errors import ParameterError
from imu_fusion.parameters.bounded_yaml import read_yaml
from imu_fusion.parameters.declare import Parameters, flatten, unknown_parameter

#: A parameter file, several (of which the last that names a value counts, as in ROS 2), or none.
ParamsFile: TypeAlias = str | Path | Sequence[str | Path] | None


def files_of(given: ParamsFile) -> tuple[str | Path, ...]:
    """The parameter files that were given, in order."""
    if given is None:
        return ()
    return (given,) if isinstance(given, (str, Path)) else tuple(given)


def source_of(given: ParamsFile) -> str:
    """Where parameters come from, in words for a message: the files, empty without any."""
    return ", ".join(map(str, files_of(given)))


def dump(node: str, values: dict[str, Any]) -> str:
    """The text of a parameter file that gives a node these values, by dotted name."""
    return yaml.safe_dump({node: {"ros__parameters": values}}, sort_keys=False,
                          default_flow_style=None)


def load(path: str | Path) -> dict[str, dict[str, Any]]:
    """Read a parameter file.

    Args:
        path: YAML keyed by node name (``name:``, ``/ns/name:`` or ``/**:``), each with
            ``ros__parameters``.

    Returns:
        dict of node name to (nested) parameters; wildcards under ``**``.

    Raises:
        ParameterError: not readable, not YAML, or not of that form.
    """
    path = Path(path)
    content = read_yaml(path)
    if content is None:
        return {}
    nodes: dict[str, dict[str, Any]] = {}
    for key, body in _walk(path, content):
        nodes.setdefault(key, {}).update(body)
    return nodes


def _walk(path: Path, content: Any, prefix: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    if not isinstance(content, dict):
        raise ParameterError(f"{path}: '{prefix or 'the top level'}' must map node names to "
                             "'ros__parameters'")
    for key, body in content.items():
        if isinstance(body, dict) and "ros__parameters" in body:
            name = str(key).rstrip("/").rpartition("/")[2]
            parameters = body["ros__parameters"] or {}
            if not isinstance(parameters, dict):
                raise ParameterError(f"{path}: 'ros__parameters' of '{prefix}{key}' must map names "
                                     "to values")
            yield name, parameters
        else:
            yield from _walk(path, body, f"{prefix}{key}/")


def parameters_for(classes: Sequence[type[Parameters]], node: str, path: ParamsFile = None,
                   ignore: Sequence[str] = ()) -> list[Any]:
    """The parameters of one node from a file, or its defaults without one.

    Args:
        classes: the :class:`~imu_fusion.parameters.declare.Parameters` classes of the node.
        node: node name; ``/**`` in the file applies to every node, with the names known to it.
        path: ParamsFile.
        ignore: names (or prefixes ending in a dot) that are read by somebody else.

    Returns:
        list of one object per class.

    Raises:
        ParameterError: unknown name, wrong type, value out of bounds; names the file.
    """
    if not files_of(path):
        return [cls() for cls in classes]
    known = {info.name for cls in classes for info in cls.infos()}
    old = {name for cls in classes for name in cls.OLD_NAMES}
    values = node_values(node, path, known | old)
    for name in values:
        if name not in known and not any(
                name == i or (i.endswith(".") and name.startswith(i)) for i in ignore):
            raise ParameterError(f"{unknown_parameter(name, classes)} (from {source_of(path)})")
    resolve_paths(values, classes, node, files_of(path))
    result = []
    for cls in classes:
        own = {info.name for info in cls.infos()}
        result.append(cls.from_mapping(values, source_of(path), (*ignore, *(known - own))))
    return result


def resolve_paths(values: dict[str, Any], classes: Iterable[type[Parameters]], node: str,
                  paths: Sequence[str | Path]) -> None:
    """Relative file names that parameter files set become relative to those files.

    Args:
        values: flat mapping of parameter names to values, changed in place. A file name that
            does not exist beside the parameter file stays as it is.
        classes, node: as for :func:`parameters_for`.
        paths: the parameter files that the values may come from, the last one counts.
    """
    names = {info.name for cls in classes for info in cls.infos() if info.path}
    settings = [(path, node_values(node, path, names)) for path in paths]
    for name in names:
        value = values.get(name)
        for path, own in reversed(settings):
            if value and own.get(name) == value:
                candidate = Path(path).absolute().parent / value
                if candidate.exists():
                    values[name] = str(candidate)
                break


def names_for_all(paths: Iterable[str | Path]) -> set[str]:
    """Dotted names that files give to every node (``/**``): a node passes by those that it does
    not know."""
    return {name for path in paths for name in flatten(load(path).get("**", {}))}


def node_values(node: str, path: ParamsFile, known: Container[str]) -> dict[str, Any]:
    """Names and values, dotted, that files give to a node: of ``/**`` only the known ones."""
    values: dict[str, Any] = {}
    for file in files_of(path):
        nodes = load(file)
        values.update({name: value for name, value in flatten(nodes.get("**", {})).items()
                       if name in known})
        values.update(flatten(nodes.get(node, {})))
    values.pop("use_sim_time", None)
    return values
