"""A car drive with RTK fixes as truth: python -m benchmarks.smoother_drive

Withheld: eleven stretches of 15 s without fixes and velocities; the error is that of the
antenna position inside them. Degraded: all fixes and velocities with the noise of the
paper's table 5 added; the error is against the RTK fixes.
"""

import numpy as np

from benchmarks.data import config, data_path
from benchmarks.jumps import write
from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.estimation.smoother.points import at_antenna
from imu_fusion.evaluation.consistency import nees
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.logs import FixLog, ImuLog, VelocityLog

# The noise is read off the data: the gyroscope and accelerometer of a car at speed see
# vibration that 100 Hz aliases (standard deviation of high-passed samples 0.01-0.12 rad/s,
# 0.2-0.6 m/s^2), as densities at 100 Hz about 3e-3 and 3e-2; the biases drift slowly. The
# receiver differences positions for its velocity, so this comes late by half a period
# (0.125 s, found by correlation and by the state).
PARAMS = config("drive_0708")
LENGTH, COUNT = 15.0, 11
SEEDS = 20


def load():
    """ImuLog, FixLog, VelocityLog and the mask of fixed ambiguities, or None."""
    folder = data_path("drive_0708")
    if not folder.exists():
        return None
    tables = []
    for name in ("imu.csv", "gnss.csv"):
        file = folder / name
        width = len(file.open().readline().split(","))
        stamp = np.loadtxt(file, delimiter=",", skiprows=1, usecols=0, dtype=np.int64)
        tables += [stamp, np.loadtxt(file, delimiter=",", skiprows=1, usecols=range(1, width))]
    imu_stamp, i, stamp, g = tables
    cov = np.zeros((len(stamp), 3, 3))
    cov[:, 0, 0], cov[:, 1, 1], cov[:, 2, 2] = g[:, 5] ** 2, g[:, 4] ** 2, g[:, 6] ** 2
    return (ImuLog(imu_stamp, gyr=i[:, 3:], acc=i[:, :3]),
            FixLog(stamp, g[:, 0], g[:, 1], g[:, 2], cov, np.zeros(len(stamp))),
            VelocityLog(stamp, g[:, 7:10], np.zeros((len(stamp), 3, 3))), g[:, 3] == 1)


def errors(result, fix, params=PARAMS):
    """Errors (m, 3) of the smoothed antenna position at the fixes, with covariances, and the
    mask of fixes inside the recording. A fix shows where the antenna was when it was taken:
    its stamp less the delay that the run found."""
    samples = at_antenna(result.samples, result.states, params)
    delay = 0
    if "gnss_time_offset" in result.states:
        delay = int(round(result.states["gnss_time_offset"][0][0, 0] * 1e9))
    stamp = fix.stamp - delay
    inside = (stamp > samples["stamp"][0]) & (stamp < samples["stamp"][-1])
    stamp = stamp[inside] - samples["stamp"][0]
    place = np.stack([np.interp(stamp, samples["stamp"] - samples["stamp"][0], c)
                      for c in samples["position_world"].T], axis=1)
    truth = result.frame.to_enu(fix.latitude_deg, fix.longitude_deg, fix.height)[inside]
    nearest = np.searchsorted(samples["stamp"] - samples["stamp"][0], stamp)
    return place - truth, samples["cov_position"][nearest], inside


def withheld(imu, fix, velocity, fixed, params=PARAMS):
    """Result, errors (m, 3) in m inside the withheld stretches, with covariances."""
    starts = np.linspace(imu.stamp[0] + 60e9, imu.stamp[-1] - 45e9, COUNT)
    hold = np.zeros(len(fix), bool)
    for start in starts:
        hold |= (fix.stamp >= start) & (fix.stamp < start + LENGTH * 1e9)
    result = Smoother(params).run(imu, None, fix[~hold], velocity[~hold])
    error, cov, inside = errors(result, fix, params)
    use = (hold & fixed)[inside]
    return result, error[use], cov[use]


def degraded(imu, fix, velocity, seed):
    """Result, RMS east, north, up in m and NEES with the paper's noise on all fixes."""
    rng = np.random.default_rng(seed)
    sd, sd_vel = np.array([3.0, 3.0, 5.0]), np.array([0.1, 0.1, 0.3])
    frame = LocalFrame(fix.latitude_deg[0], fix.longitude_deg[0], fix.height[0])
    enu = frame.to_enu(fix.latitude_deg, fix.longitude_deg, fix.height)
    n = len(fix)
    latitude, longitude, height = frame.to_geodetic(enu + sd * rng.standard_normal((n, 3)))
    noisy = FixLog(fix.stamp, latitude, longitude, height,
                   np.broadcast_to(np.diag(sd ** 2), (n, 3, 3)), np.zeros(n))
    noisy_vel = VelocityLog(velocity.stamp,
                            velocity.vel_world + sd_vel * rng.standard_normal((n, 3)),
                            np.broadcast_to(np.diag(sd_vel ** 2), (n, 3, 3)))
    result = Smoother(PARAMS).run(imu, None, noisy, noisy_vel)
    error, cov, _ = errors(result, fix)
    return result, np.sqrt(np.mean(error ** 2, axis=0)), nees(error, cov).mean()


def main():
    data = load()
    if data is None:
        print("drive_0708 is not at hand: set IMU_FUSION_DATA")
        return
    imu, fix, velocity, fixed = data
    lines = ["Drive of 549 s (rtklibexplorer/GNSS_IMU, BSD-3), Imu 100 Hz, RTK 4 Hz; no "
             "magnetometer, no vehicle constraints.", "",
             "| | RMS m | NEES (ideal 3) | iterations | GNSS delay ms | velocity delay ms |",
             "|---|---|---|---|---|---|"]

    def delays(result):
        return " | ".join(
            f"{1e3 * result.states[k][0][0, 0]:.0f} +- {1e3 * result.states[k][1][0, 0]:.0f}"
            for k in ("gnss_time_offset", "velocity_time_offset"))

    for name, params in (("", PARAMS), (", defaults", SmootherParams())):
        result, error, cov = withheld(imu, fix, velocity, fixed, params)
        rms = np.sqrt(np.mean(np.sum(error ** 2, axis=1)))
        lines.append(f"| withheld {COUNT} x {LENGTH:.0f} s, 3D{name} | {rms:.3f} | "
                     f"{nees(error, cov).mean():.1f} | {result.iterations} | {delays(result)} |")
    rows = []
    for seed in range(SEEDS):
        result, axes, ratio = degraded(imu, fix, velocity, seed)
        rows.append([*axes, ratio])
        if seed < 3:
            lines.append(f"| degraded, seed {seed}, east/north/up | "
                         + "/".join(f"{a:.2f}" for a in axes)
                         + f" | {ratio:.1f} | {result.iterations} | {delays(result)} |")
    for name, values in ((f"RMS of {SEEDS} seeds", np.sqrt(np.mean(np.square(rows), axis=0))),
                         ("worst seed of each", np.max(rows, axis=0))):
        lines.append(f"| degraded, {name}, east/north/up | "
                     + "/".join(f"{a:.2f}" for a in values[:3]) + f" | {values[3]:.1f} | | | |")
    write("smoother_drive", "\n".join(lines))


if __name__ == "__main__":
    main()
