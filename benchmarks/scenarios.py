"""A situation with known truth, what an estimator made of it, and the row of a table for it."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import chi2

SEEDS = 20
#: Normalised error squared that three components exceed as rarely as one does three sigma.
LIMIT = float(chi2.ppf(0.9973, 3))


@dataclass
class Outcome:
    """What one run gave: ``error`` and ``sd`` in ``unit``, root mean squares; ``nees`` mean of that
    quantity which fits worst; ``share`` of its components within 3 sigma; ``said``: texts;
    ``refused``: whether there is no estimate without --force."""

    error: float = np.nan
    sd: float = np.nan
    unit: str = ""
    nees: float = np.nan
    share: float = np.nan
    said: list[str] = field(default_factory=list)
    refused: bool = False


@dataclass(frozen=True)
class Scenario:
    """A row: ``run(seed)`` gives its Outcome; ``before`` is what it was, in words."""

    part: str
    situation: str
    before: str
    run: Callable[[int], Outcome]


def row(scenario: Scenario) -> tuple[list[str], int]:
    """Cells of a Scenario, and how many of its runs were wrong without a word."""
    runs = [scenario.run(seed) for seed in range(SEEDS)]
    said = Counter(text for run in runs for text in dict.fromkeys(_kind(t) for t in run.said))
    silent = sum(run.nees > LIMIT and not run.said for run in runs)

    def mean(name):
        values = [getattr(run, name) for run in runs if np.isfinite(getattr(run, name))]
        return f"{np.mean(values):.3g}" if values else ""

    unit = runs[0].unit
    words = "; ".join(f"{text} ({count} of {SEEDS})" for text, count in said.most_common(2))
    if any(run.refused for run in runs):
        words = f"refused in {sum(run.refused for run in runs)} of {SEEDS}: " + words
    return [scenario.part, scenario.situation, scenario.before,
            *(f"{mean(name)} {unit}" if mean(name) else "" for name in ("error", "sd")),
            mean("share"), mean("nees"), words or "nothing"], silent


def _kind(text):
    """A remark without its numbers and names, and not all of it."""
    words = text.split(": ", 1)[-1] if text.startswith(("imu", "gyroscope:")) else text
    return "".join("#" if letter.isdigit() else letter for letter in words)[:110].replace("|", "/")
