"""Saturated gyroscopes: rates and orientation from clipped recordings.

The fast BROAD trials clipped in software at 500 and 300 deg/s, and simulated
avalanche-like rotation, to some 17 and 35 rad/s, clipped at 6 rad/s, 150 Hz. The limit is not told
to the estimator.
"""

import numpy as np
from vqf import offlineVQF

from benchmarks.data import broad_errors, broad_trials, load_broad
from benchmarks.orientation_broad import GYR_DELAY, compensated, fusion
from benchmarks.table import write_table
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.samples.logs import ImuLog
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate

FAST = ("06", "08", "21", "28")


def rate_rmse_deg(rates, truth, clipped):
    return float(np.degrees(np.sqrt(np.mean((rates - truth)[clipped] ** 2))))


def offline_vqf(imu, mag):
    dt = (imu.stamp[-1] - imu.stamp[0]) * 1e-9 / (len(imu) - 1)
    return offlineVQF(imu.gyr, imu.acc, mag.mag * 1e6, dt)["quat9D"][:, [1, 2, 3, 0]]


def cases():
    """(name, [(clipped ImuLog, MagLog, reference, mask, true rates, gyroscope's delay)])."""
    trials = [load_broad(p) for p in broad_trials() if p.name[:2] in FAST]
    for limit_deg in (500, 300):
        limit = np.radians(limit_deg)
        runs = []
        for imu, mag, ref, mask in trials:
            clipped = ImuLog(imu.stamp, np.clip(imu.gyr, -limit, limit), imu.acc)
            # The trial's first second at rest gives the bias of the unclipped rates.
            truth = imu.gyr - imu.gyr[:286].mean(axis=0)
            runs.append((clipped, mag, ref, mask, truth, GYR_DELAY))
        if runs:
            yield f"BROAD {' '.join(FAST)}, {limit_deg} deg/s", limit, runs
    for rate_sd in (4.0, 8.0):
        runs = []
        for seed in range(4):
            motion = Tumbling(seed=seed, rate_sd=rate_sd, frequencies=(0.2, 2.0), travel_sd=0.3)
            sensors = Sensors(gyr_density=9e-4, acc_density=1.8e-2, mag_sd=3e-7, gyr_limit=6.0,
                              gyr_bias=(0.01, -0.01, 0.02), gyr_walk=2e-4)
            imu, mag, truth, rates = simulate(motion, 20.0, rate=150.0, sensors=sensors, seed=seed)
            runs.append((imu, mag, truth.quat_world_imu, imu.stamp > 2e9, rates, 0.0))
        peak = max(np.abs(run[4]).max() for run in runs)
        yield f"simulated tumbling to {peak:.0f} rad/s, 6 rad/s, 150 Hz", 6.0, runs


def estimate(mode, imu, mag, delay):
    """Rows of the default estimator."""
    if mode != "lag 0.5 s":
        return OrientationEstimator(OrientationParams.from_mapping(
            {"mode": mode, "sensor.gyro_delay": delay})).run(imu, mag)
    estimator = OrientationEstimator(OrientationParams.from_mapping(
        {"lag": 0.5, "sensor.gyro_delay": delay}))
    estimator.run(imu, mag)
    estimator.finish()
    return estimator.take_corrected()


def main():
    rows = []
    for name, limit, runs in cases():
        results = {}
        share = []
        for imu, mag, ref, mask, truth, delay in runs:
            clipped = np.abs(imu.gyr) >= limit * (1 - 1e-9)
            share.append(clipped.any(axis=1).mean())
            logs = compensated(imu, mag) if delay else (imu, mag)
            peers = {"imufusion": fusion(*logs), "OfflineVQF": offline_vqf(*logs)}
            for peer, quat in peers.items():
                results.setdefault(peer, []).append(
                    (*broad_errors(quat, ref, mask), rate_rmse_deg(imu.gyr, truth, clipped)))
            for mode in ("causal", "lag 0.5 s", "smoothed"):
                out = estimate(mode, imu, mag, delay)
                results.setdefault(f"fusion, {mode}", []).append(
                    (*broad_errors(out["quat_world_imu"], ref, mask),
                     rate_rmse_deg(out["gyr"], truth, clipped)))
        for estimator, values in results.items():
            mean = np.mean(values, axis=0)
            rows.append([name, f"{100 * np.mean(share):.1f} %", estimator,
                         " / ".join(f"{v:.2f}" for v in mean[:3]), f"{mean[3]:.0f}"])
            print(rows[-1], flush=True)
    write_table("orientation_clipping", [
        "recording", "samples with a clipped axis", "estimator",
        "total / heading / inclination, deg", "rate RMSE on clipped axes, deg/s"], rows,
        note="Means over the recordings; the peers with delays "
             "compensated where there are any; their rates are the clipped ones.")


if __name__ == "__main__":
    main()
