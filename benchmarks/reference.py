"""Write the pages of docs/ that say what the code says: parameters, conventions, rooms, picture.

    python -m benchmarks.reference

A test (test/test_docs.py) fails where a page is not what this writes.
"""

import importlib
import re
from pathlib import Path

import imu_fusion
from benchmarks import architecture
from benchmarks.readme import fill
from imu_fusion.estimation.acceleration_field.params import AccelerometerParams
from imu_fusion.nodes import NODES
from imu_fusion.nodes.base import Node
from imu_fusion.parameters.declare import fields_of, is_group, markdown_table

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
WRITTEN_BY = "<!-- written by python -m benchmarks.reference -->\n"
# Parameters of single sensors, of which there may be any number: prefix to class.
PER_SENSOR = {"acceleration_field_estimator": {"accelerometers.<name>.": AccelerometerParams}}


def node_class(name):
    """The Node class in the module of a node."""
    module = importlib.import_module(f"imu_fusion.nodes.{name}")
    (node,) = [v for v in vars(module).values() if isinstance(v, type)
               and issubclass(v, Node) and v.__module__ == module.__name__]
    return node


def _first_paragraph(text):
    """The first paragraph of a docstring on one line, as Markdown."""
    return " ".join((text or "").strip().split("\n\n")[0].split()).replace("``", "`")


def parameters(name):
    """The page of one node's parameters."""
    node = node_class(name)
    parts = [WRITTEN_BY, f"# Parameters of {name}\n", f"{_first_paragraph(node.__doc__)}\n",
             "How they are set: [Parameters](../parameters.md).\n"]
    for cls in node.PARAMETERS:
        parts += [f"## {_title(cls)}\n", f"{_first_paragraph(cls.__doc__)}\n", *_tables(cls)]
    for prefix, cls in PER_SENSOR.get(name, {}).items():
        parts += [f"## {_title(cls)}\n", f"{_first_paragraph(cls.__doc__)}\n",
                  markdown_table(cls).replace("| `", f"| `{prefix}") + "\n"]
    return "\n".join(parts)


def _tables(cls):
    """The table of the parameters at the top level, and under a heading that of each group."""
    first, second, *rows = markdown_table(cls).splitlines()
    groups = {field.name: kind for field, kind in fields_of(cls) if is_group(kind)}
    parts = []
    for name in (None, *groups):
        own = [row for row, info in zip(rows, cls.infos())
               if (info.name.split(".")[0] if "." in info.name else None) == name]
        if name and own:
            parts += [f"### {name}\n", f"{_first_paragraph(groups[name].__doc__)}\n"]
        if own:
            parts.append("\n".join([first, second, *own]) + "\n")
    return parts


def renamed():
    """The page of parameters that have been renamed."""
    parts = [WRITTEN_BY, "# Renamed parameters\n",
             "A parameter file with an old name is refused, with the new one.\n"]
    for name in NODES:
        names = {old: new for cls in node_class(name).PARAMETERS
                 for old, new in cls.OLD_NAMES.items()}
        if names:
            # Where there are two new names, with words between them, the names are in quotes.
            rows = [f"| `{old}` | `{new}` |".replace("' ", "` ").replace(" '", " `")
                    for old, new in sorted(names.items())]
            parts += [f"## {name}\n",
                      "\n".join(["| until 0.1.0 | now |", "|---|---|", *rows]) + "\n"]
    return "\n".join(parts)


def _title(cls):
    """OrientationOutputParams: Orientation output."""
    words = re.findall("[A-Z][a-z]*", cls.__name__.removesuffix("Params"))
    return " ".join(words).capitalize()


def conventions():
    """The page of conventions: the docstring of the package."""
    lines = [WRITTEN_BY, "# Conventions\n",
             "Used everywhere in the package. This page is the docstring of "
             "`imu_fusion/__init__.py`.\n"]
    _, _, body = imu_fusion.__doc__.partition("====\n")
    for block in body.lstrip("=\n").split("\n\n"):
        title, *text = block.strip("\n").split("\n")
        lines.append(f"## {title.strip()}\n")
        lines += [line.strip().replace("``", "`") for line in text] + [""]
    return "\n".join(lines)


def rooms():
    """Table of the rooms and what they are for."""
    lines = ["| room | what it is |", "|---|---|"]
    lines += [f"| `{name}` | {about} |" for name, about in architecture.rooms().items()]
    return "\n".join(lines) + "\n"


def pages():
    """dict of path to the text that belongs there."""
    found = {DOCS / "parameters" / f"{name}.md": parameters(name) for name in NODES}
    found[DOCS / "parameters" / "renamed.md"] = renamed()
    found[DOCS / "conventions.md"] = conventions()
    found[DOCS / "images" / "architecture.svg"] = architecture.svg()
    page = DOCS / "architecture.md"
    found[page] = fill(page.read_text(), "rooms", rooms())
    return found


def main():
    """Write them, and remove pages of nodes that are no more."""
    written = pages()
    for path in (DOCS / "parameters").glob("*.md"):
        if path not in written:
            path.unlink()
    for path, text in written.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


if __name__ == "__main__":
    main()
