"""Write the generated parts of README.md: parameter tables and measured results.

    python -m benchmarks.readme
"""

import importlib
import re
from pathlib import Path

from imu_fusion.nodes import NODES
from imu_fusion.nodes.base import Node
from imu_fusion.parameters.declare import markdown_table

ROOT = Path(__file__).resolve().parent.parent
RESULTS = Path(__file__).parent / "results"
IN_README = {
    "orientation_broad": "Orientation on BROAD (9 trials, optical reference)",
    "orientation_clipping": "Saturated gyroscopes",
    "orientation_vehicles": "Tilt on a car and an aeroplane",
    "orientation_speed": "Speed of the orientation step",
    "replay": "Ten minutes at rate 0 through replayer, orientation_estimator and recorder",
    "acceleration_field_independent": "Acceleration field of the simulated impact, independent noise",
    "acceleration_field_clipped": "Clipped gyroscopes filled in by accelerometers (real data)",
    "smoother_jump": "Simulated ski jump",
    "smoother_drive": "Car drive against RTK"}


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


def _command(name):
    """The module of benchmarks/ that writes this table."""
    for file in sorted(Path(__file__).parent.glob("*.py")):
        if file.stem == name:
            return name
    (file,) = [f for f in Path(__file__).parent.glob("*.py")
               if f.stem != "readme" and f'"{name}' in f.read_text()]
    return file.stem


def results():
    """The tables that the benchmarks have written."""
    parts = []
    for name, title in IN_README.items():
        file = RESULTS / f"{name}.md"
        if file.exists():
            parts.append(f"### {title}\n\n`python -m benchmarks.{_command(name)}`\n")
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
