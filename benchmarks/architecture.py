"""Draw the picture of the architecture from what the rooms of the package really import.

    python -m benchmarks.architecture

Writes docs/images/architecture.svg: one box per room of ``imu_fusion/``, in layers; an arrow from
a room to each one it imports, except where a chain of other arrows says so already.
"""

import ast
import re
from html import escape
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "imu_fusion"
TARGET = ROOT / "docs" / "images" / "architecture.svg"

BOX_HEIGHT, LAYER_STEP, GAP, MARGIN = 34, 68, 26, 16  # px
CHARACTER = 8.2  # px, width of one of the labels
# Enough for the orders and places to settle.
SWEEPS = 24


def rooms():
    """dict of room (module or folder directly below imu_fusion/) to what its docstring calls it.

    That is its first sentence.
    """
    found = {}
    for path in sorted(PACKAGE.iterdir()):
        file = path / "__init__.py" if path.is_dir() else path
        if file.suffix != ".py" or not file.exists() or path.name == "__init__.py":
            continue
        text = ast.get_docstring(ast.parse(file.read_text())) or ""
        found[path.stem] = re.split(r"\.(?:\s|$)", " ".join(text.split()))[0].replace("``", "`")
    return found


def imports(names):
    """dict of room to the set of other rooms that it imports, anywhere in its files."""
    result = {}
    for name in names:
        path = PACKAGE / name
        files = sorted(path.rglob("*.py")) if path.is_dir() else [PACKAGE / f"{name}.py"]
        dotted = {target for file in files for target in _imported(file)}
        result[name] = {n for n in names if f"imu_fusion.{n}" in dotted} - {name}
    return result


def _imported(file):
    """Dotted names, down to the room, that a file imports."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (".".join(alias.name.split(".")[:2]) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield ".".join(node.module.split(".")[:2])
            if node.module == "imu_fusion":
                yield from (f"imu_fusion.{alias.name}" for alias in node.names)


def heights(graph):
    """dict of room to its layer: 0 imports nothing, others stand above all that they import.

    Raises:
        ValueError: the imports go in a circle.
    """
    result = {}

    def height(name, below):
        if name in below:
            raise ValueError(f"imports go in a circle: {' -> '.join([*below, name])}")
        if name not in result:
            result[name] = 1 + max((height(n, (*below, name)) for n in graph[name]), default=-1)
        return result[name]

    for name in graph:
        height(name, ())
    return result


def reduced(graph):
    """The arrows that no chain of other arrows says."""
    def reach(name):
        return graph[name].union(*(reach(n) for n in graph[name]))

    return {name: {n for n in targets
                   if not any(n in reach(other) for other in targets - {n})}
            for name, targets in graph.items()}


def layers(arrows, height):
    """Rows of points from the bottom up, and the chain of points of every arrow.

    A point is a room or, where an arrow passes a row, a pair (from, to). Rows are ordered so
    that arrows cross little: every point moves to the mean place of its neighbours.
    """
    rows = [[name for name in arrows if height[name] == h] for h in range(max(height.values()) + 1)]
    chains = []
    for name, targets in arrows.items():
        for target in sorted(targets):
            passed = range(height[name] - 1, height[target], -1)
            for h in passed:
                rows[h].append((name, target))
            chains.append([name, *[(name, target, h) for h in passed], target])
    rows = [[(*point, h) if isinstance(point, tuple) else point for point in row]
            for h, row in enumerate(rows)]
    neighbours = {point: [] for row in rows for point in row}
    for chain in chains:
        for upper, lower in pairwise(chain):
            neighbours[upper].append(lower)
            neighbours[lower].append(upper)
    for sweep in range(SWEEPS):
        for row in rows if sweep % 2 else rows[::-1]:
            place = {p: i / max(len(r) - 1, 1) for r in rows for i, p in enumerate(r)}
            row.sort(key=lambda p, place=place: (
                sum(place[n] for n in neighbours[p]) / max(len(neighbours[p]), 1)))
    return rows, chains, neighbours


def width(point):
    """Width of a point's box, px; a passing arrow needs little."""
    return 10 if isinstance(point, tuple) else 24 + CHARACTER * len(point)


def places(rows, neighbours):
    """dict of point to the x of its centre, px: near its neighbours, apart from those beside it."""
    x = {}
    for row in rows:
        edge = 0.0
        for point in row:
            x[point] = edge + width(point) / 2
            edge += width(point) + GAP
    for sweep in range(SWEEPS):
        for row in rows if sweep % 2 else rows[::-1]:
            wanted = [sum(x[n] for n in neighbours[p]) / max(len(neighbours[p]), 1) for p in row]
            # Pushed apart from the left, and from the right: the mean of both stands between.
            left, right = list(wanted), list(wanted)
            for i in range(1, len(row)):
                apart = (width(row[i - 1]) + width(row[i])) / 2 + GAP
                left[i] = max(left[i], left[i - 1] + apart)
                right[-i - 1] = min(right[-i - 1], right[-i] - (
                    (width(row[-i - 1]) + width(row[-i])) / 2 + GAP))
            x.update(zip(row, ((a + b) / 2 for a, b in zip(left, right))))
    first = min(x[p] - width(p) / 2 for p in x)
    return {point: value - first + MARGIN for point, value in x.items()}


def svg():
    """The picture as text."""
    about = rooms()
    graph = imports(about)
    height = heights(graph)
    rows, chains, neighbours = layers(reduced(graph), height)
    x = places(rows, neighbours)
    y = {point: MARGIN + (len(rows) - 1 - h) * LAYER_STEP for h, row in enumerate(rows)
         for point in row}
    across = max(x[p] + width(p) / 2 for p in x) + MARGIN
    down = max(y.values()) + BOX_HEIGHT + MARGIN
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {across:.0f} {down:.0f}" '
             f'width="{across:.0f}" height="{down:.0f}" font-family="ui-monospace, monospace" '
             'font-size="13">',
             "<title>Rooms of imu_fusion and what they import</title>",
             '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
             'markerHeight="7" orient="auto"><path d="M0 0.5 L8 4 L0 7.5 z" fill="#52606d"/>'
             "</marker></defs>", '<rect width="100%" height="100%" fill="#ffffff"/>']
    parts += [f'<path d="{_curve(chain, x, y)}" fill="none" stroke="#7b8794" '
              'stroke-width="1.2" marker-end="url(#tip)"/>' for chain in chains]
    for point in (p for row in rows for p in row if not isinstance(p, tuple)):
        left = x[point] - width(point) / 2
        parts.append(
            f'<g><title>{escape(about[point])}</title><rect x="{left:.1f}" y="{y[point]:.1f}" '
            f'width="{width(point):.1f}" height="{BOX_HEIGHT}" rx="5" fill="#e3f1fb" '
            f'stroke="#0071b2"/><text x="{x[point]:.1f}" y="{y[point] + 22:.1f}" '
            f'text-anchor="middle" fill="#1f2933">{escape(point)}</text></g>')
    return "\n".join([*parts, "</svg>", ""])


def _curve(chain, x, y):
    """The path of an arrow, from the lower edge of its room to the upper edge of its target."""
    start, *middle, end = chain
    points = [(x[start], y[start] + BOX_HEIGHT)]
    for point in middle:
        points += [(x[point], y[point]), (x[point], y[point] + BOX_HEIGHT)]
    points.append((x[end], y[end] - 1))
    path = f"M{points[0][0]:.1f} {points[0][1]:.1f}"
    for k, ((x0, y0), (x1, y1)) in enumerate(pairwise(points)):
        if k % 2:  # past the boxes of a row
            path += f" L{x1:.1f} {y1:.1f}"
        else:
            half = (y1 - y0) / 2
            path += f" C{x0:.1f} {y0 + half:.1f} {x1:.1f} {y1 - half:.1f} {x1:.1f} {y1:.1f}"
    return path


def main():
    """Write docs/images/architecture.svg."""
    TARGET.parent.mkdir(parents=True, exist_ok=True)
    TARGET.write_text(svg())
    print(TARGET.relative_to(ROOT))


if __name__ == "__main__":
    main()
