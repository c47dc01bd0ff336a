"""Write the generated parts of README.md: parameter tables and measured results.

    python -m benchmarks.readme
"""

import importlib
import re
from pathlib import Path

from imu_fusion.nodes import NODES
from imu_fusion.nodes.base import Node
from imu_fusion.parameters import markdown_table

ROOT = Path(__file__).resolve().parent.parent
RESULTS = Path(__file__).parent / "results"
IN_README = ("orientation_broad", "orientation_speed", "replay")


def parameters():
    """One table per node, from the dataclasses that it declares."""
    parts = []
    for name in NODES:
        module = importlib.import_module(f"imu_fusion.nodes.{name}")
        (node,) = [v for v in vars(module).values() if isinstance(v, type)
                   and issubclass(v, Node) and v.__module__ == module.__name__]
        parts.append(f"<details><summary>Parameters of <code>{name}</code></summary>\n")
        parts += [markdown_table(cls) + "\n" for cls in node.PARAMETERS]
        parts.append("</details>\n")
    return "\n".join(parts)


def results():
    """The tables that the benchmarks have written."""
    parts = []
    for name in IN_README:
        file = RESULTS / f"{name}.md"
        if file.exists():
            parts.append(file.read_text().strip() + "\n")
    return "\n".join(parts)


def fill(text, name, content):
    """``text`` with the block of this name replaced."""
    pattern = re.compile(rf"(<!-- generated: {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    filled, count = pattern.subn(lambda m: m[1] + content + m[2], text)
    if count != 1:
        raise SystemExit(f"README.md has {count} blocks 'generated: {name}'")
    return filled


def main():
    """Rewrite README.md."""
    readme = ROOT / "README.md"
    text = fill(readme.read_text(), "parameters", parameters())
    readme.write_text(fill(text, "results", results()))


if __name__ == "__main__":
    main()
