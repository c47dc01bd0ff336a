"""Results as Markdown tables, printed and written to benchmarks/results."""

from pathlib import Path

RESULTS = Path(__file__).parent / "results"


def table(header, rows):
    """The lines of a table."""
    lines = ["| " + " | ".join(map(str, header)) + " |", "|" + "---|" * len(header)]
    lines += ["| " + " | ".join(map(str, row)) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def write_table(name, header, rows, note=""):
    """Print a table and write it to ``benchmarks/results/<name>.md``."""
    text = table(header, rows) + (f"\n{note}\n" if note else "")
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.md").write_text(text)
    print(text)


def lines_of_last_run(name):
    """Cells of the rows of ``benchmarks/results/<name>.md``, without its header."""
    lines = (RESULTS / f"{name}.md").read_text().splitlines()
    return [line[2:-2].split(" | ") for line in lines if line.startswith("| ")][1:]
