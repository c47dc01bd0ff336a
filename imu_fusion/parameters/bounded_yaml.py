"""YAML from anybody: read within bounds of size, depth and repetition, or refused by name.

``yaml.safe_load`` makes no objects of foreign classes, but it follows a file of a few hundred
bytes into a recursion without end (a node inside itself, brackets nested a thousandfold) or, by
aliases of aliases, to billions of values.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from imu_fusion.errors import ParameterError

MAX_BYTES = 8 * 2**20   # the metadata of a recording of thousands of files
MAX_DEPTH = 32
MAX_VALUES = 300_000    # with every alias counted as often as it stands for something

_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_Base):
    """Also reads lists as launch_ros writes them into the files that it makes: as tuples."""

    def construct_tuple(self, node: yaml.SequenceNode) -> list[Any]:
        return self.construct_sequence(node)


_Loader.add_constructor("tag:yaml.org,2002:python/tuple", _Loader.construct_tuple)


def read_yaml(path: str | Path) -> Any:
    """The content of a YAML file: None if it is empty.

    Raises:
        ParameterError: it cannot be read, is not YAML, or exceeds the bounds.
    """
    try:
        if (size := Path(path).stat().st_size) > MAX_BYTES:
            raise ParameterError(f"{path}: {size} bytes are no description in YAML; at most "
                                 f"{MAX_BYTES >> 20} MB are read")
        data = Path(path).read_bytes()
    except (OSError, ValueError) as error:    # ValueError: a name that no file can have
        if isinstance(error, ParameterError):
            raise
        raise ParameterError(f"{path}: cannot be read ({getattr(error, 'strerror', error)})"
                             ) from None
    return parse_yaml(data, str(path))


def parse_yaml(data: bytes | str, source: str) -> Any:
    """The content of YAML text.

    Args:
        data: the text.
        source: what is named in errors.

    Raises:
        ParameterError: it is not YAML, or exceeds the bounds.
    """
    try:
        _check_size(yaml.parse(data, _Loader), source)
        loader = _Loader(data)
        try:
            node = loader.get_single_node()
            _refuse_repeated_keys(node, source)
            return None if node is None else loader.construct_document(node)
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        raise ParameterError(f"{source}: is not YAML: {_one_line(error)}") from None
    # A date that is none, an integer of thousands of digits, a key that is a list.
    except (ValueError, TypeError, ArithmeticError, RecursionError) as error:
        if isinstance(error, ParameterError):
            raise
        raise ParameterError(f"{source}: a value in it cannot be read ({_one_line(error)})"
                             ) from None


def _check_size(events: Iterable[yaml.Event], source: str) -> None:
    """Refuse, before anything is made of it, what is nested too deep or stands for too much."""
    counts = [0]              # values in each open node, the document first
    names: list[str | None] = [None]
    known: dict[str, int] = {}
    for event in events:
        if isinstance(event, yaml.AliasEvent):
            if event.anchor in names:
                raise ParameterError(f"{source}: '*{event.anchor}' contains itself")
            counts[-1] += known.get(str(event.anchor), 1)
        elif isinstance(event, yaml.CollectionStartEvent):
            counts.append(1)
            names.append(event.anchor)
        elif isinstance(event, yaml.CollectionEndEvent):
            count, name = counts.pop(), names.pop()
            counts[-1] += count
            if name is not None:
                known[name] = count
        elif isinstance(event, yaml.ScalarEvent):
            counts[-1] += 1
        if len(counts) > MAX_DEPTH:
            raise ParameterError(f"{source}: nested deeper than {MAX_DEPTH} levels")
        if counts[-1] > MAX_VALUES:
            raise ParameterError(f"{source}: stands for more than {MAX_VALUES} values")


def _refuse_repeated_keys(node: yaml.Node | None, source: str) -> None:
    """YAML forbids a key twice; most readers take the last, whichever was meant."""
    todo, done = [node], set()
    while todo:
        node = todo.pop()
        if node is None or id(node) in done:
            continue
        done.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            todo += node.value
        elif isinstance(node, yaml.MappingNode):
            seen = set()
            for key, value in node.value:
                if isinstance(key, yaml.ScalarNode):
                    if key.value in seen and key.value != "<<":
                        raise ParameterError(f"{source}, line {key.start_mark.line + 1}: the key "
                                             f"'{key.value[:80]}' stands here twice")
                    seen.add(key.value)
                todo += (key, value)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]
