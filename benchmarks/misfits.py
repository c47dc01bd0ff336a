"""Where the data are not as the model thinks: errors, what is stated of them, and what is said.

    python -m benchmarks.misfits [PART or SITUATION ...]

Every row is a situation with known truth, simulated with 20 seeds. Says where an estimate is off by
more than three stated standard deviations, in the mean over a run, and nothing was said. Without
arguments, and as PART Smoother, the situations of :mod:`benchmarks.smoother_misfits` come, too, in
their own table.
"""

import sys
from collections.abc import Sequence

from benchmarks import smoother_misfits
from benchmarks.misfits_field import FIELD_ROWS
from benchmarks.misfits_inputs import INPUT_ROWS
from benchmarks.scenarios import SEEDS, Scenario, row
from benchmarks.table import write_table

#: All rows, in order; whoever has more adds them here.
SCENARIOS: list[Scenario] = [*FIELD_ROWS, *INPUT_ROWS]


def main(wanted: Sequence[str]) -> None:
    """Write the table; of some rows alone, print it only in part."""
    rows, silent = [], []
    for scenario in SCENARIOS:
        if wanted and not any(word in (scenario.part, scenario.situation) for word in wanted):
            continue
        cells, wrong = row(scenario)
        rows.append(cells)
        print(" | ".join(cells), flush=True)
        if wrong:
            silent.append(f"{scenario.situation}: wrong without a word in {wrong} of {SEEDS} runs")
    header = ["part", "situation", "before", "error", "stated sd", "within 3 sigma", "NEES", "said"]
    if not wanted:
        write_table("misfits", header, rows, (
            f"Means over {SEEDS} runs each, of the estimate with --force where it is refused. Error "
            "and stated sd of the specific force at the centre of the paper's impact, in percent of "
            "it (of the angular velocity, where it flies), and of the orientation; share and NEES (three degrees of freedom) of the quantity "
            "that fits worst. " + ("Wrong without a word: " + "; ".join(silent) if silent
                                   else "No row is wrong without a word.")))
    for text in silent:
        print(text)
    if not wanted or "Smoother" in wanted:
        smoother_misfits.main()


if __name__ == "__main__":
    main(sys.argv[1:])
