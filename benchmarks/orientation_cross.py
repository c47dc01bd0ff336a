"""Defaults of the orientation estimator chosen on some sets and judged on the others.

    python -m benchmarks.orientation_cross [--quick]

Every choice of GRID runs on every set of ``benchmarks.orientation_sets``. For each family of sets
(recordings of one origin) the choice is the one that does best on all the other families: least
mean of log(ours / peer) over causal and smoothed. The table has what that choice does on the family
left out, beside the package's defaults and the peers.
"""

import itertools
import math
import sys

import numpy as np

from benchmarks.orientation_sets import SETS, peers, score_ours
from benchmarks.table import write_table
from imu_fusion.estimation.orientation.params import OrientationParams

GRID = {"fusion.velocity_walk": (0.1, 0.14, 0.2), "fusion.gyro_factor": ((1.0,), (1.0, 5.0))}
FAMILIES = {"BROAD": [name for name in SETS if name.startswith("BROAD")],
            "DIODEM": ["DIODEM"], "phones": [name for name in SETS if name.startswith("phones")],
            "OpenAXES": ["OpenAXES, no magnetometer"]}
_MODES = ("causal", "smoothed")
_MOST = 3    # recordings of a set, evenly spaced: a choice for every recording takes an hour


def choices():
    """All of GRID: dicts of parameters."""
    return [dict(zip(GRID, values)) for values in itertools.product(*GRID.values())]


def _some(name, quick):
    recordings = list(SETS[name]())
    return recordings[::-(-len(recordings) // (1 if quick else _MOST))]


def totals(name, changes, quick):
    """Mean total errors of a set, deg: {mode: ours}, with parameters changed."""
    found = [score_ours(r, changes) for r in _some(name, quick)]
    return {mode: float(np.mean([s[mode].total for s in found])) for mode in _MODES}


def _peer_totals(name, quick):
    found = [peers(r) for r in _some(name, quick)]
    return {mode: float(np.mean([s[peer].total for s in found]))
            for mode, peer in zip(_MODES, ("VQF", "OfflineVQF"))}


def _loss(scores, peer, names):
    """Mean log of the error over the peer's, over sets and modes."""
    return float(np.mean([math.log(scores[name][mode] / peer[name][mode])
                          for name in names for mode in _MODES]))


def main(arguments):
    quick = "--quick" in arguments
    peer = {name: _peer_totals(name, quick) for names in FAMILIES.values() for name in names}
    tried = []
    for changes in choices():
        tried.append((changes, {name: totals(name, changes, quick) for name in peer}))
        print(changes, {n: {m: round(v, 2) for m, v in s.items()} for n, s in tried[-1][1].items()},
              flush=True)
    usual = OrientationParams().fusion
    default = next(scores for changes, scores in tried if all(
        getattr(usual, key.split(".")[1]) == value for key, value in changes.items()))
    rows = []
    for names in FAMILIES.values():
        others = [name for name in peer if name not in names]
        changes, scores = min(tried, key=lambda one: _loss(one[1], peer, others))
        for name in names:
            cells = [f"{group[name]['causal']:.2f} / {group[name]['smoothed']:.2f}"
                     for group in (peer, scores, default)]
            rows.append([name, ", ".join(f"{key.split('.')[1]} {value}"
                                         for key, value in changes.items()), *cells])
    if quick:
        for row in rows:
            print(" | ".join(row))
        return
    write_table("orientation_cross", ["set", "chosen on the other families",
                                      "VQF / OfflineVQF, deg", "ours, so chosen",
                                      "ours, defaults"], rows,
                note=f"Causal / smoothed, mean total error of up to {_MOST} recordings of each "
                "set. " + "; ".join(
                    f"{key}: {', '.join(map(str, values))}" for key, values in GRID.items()) + ".")


if __name__ == "__main__":
    main(sys.argv[1:])
