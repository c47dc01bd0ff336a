"""What MkDocs is told beyond mkdocs.yml: pages of the site whose text lies outside of docs/.

CHANGELOG, CONTRIBUTING, the README of bags/ and the tables of the benchmarks keep their places in
the repository; links to them, which are relative paths there, become links to their pages.
"""

import posixpath
import re
from pathlib import Path

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
ELSEWHERE = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md",
             "README.md": "index.md", "bags/README.md": "recordings.md",
             "benchmarks/results": "results.md"}
RESULTS = sorted((ROOT / "benchmarks" / "results").glob("*.md"))
ELSEWHERE |= {f"benchmarks/results/{file.name}": f"results/{file.name}" for file in RESULTS}
SOURCES = {page: source for source, page in ELSEWHERE.items()
           if page not in ("index.md", "results.md")}


def on_files(files, config):
    """Add the pages from elsewhere, and a list of the results."""
    for page, source in SOURCES.items():
        text = (ROOT / source).read_text()
        if page.startswith("results/"):
            text = f"# {Path(page).stem}\n\n{text}"
        files.append(File.generated(config, page, content=text))
    rows = "\n".join(f"- [{file.stem}](results/{file.name})" for file in RESULTS)
    files.append(File.generated(config, "results.md", content=(
        "# Results\n\nTables as `make bench` wrote them, one command of `benchmarks/` each.\n\n"
        f"{rows}\n")))
    return files


def on_page_markdown(markdown, page, config, files):
    """Turn links between files of the repository into links between pages of the site."""
    place = page.file.src_uri
    source = SOURCES.get(place, f"docs/{place}")

    def turned(match):
        text, target, anchor = match[1], match[2], match[3] or ""
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if path in ELSEWHERE:
            wanted = ELSEWHERE[path]
        elif path.startswith("docs/"):
            wanted = path.removeprefix("docs/")
        elif source.startswith("docs/"):
            raise PluginError(f"{source}: {path} is no page of the site; write its path as code")
        else:  # a licence, a source: the repository has it, the site has not
            return f"{text} (`{path}`)"
        return f"[{text}]({posixpath.relpath(wanted, posixpath.dirname(place) or '.')}{anchor})"

    return re.sub(r"(?<!!)\[([^\]]*)\]\(((?!\w+:|#)[^)\s#]+)(#[^)\s]*)?\)", turned, markdown)


def on_post_page(output, page, config):
    """The theme fetches its search for pages opened from a folder from elsewhere; ours is here."""
    return _own_search(output, posixpath.dirname(page.file.dest_uri))


def on_post_template(output_content, template_name, config):
    """The same for the page of broken links."""
    return _own_search(output_content, "")


def _own_search(output, folder):
    here = posixpath.relpath("file_search.js", folder or ".")
    return output.replace("https://unpkg.com/iframe-worker/shim", here)
