"""Several recordings beside each other: their results.json as the rows of one table."""

import csv
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from imu_fusion.errors import BagError
from imu_fusion.recordings.results import read_results
from imu_fusion.recordings.targets import refuse_files, refuse_source, whole_file

SUMMARY_FILE = "summary.csv"


def names_of(bags: Iterable[str | Path]) -> dict[str, str | Path]:
    """Names of recordings, without the endings of files, to their paths.

    Raises:
        BagError: two have the same name.
    """
    names: dict[str, str | Path] = {}
    for bag in bags:
        name = Path(os.path.realpath(bag)).stem
        if name in names:
            raise BagError(f"{bag}: called {name}, as {names[name]} is; their estimates would go "
                           "to one place. Rename one, or process them one by one")
        names[name] = bag
    return names


def refuse_sources(names: Mapping[str, str | Path], folder: Path, overwrite: bool) -> None:
    """Refuse a folder for the estimates of recordings where one of them would go with what they
    replace.

    Args:
        names: of :func:`names_of`. folder: theirs go to ``folder/NAME`` each. overwrite: whether a
            table that is there may be replaced.

    Raises:
        BagError: names what is in the way.
    """
    for name in names:
        for bag in names.values():
            refuse_source(bag, folder / name)
    refuse_files(names.values(), folder / SUMMARY_FILE)
    if (folder / SUMMARY_FILE).exists() and not overwrite:
        raise BagError(f"{folder / SUMMARY_FILE}: exists already; choose another folder or "
                       "--overwrite")


def write_summary(folder: Path, names: Iterable[str]) -> Path:
    """Write summary.csv: a row for each recording, a column for each number that was found.

    Args:
        folder: where the recordings with the estimates are. names: theirs; one that is not there
            has an empty row.

    Returns:
        the file.

    Raises:
        BagError: it cannot be written.
    """
    rows = [{"recording": name} | dict(_numbers(read_results(folder / name) or {}))
            for name in names]
    file = folder / SUMMARY_FILE
    with whole_file(file) as part:
        folder.mkdir(parents=True, exist_ok=True)
        with open(part, "w", newline="") as stream:
            writer = csv.DictWriter(stream, list(dict.fromkeys(key for row in rows for key in row)))
            writer.writeheader()
            writer.writerows(rows)
    return file


def _numbers(found: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Numbers in nested results, with their names joined by dots; of texts, how many there are."""
    for key, value in found.items():
        if key == "units":
            continue
        name = f"{above}{key}"
        if isinstance(value, Mapping):
            yield from _numbers(value, f"{name}.")
        elif isinstance(value, list) and value and isinstance(value[0], str):
            yield name, len(value)
        elif isinstance(value, list):
            yield from _numbers({str(i): v for i, v in enumerate(value)}, f"{name}.")
        elif value is not None:
            yield name, value
