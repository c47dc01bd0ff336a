"""What the 70 s of a ball between known ends err by, one cause after the other taken away:
python -m benchmarks.avalanche_whole [SEEDS]
"""

import sys

import numpy as np

from benchmarks.avalanche import Ball, recovered, smoother, triple, without_errors
from benchmarks.avalanche_bound import least_error
from benchmarks.table import write_table
from imu_fusion.simulation.ball_sensors import BallErrors

SEEDS = 12
NO_GAP = {"gap": (0.0, 0.0)}
NO_CLIPPING = {"gyr_range": 1e3, "gyr_lsb": 0.0}
EXACT_ACC = {"acc_bias_sd": 0.0, "acc_matrix_sd": 0.0}
KNOWN_ACC = {"sensor.acc_bias_sd": 1e-5, "sensor.acc_matrix_sd": 0.0}
# Name -> errors of the sensors that are changed, parameters that say so.
CASES = {
    "all errors": ({}, {}),
    "no gap": (NO_GAP, {}),
    "no clipping": (NO_CLIPPING, {}),
    "accelerometer exact": (EXACT_ACC, KNOWN_ACC),
    "all errors, accelerometer's noise as it is between impacts": (
        {}, {"sensor.acc_noise_density": 0.03}),
    "no gap, no clipping": (NO_GAP | NO_CLIPPING, {}),
    "no gap, no clipping, accelerometer exact": (NO_GAP | NO_CLIPPING | EXACT_ACC, KNOWN_ACC),
}


def score(seed, changed, known):
    """As benchmarks.avalanche.smoother gives it, of the whole."""
    ball = Ball(seed, BallErrors().replace(**changed))
    ball.known |= known
    return smoother(ball, recovered(ball), -3.0, 73.0)


def row(name, scores):
    """Of the table: name, errors (stated), NEES of position, attitude (stated), its NEES."""
    s = np.array(scores)
    mean = np.sqrt(np.mean(s ** 2, axis=0))
    return (name, f"{triple(mean[:3])} ({triple(mean[3:6])})", f"{s[:, 6].mean():.1f}",
            f"{mean[7]:.2f} ({mean[10]:.2f})", f"{s[:, 8].mean():.1f}")


def main(count=SEEDS):
    rows = []
    for name, case in CASES.items():
        rows.append(row(name, [score(seed, *case) for seed in range(count)]))
        print(rows[-1], flush=True)
    rows.append(row("nothing but the noise of the samples",
                    [without_errors(seed) for seed in range(count)]))
    rows.append(("bound: as that, attitude and constants known", f"{least_error((0.0, 0.0)):.2f} "
                 f"per axis; with the gap {least_error(BallErrors().gap):.2f}", "", "", ""))
    write_table("avalanche_whole", ("errors of the sensors", "position long/lat/transverse, m (stated)",
                                    "NEES", "attitude, deg (stated)", "NEES"), rows,
                f"The 70 s of simulated balls through the gap, start and end known, {count} seeds, RMS; "
                "NEES: 3 is ideal. What is exact is said to be (the accelerometer), what is not clipped "
                "or missing is not said.")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
