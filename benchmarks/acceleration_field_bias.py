"""Constant accelerometer biases of 0.05 g and 0.1 g (sd, each axis) over 5 s of impacts.

    python -m benchmarks.acceleration_field_bias [realisations]
"""

import sys

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.acceleration_field_cases import (
    METHODS,
    PARAMS,
    errors,
    fitted_densities,
    noisy,
    paper_sensors,
)
from benchmarks.table import write_table
from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.simulation.rigid_body_impact import (
    PAPER_AXES,
    PAPER_PARTICLE,
    PAPER_POSITIONS,
    simulate,
)

BIAS_SDS_G = (0.05, 0.1)
SIGMA = 10


def study(bias_sd_g, realisations):
    """Rows of the table for one size of the biases."""
    bias_sd = bias_sd_g * 9.80665
    motion = simulate(duration=5.0)
    clean = motion.readings(PAPER_POSITIONS, PAPER_AXES, "acceleration")
    truth = motion.acceleration_world(PAPER_PARTICLE)
    turn = Rotation.from_quat(motion.quat).inv()
    rng = np.random.default_rng(5)

    def draw():
        return rng.normal(0, bias_sd, (4, 3))

    rigid = fitted_densities(PARAMS, paper_sensors(SIGMA, bias_sd), motion.stamp,
                             noisy(clean, SIGMA, rng) + draw())
    cases = {**METHODS, "smoother, readings without bias": METHODS["smoother"]}
    found = {name: [] for name in cases}
    floor = []
    for _ in range(realisations):
        bias = draw()
        readings = noisy(clean, SIGMA, rng)
        # A bias common to all body axes acts like an acceleration of the body: nobody can tell.
        common = np.linalg.norm(np.einsum("kij,ki->j", PAPER_AXES, bias) / 4)
        floor.append([1e3 * common * np.sqrt(np.sum(part) / np.sum(truth[part] ** 2))
                      for part in (motion.t >= 0, motion.t >= 4)])
        for name, change in cases.items():
            biased = "without" not in name
            base = rigid if change["method"] == "rigid_body" else PARAMS
            rows = AccelerationFieldEstimator(
                base.replace(**change), paper_sensors(SIGMA, bias_sd if biased else 0.0)).run(
                motion.stamp, readings + bias * biased)
            angle = np.degrees((turn * Rotation.from_quat(rows["quat"])).magnitude())
            late = motion.t >= 4
            found[name].append([errors(rows, truth)[0], errors(rows[late], truth[late])[0],
                                angle[-1], angle.max()])
    floor = np.mean(floor, axis=0)
    table = [[f"{bias_sd_g} g", name, *(f"{v:.3g}" for v in np.mean(f, axis=0))]
             for name, f in found.items()]
    table.append([f"{bias_sd_g} g", "floor: bias common to all sensors",
                  *(f"{v:.3g}" for v in floor), "", ""])
    return table


def main(realisations=100):
    """Write the table."""
    write_table(
        "acceleration_field_bias",
        ["bias sd", "method", "eps_2 x1e-3, 0-5 s", "eps_2 x1e-3, 4-5 s",
         "attitude error at 5 s, deg", "largest attitude error, deg"],
        [row for sd in BIAS_SDS_G for row in study(sd, realisations)],
        f"Constant biases, normal and independent on each of the twelve channels, noise sigma "
        f"{SIGMA}, means over {realisations} realisations. The floor is the error by the mean "
        "bias of the four sensors alone, without noise.")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
