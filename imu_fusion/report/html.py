"""One HTML file that opens offline: sections of text, tables and plotly figures.

A report is a list of :class:`Section`; an estimator adds its own by writing a
function that returns one. All text that comes from outside (file names, topics,
frame ids) is escaped here, once.
"""

import base64
import html
import json
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
import plotly.graph_objects

import imu_fusion
from imu_fusion.recordings.targets import whole_file

# A number with its unit, a dash for none, or nothing: columns of these are set to the right.
_NUMBER = re.compile(r"^([-+]?\d[\d.,]*(e[-+]?\d+)?( ?\S{1,4})?|–|)$")
_BEGIN = "<!DOCTYPE html>"
_SENTENCE = 40    # characters: longer cells are read, not looked up


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str

    def render(self) -> str:
        return f"<p>{html.escape(self.text)}</p>"


@dataclass(frozen=True)
class Notes:
    """A list of remarks; ``warning`` sets them apart."""

    items: tuple[str, ...]
    warning: bool = True

    def render(self) -> str:
        rows = "".join(f"<li>{html.escape(item)}</li>" for item in self.items)
        return f'<ul class="{"warning" if self.warning else "plain"}">{rows}</ul>'


@dataclass(frozen=True)
class Number:
    """One key number: what it is, its value with unit, a remark."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Numbers:
    """Key numbers side by side."""

    items: tuple[Number, ...]

    def render(self) -> str:
        cards = "".join(
            f'<div class="card"><div class="label">{html.escape(n.label)}</div>'
            f'<div class="value">{html.escape(n.value)}</div>'
            f'<div class="note">{html.escape(n.note)}</div></div>' for n in self.items)
        return f'<div class="cards">{cards}</div>'


@dataclass(frozen=True)
class Table:
    """Rows of cells (text as it shall appear) below a header; columns of numbers are set to the
    right."""

    header: tuple[str, ...]
    rows: tuple[tuple, ...]
    caption: str = ""

    def render(self) -> str:
        kinds = [self._kind(i) for i in range(len(self.header))]
        head = "".join(self._cell("th", *pair) for pair in zip(self.header, kinds))
        body = "".join("<tr>" + "".join(self._cell("td", *pair) for pair in zip(row, kinds))
                       + "</tr>" for row in self.rows)
        # Not <caption>: that is as wide as the table, of which a phone shows a part.
        caption = f'<p class="caption">{html.escape(self.caption)}</p>' if self.caption else ""
        return (f'{caption}<div class="scroll"><table><thead><tr>{head}</tr></thead>'
                f"<tbody>{body}</tbody></table></div>")

    def _kind(self, column):
        """Class of a column: of numbers, of sentences, which a narrow page must not squeeze, or
        none."""
        cells = [str(row[column]) for row in self.rows]
        if all(map(_NUMBER.match, cells)):
            return "number"
        return "prose" if max(map(len, cells)) > _SENTENCE else ""

    @staticmethod
    def _cell(tag, content, kind):
        kind = f' class="{kind}"' if kind else ""
        return f"<{tag}{kind}>{html.escape(str(content))}</{tag}>"


@dataclass(frozen=True)
class Figure:
    """A plotly figure; ``linked`` ties its time axis to those of the other figures."""

    figure: plotly.graph_objects.Figure
    caption: str = ""
    linked: bool = True

    def render(self) -> str:
        arrays: dict[bytes, int] = {}
        parts = _without_arrays(self.figure.to_plotly_json(), arrays)
        data = json.dumps(parts | {"arrays": [_packed(planes) for planes in arrays]})
        # Inside <script> only "<" could end the element or open a comment.
        data = data.replace("<", "\\u003c")
        caption = f"<figcaption>{html.escape(self.caption)}</figcaption>" if self.caption else ""
        height = int(self.figure.layout.height or 450)
        return (f'<figure><div class="plot{" linked" if self.linked else ""}" '
                f'style="height:{height}px"></div>'
                f'<script type="application/json">{data}</script>{caption}</figure>')


def _without_arrays(value, arrays):
    """JSON of plotly with {"array": k} for its arrays, which go to ``arrays``: bytes to k.

    Equal ones are kept once, as float32, all first bytes ahead of all second ones: neighbours have
    these in common, so that they pack well.
    """
    if isinstance(value, dict) and "bdata" in value:    # plotly 6 and later
        value = np.frombuffer(base64.b64decode(value["bdata"]), value["dtype"])
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiu":
        array = np.ascontiguousarray(value, dtype="<f4").reshape(-1)
        planes = array.view("u1").reshape(-1, 4).T.tobytes()
        return {"array": arrays.setdefault(planes, len(arrays))}
    if isinstance(value, dict):
        return {key: _without_arrays(part, arrays) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_arrays(part, arrays) for part in value]
    return value


def _packed(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 9)).decode()


Block = Text | Notes | Numbers | Table | Figure


@dataclass(frozen=True)
class Section:
    """A heading and what stands below it."""

    title: str
    blocks: tuple[Block, ...]


def scripts() -> str:
    """What draws the figures of a page: plotly with figures in the plane and in space, packed, and
    what unpacks it."""
    return (f'<script type="text/plain" id="plotly">{_packed(_own("plotly-gl3d.min.js").encode())}'
            f'</script>\n<script>{_own("report.js")}</script>')


def _own(name):
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def write_report(path: str | Path, title: str, sections: Sequence[Section], subtitle: str = ""
                 ) -> None:
    """Write one self-contained HTML file.

    Args:
        path: file to write; its folder is made if it is missing.
        title, subtitle: heading and the line below it.
        sections: in order.

    Raises:
        BagError: the file cannot be written, or is there and no HTML.
    """
    with whole_file(path, _BEGIN) as file:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(render_report(title, sections, subtitle), encoding="utf-8",
                        errors="backslashreplace")    # names of files may be no text


def render_report(title: str, sections: Sequence[Section], subtitle: str = "") -> str:
    """The HTML text of :func:`write_report`."""
    anchors = [re.sub(r"[^a-z0-9]+", "-", section.title.lower()).strip("-")
               for section in sections]
    links = "".join(f'<a href="#{anchor}">{html.escape(section.title)}</a>'
                    for anchor, section in zip(anchors, sections))
    body = "".join(
        f'<section id="{anchor}"><h2>{html.escape(section.title)}</h2>'
        + "".join(block.render() for block in section.blocks) + "</section>"
        for anchor, section in zip(anchors, sections))
    style = _own("report.css")
    return f"""{_BEGIN}
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{html.escape(title)}</title>
<style>{style}</style>
</head>
<body>
<header><h1>{html.escape(title)}</h1><p>{html.escape(subtitle)}</p><nav>{links}</nav></header>
<main>
<noscript><p class="warning">The figures need JavaScript; numbers and tables do not.</p></noscript>
{body}
</main>
<footer>Written by imu_fusion {imu_fusion.__version__}. The figures show the greatest and least
value of every stretch of a long signal; drag to zoom, double-click to go back: the time axes
move together.</footer>
{scripts()}
</body>
</html>
"""
