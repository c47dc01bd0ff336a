"""Table 1 of Rahaman 2019, and the same experiment with the noise of real sensors.

    python -m benchmarks.acceleration_field_table1 [realisations]
"""

import sys

import numpy as np

from benchmarks.acceleration_field_cases import (
    METHODS,
    PARAMS,
    errors,
    fitted_densities,
    noisy,
    paper_sensors,
    plus_minus,
)
from benchmarks.table import write_table
from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.simulation.rigid_body_impact import (
    PAPER_AXES,
    PAPER_PARTICLE,
    PAPER_POSITIONS,
    simulate,
)

SIGMAS = (0, 1, 10, 100)
PRINTED = {0: (1.56, 2.20), 1: (1.80, 2.85), 10: (8.42, 12.88), 100: (82.31, 126.49)}


def study(motion, params, sigma, realisations, one_process):
    """(realisations, 2) errors of one method."""
    clean = motion.readings(PAPER_POSITIONS, PAPER_AXES, "acceleration")
    truth = motion.acceleration_world(PAPER_PARTICLE)
    rng = np.random.default_rng(sigma)
    sensors = paper_sensors(sigma)
    if params.method == "rigid_body" and sigma:
        # One recording that is not among those measured.
        params = fitted_densities(params, sensors, motion.stamp, noisy(clean, sigma, rng))
    return np.array([errors(AccelerationFieldEstimator(params, sensors).run(
        motion.stamp, noisy(clean, sigma, rng, one_process)), truth)
        for _ in range(realisations if sigma else 1)])


def main(realisations=200):
    """Write the two tables."""
    coarse, fine = simulate(step=1e-3, every=1), simulate(step=1e-5, every=100)
    ao = PARAMS.replace(method="ao")
    rows = []
    for sigma in SIGMAS:
        ours = study(coarse, ao, sigma, realisations, True)
        printed = np.array(PRINTED[sigma])
        off = 100 * (ours.mean(axis=0) / printed - 1)
        against_fine = study(fine, ao, sigma, realisations, True)
        rows.append([sigma, *printed, *(plus_minus(ours[:, i]) for i in (0, 1)),
                     f"{off[0]:+.1f} % / {off[1]:+.1f} %",
                     *(plus_minus(against_fine[:, i]) for i in (0, 1))])
    write_table(
        "acceleration_field_table1",
        ["sigma", "paper eps_2", "paper eps_inf", "eps_2", "eps_inf", "off the paper",
         "eps_2, fine truth", "eps_inf, fine truth"], rows,
        f"Errors x1e-3 of particle 5 over 1 s, mean ± sd of {realisations} realisations; one "
        "noise process on all twelve channels, as the paper writes. The first columns use the "
        "paper's own simulation step (1 ms) as truth, the last a truth of 10 us.")
    rows = []
    for sigma in SIGMAS:
        found = [study(fine, PARAMS.replace(**change), sigma, realisations, False)
                 for change in METHODS.values()]
        rows.append([sigma, *(f"{plus_minus(f[:, 0])} / {plus_minus(f[:, 1])}" for f in found)])
    exact = [study(fine, PARAMS.replace(**change, integration="high_order"), 0, 1, False)[0]
             for change in list(METHODS.values())[:2]]
    write_table(
        "acceleration_field_independent", ["sigma", *METHODS], rows,
        "eps_2 / eps_inf x1e-3 of particle 5 over 1 s against a truth of 10 us, mean ± sd of "
        f"{realisations} realisations with independent noise on each channel. Motion densities "
        "by maximum likelihood from one further realisation. With integration high_order the row "
        f"sigma 0 reads {exact[0][0]:.2g}/{exact[0][1]:.2g} (AO) and "
        f"{exact[1][0]:.2g}/{exact[1][1]:.2g} (sqrt-AO).")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
