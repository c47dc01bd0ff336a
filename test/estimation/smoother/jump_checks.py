"""What a smoothed jump is held to."""

import numpy as np

from benchmarks.jumps import score

# One seed scatters: three times the RMS that benchmarks/smoother_jump finds over seeds.
BOUNDS = np.array([0.25, 0.25, 0.12, 0.06, 0.06, 0.04, 0.35, 0.26, 0.75])


def rms(row):
    """Of position, velocity, attitude (9,)."""
    return np.sqrt(np.concatenate([row["position"], row["velocity"], row["attitude"]]))


def check(result, recording, jump, bounds=BOUNDS):
    row = score(result, recording, jump)
    assert result.converged
    assert np.all(rms(row) < bounds), rms(row)
    # Errors of one run are correlated over the run, so its NEES scatters between 0.5 and 10.
    assert np.all((row["nees"] > 0.2) & (row["nees"] < 12.0)), row["nees"]
