"""Defaults of the orientation estimator chosen on some sets and judged on the others.

    python -m benchmarks.orientation_cross [--quick]

Every choice of GRID runs on sets of ``benchmarks.orientation_sets``. For each
family of sets (recordings of one origin) the choice is the one that does best on all the other
families: least mean of log(ours / peer) over causal and smoothed. The table has what that choice
does on the family left out, beside the package's defaults and the peers.
"""

import itertools
import math
import sys
from dataclasses import replace
from importlib.metadata import version

import numpy as np

from benchmarks.orientation_sets import SETS, peers, score_ours
from benchmarks.table import write_table
from imu_fusion.estimation.orientation.params import OrientationParams

GRID = {"velocity_walk": (0.14, 0.2), "local_field_sd": ((0.01,), (0.01, 0.1)),
        "gyro_factor": ((1.0,), (1.0, 5.0))}
"""Parameters of fusion.*: one hypothesis or both, and how much of the motion is not told."""
FAMILIES = {"BROAD": ["BROAD", "BROAD, start in motion"],
            "DIODEM": ["DIODEM"], "phones": [name for name in SETS if name.startswith("phones")],
            "OpenAXES": ["OpenAXES, no magnetometer"]}
_MODES = ("causal", "smoothed")
# Recordings of a set, evenly spaced, and s of each: all of them, for every choice, take an hour.
_MOST, _LONGEST = 2, 100.0


def choices():
    """All of GRID: dicts of parameters."""
    return [dict(zip(GRID, values)) for values in itertools.product(*GRID.values())]


def _shortened(r):
    """The first part of a recording."""
    end = int(np.searchsorted(r.imu.stamp, r.imu.stamp[0] + int(_LONGEST * 1e9)))
    mag = None if r.mag is None else r.mag[r.mag.stamp <= r.imu.stamp[end - 1]]
    return replace(r, imu=r.imu[:end], mag=mag, reference=r.reference[:end], mask=r.mask[:end])


def _totals(recordings, run, names):
    """Mean total error, deg, and share within 3 sigma of recordings by mode; names: of the modes in
    what ``run`` gives of one."""
    found = [run(r) for r in recordings]
    return {mode: tuple(float(np.mean([getattr(s[name], part) for s in found]))
                        for part in ("total", "within")) for mode, name in zip(_MODES, names)}


def _loss(scores, peer, names):
    """Mean log of the error over the peer's, over sets and modes."""
    return float(np.mean([math.log(scores[name][mode][0] / peer[name][mode][0])
                          for name in names for mode in _MODES]))


def _cell(scores):
    error, within = zip(*(scores[mode] for mode in _MODES))
    shares = "" if math.isnan(within[0]) else f" ({within[0]:.2f} / {within[1]:.2f})"
    return f"{error[0]:.2f} / {error[1]:.2f}" + shares


def _told(changes):
    return ", ".join(f"{key} {' '.join(map(str, np.atleast_1d(value)))}"
                     for key, value in changes.items())


def main(arguments):
    quick = "--quick" in arguments
    sets = {}
    for name in (name for names in FAMILIES.values() for name in names):
        recordings = list(SETS[name]())
        step = -(-len(recordings) // (1 if quick else _MOST))
        sets[name] = [_shortened(r) for r in recordings[::step]]
    peer = {name: _totals(some, peers, ("VQF", "OfflineVQF")) for name, some in sets.items()}
    tried = []
    for changes in choices():
        told = {f"fusion.{key}": value for key, value in changes.items()}
        tried.append((changes, {
            name: _totals(some, lambda r, told=told: score_ours(r, told), _MODES)
            for name, some in sets.items()}))
        print(_told(changes), f"{_loss(tried[-1][1], peer, list(sets)):.3f}", flush=True)
    usual = OrientationParams().fusion
    default = next(scores for changes, scores in tried if all(
        getattr(usual, key) == value for key, value in changes.items()))
    rows = []
    for names in FAMILIES.values():
        others = [name for name in sets if name not in names]
        changes, scores = min(tried, key=lambda one: _loss(one[1], peer, others))
        rows += [[name, str(len(sets[name])), _told(changes),
                  *(_cell(group[name]) for group in (peer, scores, default))] for name in names]
    if quick:
        for row in rows:
            print(" | ".join(row))
        return
    write_table("orientation_cross", ["set", "trials", "chosen on the other families",
                                      "VQF / OfflineVQF, deg", "ours, so chosen (within 3 sigma)",
                                      "ours, defaults"], rows,
                note=f"Causal / smoothed, mean total error, of {_LONGEST:.0f} s of up to {_MOST} recordings "
                f"of each set; vqf {version('vqf')}. Chosen from " + "; ".join(
                    f"{key}: {' or '.join(' '.join(map(str, np.atleast_1d(v))) for v in values)}"
                    for key, values in GRID.items()) + ".")


if __name__ == "__main__":
    main(sys.argv[1:])
