"""Where the data are not as the model thinks: errors, what is stated of them, and what is said.

    python -m benchmarks.misfits [PART or SITUATION ...]

Every row is a situation with known truth, simulated with 20 seeds. Says where an estimate is off by
more than three stated standard deviations, in the mean over a run, and nothing was said. With
arguments, only those rows of the table are run and replaced. Without, and as PART Smoother, the
situations of :mod:`benchmarks.smoother_misfits` come, too, in their own table.
"""

import re
import sys
from collections.abc import Sequence

from benchmarks import smoother_misfits
from benchmarks.misfits_field import FIELD_ROWS
from benchmarks.misfits_inputs import INPUT_ROWS
from benchmarks.scenarios import SEEDS, Scenario, row
from benchmarks.table import RESULTS, write_table

#: All rows, in order; whoever has more adds them here.
SCENARIOS: list[Scenario] = [*FIELD_ROWS, *INPUT_ROWS]


def main(wanted: Sequence[str]) -> None:
    """Write the table; of some rows alone, put them in the place of those of before."""
    rows, silent = ({}, {}) if not wanted else _before()
    for scenario in SCENARIOS:
        name = scenario.situation
        if wanted and not any(word in (scenario.part, name) for word in wanted):
            continue
        cells, wrong = row(scenario)
        rows[scenario.part, name] = cells
        print(" | ".join(cells), flush=True)
        silent[name] = wrong
    order = [(each.part, each.situation) for each in SCENARIOS]
    said = "; ".join(f"{name}: wrong without a word in {silent[name]} of {SEEDS} runs"
                     for part, name in order if silent.get(name))
    header = ["part", "situation", "before", "error", "stated sd", "within 3 sigma", "NEES", "said"]
    write_table("misfits", header, [rows[key] for key in order if key in rows], (
        f"Means over {SEEDS} runs each, of the estimate with --force where it is refused. Error "
        "and stated sd of the specific force at the centre of the paper's impact, in percent of "
        "it (of the angular velocity, where it flies), and of the orientation; share and NEES "
        "(three degrees of freedom) of the quantity that fits worst. "
        + (f"Wrong without a word: {said}" if said else "No row is wrong without a word.")))
    if not wanted or "Smoother" in wanted:
        smoother_misfits.main()


def _before():
    """Rows of the table as it is, by part and situation, and how many runs of each were silent."""
    text = (RESULTS / "misfits.md").read_text()
    lines = [line[2:-2].split(" | ") for line in text.splitlines()[2:] if line.startswith("| ")]
    silent = re.findall(r"(?:^|; )([^;]*): wrong without a word in (\d+) of",
                        text.rpartition("Wrong without a word: ")[2])
    return {(line[0], line[1]): line for line in lines}, {name: int(n) for name, n in silent}


if __name__ == "__main__":
    main(sys.argv[1:])
