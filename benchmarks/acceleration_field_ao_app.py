"""The simulated impact of the AO algorithm's own authors (ao_app).

    python -m benchmarks.acceleration_field_ao_app

It comes without a truth, so physics is the judge: between its contacts the body flies. The first
flight follows from its start; in the second no specific force acts at the centre of mass, and the
angular momentum stands still in the world. Their real headform, sampled at 20 Hz, is turned and
runs out: what each sample tells of |omega| by itself is the judge.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.data import data_path
from benchmarks.table import write_table
from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
    Initial,
    Sensor,
)
from imu_fusion.estimation.acceleration_field.rows import field_at
from imu_fusion.simulation.rigid_body_impact import PAPER_POSITIONS, ImpactScene, simulate

GRAVITY = 9.8    # m/s^2, the unit of the simulated readings
CENTRE = np.array([0.0, 0.0, 0.75])
FIRST, SECOND = 0.41, (0.64, 1.42)    # s, ends of the flights, clear of the contacts
AXES = [np.eye(3)] * 3 + [np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])]
# mm and rows of the axes, of the headform.
HEADFORM = (((18.0, 306.46, 83.10), ((0, -1, 0), (1, 0, 0), (0, 0, 1))),
            ((108.7, 25.64, 18.0), ((0, 1, 0), (0, 0, 1), (1, 0, 0))),
            ((25.64, 349.4, 18.0), ((-1, 0, 0), (0, 0, 1), (0, 1, 0))),
            ((-17.3, 150.0, 18.0), ((0, -1, 0), (0, 0, 1), (-1, 0, 0))))
METHODS = {"AO (paper)": {"method": "ao"}, "sqrt-AO": {"method": "sqrt_ao"},
           "causal filter": {}, "smoother": {"mode": "smoothed"}}
EXACT = Sensor(acc_position_sd=0.0, acc_axes_sd=0.0, acc_scale_sd=0.0, acc_bias_sd=0.0)


def load(name):
    """(stamp (n,) ns, readings (n, 4, 3) in g) of a file."""
    table = np.genfromtxt(data_path("ao_app") / name, delimiter=",", skip_header=1)
    return np.round(table[:, 0] * 1e9).astype(np.int64), table[:, 1:].reshape(-1, 4, 3)


def flights(noise):
    """Rows of the table of the simulated impact, with white noise of sd ``noise`` m/s^2."""
    stamp, readings = load("Demo_Accall.csv")
    readings = GRAVITY * readings + np.random.default_rng(0).normal(0.0, noise, readings.shape)
    scene = ImpactScene(ground=-1e9, mass=10.0)
    truth = simulate(scene, duration=FIRST, step=2.5e-5, every=10)
    first = slice(0, len(truth.t))
    second = (stamp > SECOND[0] * 1e9) & (stamp < SECOND[1] * 1e9)
    squares = np.square(scene.semi_axes)
    inertia = (squares.sum() - squares) / 5.0
    sensors = [AccelerometerParams(position=tuple(p), axes=tuple(a.ravel()),
                                   noise_density=max(noise, 1e-3) / np.sqrt(4000.0))
               for p, a in zip(PAPER_POSITIONS, AXES)]
    params = AccelerationFieldParams(
        sensor=EXACT, sample_rate=4000.0, gravity=GRAVITY,
        initial=Initial(mode="given", angular_velocity=(5.0, 5.0, 5.0), angular_velocity_sd=1e-6))
    table = []
    for name, change in METHODS.items():
        rows = AccelerationFieldEstimator(params.replace(**change), sensors).run(stamp, readings)
        turn = Rotation.from_quat(rows["quat"])
        off = (turn[first].inv() * Rotation.from_quat(truth.quat)).magnitude()
        momentum = turn.apply(inertia * rows["omega"])[second]
        wander = np.linalg.norm(momentum - momentum.mean(axis=0), axis=1)
        force = field_at(rows[second], CENTRE, GRAVITY)[0][:, 0]
        values = (np.abs(rows["omega"][first] - truth.omega).max(), np.degrees(off.max()),
                  np.sqrt(np.mean(np.sum(force ** 2, axis=1))),
                  100.0 * wander.max() / np.linalg.norm(momentum.mean(axis=0)))
        table.append([f"impact, noise {noise:g} m/s^2", name, *(f"{v:.3g}" for v in values)])
    return table


def headform():
    """What the causal filter makes of the headform with the defaults of the motion, in words."""
    stamp, readings = load("Rotation_Accall.csv")
    sensors = [AccelerometerParams(position=tuple(1e-3 * np.array(place)),
                                   axes=tuple(np.ravel(axes).astype(float)),
                                   noise_density=0.05 / np.sqrt(20.0))
               for place, axes in HEADFORM]
    params = AccelerationFieldParams(
        sample_rate=20.0, initial=Initial(mode="given", orientation_sd=0.02))
    estimator = AccelerationFieldEstimator(params, sensors)
    omega = estimator.run(stamp, 9.80665 * readings)
    alone = AccelerationFieldEstimator(params.replace(method="sqrt_ao"), sensors).run(
        stamp, 9.80665 * readings)
    speed, by_itself = (np.linalg.norm(rows["omega"], axis=1) for rows in (omega, alone))
    sd = np.sqrt(np.trace(omega["cov_omega"], axis1=1, axis2=2))
    fast = by_itself > 5.0
    off = np.abs(speed - by_itself)[fast]
    return (f"The headform (20 Hz, densities of motion as by default): up to {speed.max():.3g} "
            f"rad/s, where it turns faster than 5 rad/s within {off.max():.2g} "
            f"(rms {np.sqrt(np.mean(off ** 2)):.2g}) of what each sample tells alone, at rest in the end {speed[-20:].mean():.2g} with a stated sd of "
            f"{sd[-20:].mean():.2g}; said: {'; '.join(estimator.remarks()) or 'nothing'}.")


def main():
    """Write the table."""
    if not data_path("ao_app").exists():
        raise SystemExit("ao_app is not at hand; set IMU_FUSION_DATA to the folder of the data")
    write_table("acceleration_field_ao_app",
                ["recording", "method", "first flight: largest error of omega, rad/s",
                 "and of the attitude, deg", "second flight: force at the centre, m/s^2, rms",
                 "angular momentum wanders by, %"], flights(0.0) + flights(0.3),
                "Readings from AppliedMechanicsLab/AO-Desktop-App (GPL-3), not in this repository: "
                "four accelerometers, simulated at 4 kHz. The truth of the last two figures is "
                "zero. " + headform())


if __name__ == "__main__":
    main()
