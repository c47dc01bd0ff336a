"""Is the uncertainty honest? Normalised errors squared in simulations that match the model.

    python -m benchmarks.acceleration_field_nees [realisations]
"""

import sys

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from benchmarks.acceleration_field_cases import EXACT
from benchmarks.table import write_table
from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
    Initial,
    Motion,
)
from imu_fusion.estimation.acceleration_field.start import given_start
from imu_fusion.simulation.rigid_body_impact import PAPER_AXES, PAPER_POSITIONS
from imu_fusion.simulation.rigid_body_motion import draw_motion, ideal_readings

SAMPLES, RATE, NOISE = 300, 50.0, 1e-2
STATES = ("attitude", "omega", "alpha", "specific_force", "acceleration_world")
# Angular acceleration of sd 100 rad/s^2 that forgets itself within 1 / RATE s.
PARAMS = AccelerationFieldParams(
    sensor=EXACT,
    initial=Initial(mode="given", angular_velocity=(5.0, 5.0, 5.0), angular_velocity_sd=0.1,
                    orientation_sd=0.002),
    motion=Motion(rate=RATE, jerk_density=2 * 100 * RATE ** 1.5, acceleration_rate_density=300.0))


def normalised(rows, states, quats, reference, gravity):
    """(rows, 5) normalised errors squared, three degrees of freedom each."""
    omega, alpha, acc = states[:, 3:6], states[:, 6:9], states[:, 12:15]
    force = acc - np.cross(alpha, reference) - np.cross(omega, np.cross(omega, reference))
    turn = Rotation.from_quat(quats)
    errors = {
        "attitude": (Rotation.from_quat(rows["quat"]).inv() * turn).as_rotvec(),
        "omega": omega - rows["omega"], "alpha": alpha - rows["alpha"],
        "specific_force": force - rows["specific_force"],
        "acceleration_world": turn.apply(force) - [0, 0, gravity] - rows["acceleration_world"]}
    return np.column_stack([np.einsum("ni,nij,nj->n", errors[s], np.linalg.inv(rows["cov_" + s]),
                                      errors[s]) for s in STATES])


def main(realisations=200):
    """Write the table."""
    sensors = [AccelerometerParams(position=tuple(p), axes=tuple(a.ravel()), noise_density=NOISE,
                                   bias_sd=0.3) for p, a in zip(PAPER_POSITIONS, PAPER_AXES)]
    low, high = chi2.ppf([0.025, 0.975], 3 * realisations) / realisations
    table = []
    for mode in ("causal", "smoothed"):
        rng = np.random.default_rng(11)
        params = PARAMS.replace(mode=mode)
        found = []
        for _ in range(realisations):
            estimator = AccelerationFieldEstimator(params, sensors)
            states, quats = draw_motion(params, given_start(params, estimator.array), SAMPLES, rng)
            readings = ideal_readings(estimator.array, states)
            readings += rng.normal(0, NOISE * params.sample_rate ** 0.5, readings.shape)
            rows = estimator.run(np.arange(SAMPLES) * 1_000_000, readings.reshape(-1, 4, 3))
            found.append(normalised(rows, states, quats, estimator.array.reference,
                                    params.gravity)[[SAMPLES // 2, SAMPLES - 1]])
        for k, when in enumerate(("middle", "end")):
            values = np.mean(found, axis=0)[k]
            table.append([mode, when, *(f"{v:.2f}{'' if low < v < high else ' (outside)'}"
                                        for v in values)])
    write_table("acceleration_field_nees", ["mode", "sample", *STATES], table,
                f"Mean normalised error squared of {realisations} motions drawn from the model "
                f"(four accelerometers, biases, 0.3 s at 1 kHz); three degrees of freedom each: "
                f"95 % band {low:.2f} to {high:.2f}.")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
