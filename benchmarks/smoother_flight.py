"""A fixed-wing flight, all four sensors: python -m benchmarks.smoother_flight

No truth: normalised innovations tell whether the model fits, and the attitude is set beside
the autopilot's own filter (an estimate as well).
"""

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.data import data_path
from benchmarks.jumps import write
from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.samples.logs import FixLog, ImuLog, MagLog, VelocityLog

# Vibration of a propeller, aliased at 136 Hz; autopilots of that time delayed their GNSS by
# some 0.2 s. The magnetometer sits beside the motor's currents: taken at 2 uT it contradicts
# Imu and GNSS (velocity innovations of 3 to 6 standard deviations), so it is taken at 20 uT.
PARAMS = SmootherParams(
    gyro_noise_density=1e-2, acc_noise_density=0.2, gyro_bias_sd=0.2, acc_bias_sd=1.0,
    fix_sd=(1.0, 1.0, 1.5), velocity_sd=(0.3, 0.3, 0.5), gnss_time_offset_sd=0.3, mag_sd=20e-6)


def load():
    """ImuLog, MagLog, FixLog, VelocityLog and the autopilot's attitude (stamp, quat), or None."""
    folder = data_path("px4_plane")
    if not folder.exists():
        return None

    def table(name):
        file = folder / name
        width = len(file.open().readline().split(","))
        return (np.loadtxt(file, delimiter=",", skiprows=1, usecols=0, dtype=np.int64),
                np.loadtxt(file, delimiter=",", skiprows=1, usecols=range(1, width)))
    stamp, i = table("imu.csv")
    gnss_stamp, g = table("gnss.csv")
    reference_stamp, e = table("onboard_attitude.csv")
    n = len(gnss_stamp)
    ned = Rotation.from_euler("ZYX", e[:, [2, 1, 0]], degrees=True)
    to_enu = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    to_flu = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    return (ImuLog(stamp, gyr=i[:, 3:6], acc=i[:, 0:3]), MagLog(stamp, i[:, 6:9]),
            FixLog(gnss_stamp, g[:, 0], g[:, 1], g[:, 2], np.zeros((n, 3, 3)), np.zeros(n)),
            VelocityLog(gnss_stamp, g[:, 3:6], np.zeros((n, 3, 3))),
            (reference_stamp, (to_enu * ned * to_flu).as_quat()))


def whiteness(innovation):
    """Largest autocorrelation at the first five lags."""
    e = innovation - innovation.mean(axis=0)
    power = np.sum(e * e, axis=0)
    return max(float(np.abs(np.sum(e[k:] * e[:-k], axis=0) / power).max()) for k in range(1, 6))


def main():
    data = load()
    if data is None:
        print("px4_plane is not at hand: set IMU_FUSION_DATA")
        return
    imu, mag, fix, velocity, (stamp, reference) = data
    lines = ["Fixed-wing flight of 100 s (priseborough/InertialNav, BSD-3).", "",
             "| | iterations | RMS of normalised innovations: fix, velocity (ideal 1) | largest "
             "autocorrelation, lags 1-5 | GNSS delay ms | attitude against the autopilot's, RMS "
             "about east/north/up deg |", "|---|---|---|---|---|---|"]
    for name, log in (("without magnetometer", None), ("with magnetometer", mag)):
        result = Smoother(PARAMS).run(imu, log, fix, velocity)
        samples = result.samples
        innovations = [result.innovations[k][1] for k in ("fix", "velocity")]
        rms = ", ".join("/".join(f"{r:.2f}" for r in np.sqrt(np.mean(e ** 2, axis=0)))
                        for e in innovations)
        white = ", ".join(f"{whiteness(e):.2f}" for e in innovations)
        nearest = np.searchsorted(samples["stamp"], stamp).clip(max=len(samples) - 1)
        difference = (Rotation.from_quat(samples["quat_world_imu"][nearest])
                      * Rotation.from_quat(reference).inv()).as_rotvec(degrees=True)
        # The autopilot's filter needs its first 20 s to find its own heading.
        later = stamp > stamp[0] + 20 * 10**9
        against = "/".join(f"{r:.1f}" for r in np.sqrt(np.mean(difference[later] ** 2, axis=0)))
        offset, sd = (a[0, 0] for a in result.states["gnss_time_offset"])
        lines.append(f"| {name} | {result.iterations} | {rms} | {white} | "
                     f"{1e3 * offset:.0f} +- {1e3 * sd:.0f} | {against} |")
    write("smoother_flight", "\n".join(lines))


if __name__ == "__main__":
    main()
