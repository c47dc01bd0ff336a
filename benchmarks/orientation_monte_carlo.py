"""Monte Carlo on simulation: honest covariance of orientation and calibration.

Random attitudes, motions, noise, biases, scale errors, delays, in both
hemispheres, with declinations to 30 deg. NEES is the mean of the squared Mahalanobis
distance per degree of freedom: 1 is exact, below is conservative.

Sensors drawn from the parameters have the iron, the noise and the disturbed field that the
defaults speak of; the clean ones have less than the estimator allows for.
"""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.table import write_table
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.samples.logs import MagLog
from imu_fusion.sensors.magnetometer_calibration import calibrate_magnetometer
from imu_fusion.simulation.rotation import Sensors, Tumbling, earth_field, simulate

RUNS = 20
_THREE_SIGMA = 14.156


def recording(seed, inclination_deg, rate=100.0, duration=30.0):
    rng = np.random.default_rng(seed)
    declination = float(rng.uniform(-30, 30))
    sensors = Sensors(
        gyr_density=3e-4, acc_density=2e-3, mag_sd=5e-7, gyr_bias=tuple(rng.normal(0, 0.01, 3)),
        gyr_matrix=np.eye(3) + rng.normal(0, 0.005, (3, 3)), gyr_walk=2e-5,
        acc_bias=tuple(rng.normal(0, 0.03, 3)), mag_offset=tuple(rng.normal(0, 5e-7, 3)),
        mag_delay=float(rng.normal(0, 0.01)))
    field = earth_field(inclination=math.radians(inclination_deg),
                        declination=math.radians(declination))
    imu, mag, truth, _ = simulate(Tumbling(seed=seed), duration, rate=rate, sensors=sensors,
                                  field_world=field, seed=seed)
    return imu, mag, truth, declination


def as_stated(seed, local_field_sd, rate=100.0, duration=30.0):
    """A recording whose every error is drawn from what OrientationParams' defaults state, under
    one of their hypotheses of the local field."""
    params, norm, dt = OrientationParams(), 48e-6, 1.0 / rate
    p, f = params.sensor, params.fusion
    rng = np.random.default_rng(seed)
    declination = float(rng.uniform(-30, 30))
    sensors = Sensors(
        gyr_density=p.gyro_noise_density, acc_density=p.acc_noise_density,
        mag_sd=p.mag_noise_sd, gyr_bias=tuple(rng.normal(0, p.gyro_bias_sd, 3)),
        gyr_matrix=np.eye(3) + rng.normal(0, p.gyro_scale_sd, (3, 3)), gyr_walk=p.gyro_bias_walk,
        acc_bias=tuple(rng.normal(0, p.acc_bias_sd, 3)),
        mag_offset=tuple(rng.normal(0, f.mag_offset_sd * norm, 3)),
        mag_matrix=np.linalg.inv(np.eye(3) - rng.normal(0, f.mag_matrix_sd, (3, 3))),
        mag_delay=float(rng.normal(0, p.mag_delay_sd)))
    motion = Tumbling(seed=seed)
    imu, mag, truth, _ = simulate(
        motion, duration, rate=rate, sensors=sensors, seed=seed,
        field_world=earth_field(norm, math.radians(65), math.radians(declination)))
    # mag_disturbance_sd is that of a mean over 20 ms.
    disturbance = f.mag_disturbance_sd * math.sqrt(0.02 / dt) * rng.normal(size=mag.mag.shape)
    keep = math.exp(-dt / f.local_field_time)
    local = local_field_sd * rng.normal(size=3)
    for t, row in zip(mag.stamp * 1e-9, disturbance):
        if t > motion.rest:    # one place, as long as it rests
            local = (keep * local
                     + local_field_sd * math.sqrt(1 - keep ** 2) * rng.normal(size=3))
        row += local
    turn = Rotation.from_quat(motion.truth(mag.stamp * 1e-9)[0])
    disturbed = MagLog(mag.stamp, mag.mag + norm * turn.inv().apply(disturbance))
    return imu, disturbed, truth, declination


def main():
    rows = []
    cases = [(f"clean magnetometer, inclination {i} deg", "field",
              lambda seed, i=i: recording(seed, i)) for i in (65, 0, -60)]
    cases += [(f"errors as the defaults state, local field {sd}, heading_anchor {anchor}", anchor,
               lambda seed, sd=sd: as_stated(seed, sd))
              for sd in OrientationParams().fusion.local_field_sd for anchor in ("field", "rest")]
    for name, anchor, draw in cases:
        for mode in ("causal", "smoothed"):
            distance, error = [], []
            for seed in range(RUNS):
                imu, mag, truth, declination = draw(seed)
                out = OrientationEstimator(OrientationParams.from_mapping({
                    "mode": mode, "sensor.axes_sd": 0.0, "sensor.gyro_delay": 0.0,
                    "alignment.heading_anchor": anchor,
                    "declination_deg": declination})).run(imu, mag)
                e = (Rotation.from_quat(out["quat_world_imu"]).inv()
                     * Rotation.from_quat(truth.quat_world_imu)).as_rotvec()
                distance.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(out["cov_attitude"]), e))
                error.append((e ** 2).sum(axis=1).mean())
            distance = np.array(distance)
            rows.append([f"orientation, {mode}, {name}",
                         f"{math.degrees(math.sqrt(np.mean(error))):.2f} deg",
                         f"{distance.mean() / 3:.2f}",
                         f"{100 * (distance < _THREE_SIGMA).mean():.1f} %"])
            print(rows[-1], flush=True)
    norm = 48e-6
    distance, error = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        root = np.eye(3) + 0.1 * rng.normal(size=(3, 3))
        soft = (root @ root.T) / np.linalg.det(root @ root.T) ** (1 / 3)
        offset = rng.normal(0, 15e-6, 3)
        attitude = Rotation.from_quat(Tumbling(seed=seed, rest=0.0).truth(
            np.arange(0.0, 60.0, 0.05))[0])
        true = attitude.inv().apply(earth_field(norm))
        distorted = true @ np.linalg.inv(soft).T + offset
        c = calibrate_magnetometer(distorted + rng.normal(0, 3e-7, true.shape), field_norm=norm)
        e = np.concatenate([c.offset - offset, (c.matrix - soft)[np.triu_indices(3)]])
        distance.append(e @ np.linalg.solve(c.cov, e))
        error.append((np.linalg.norm(c.apply(distorted) - true, axis=1) ** 2).mean())
    rows.append(["magnetometer calibration, 9 parameters",
                 f"{1e6 * math.sqrt(np.mean(error)):.3f} uT", f"{np.mean(distance) / 9:.2f}",
                 f"{100 * np.mean(np.array(distance) < 25.26):.1f} %"])
    write_table("orientation_monte_carlo", ["estimate", "RMSE", "NEES", "within 3 sigma"], rows,
                note=f"{RUNS} runs of 30 s per line (200 for the calibration); 'within 3 sigma' "
                     "is the 99.73 % quantile of chi2.")


if __name__ == "__main__":
    main()
