"""A fixed-wing flight, all four sensors: python -m benchmarks.smoother_flight

No truth: normalised innovations tell whether the model fits, and the attitude is set beside
the autopilot's own filter (an estimate as well).
"""

from dataclasses import replace

import numpy as np
from scipy.signal import coherence, csd, welch
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.data import config, data_path
from benchmarks.jumps import write
from imu_fusion.estimation.smoother import Smoother
from imu_fusion.estimation.smoother.measurements.gnss import even_stamps
from imu_fusion.estimation.smoother.params import Gnss
from imu_fusion.geometry.magnetic_field import decimal_year, declination
from imu_fusion.samples.logs import FixLog, ImuLog, MagLog, VelocityLog

# Rows compare models, so none is fitted to the data.
PARAMS = config("px4_plane").replace(maximum_likelihood="off")
# Neighbouring fixes repeat each other's errors, and their height repeats more closely.
WANDERING = PARAMS.replace(**{"gnss.min_interval": 0.0, "gnss.fix_sd": (0.02, 0.02, 0.03)})
WHITE = PARAMS.replace(
    sensor=PARAMS.sensor.replace(gyro_noise_density=1e-2, acc_noise_density=0.2),
    gnss=Gnss(fix_sd=(1.0, 1.0, 1.5), velocity_sd=(0.3, 0.3, 0.5),
              time_offset_sd=PARAMS.gnss.time_offset_sd))
# The plane is thrown after some 15 s.
LAGS, FLYING = 10, 20.0


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


def autocorrelation(innovation):
    """Of each component (LAGS, 3), at lags 1 to LAGS."""
    e = innovation - innovation.mean(axis=0)
    return np.stack([np.sum(e[k:] * e[:-k], axis=0) for k in range(1, LAGS + 1)]) / np.sum(
        e * e, axis=0)


def whiteness_statistic(innovation):
    """Autocorrelation of each component (LAGS, 3) as a multiple of its standard deviation for
    white noise whose size may change, as it does from gliding to dives (Taylor 1984)."""
    e = innovation - innovation.mean(axis=0)
    return np.stack([np.sum(e[k:] * e[:-k], axis=0)
                     / np.sqrt(np.sum((e[k:] * e[:-k]) ** 2, axis=0)) for k in range(1, LAGS + 1)])


def whiteness(innovation):
    """Text: RMS, autocorrelation at lag 1, the largest of the later ones, the shares of lags and
    components within the 95 % bound of white noise of constant and of changing size, that of
    innovations within 1.96."""
    r = autocorrelation(innovation)
    rms = "/".join(f"{v:.2f}" for v in np.sqrt(np.mean(innovation ** 2, axis=0)))
    steady = np.mean(np.abs(r) <= 1.96 / np.sqrt(len(innovation)))
    changing = np.mean(np.abs(whiteness_statistic(innovation)) <= 1.96)
    return (f"{rms} | {'/'.join(f'{v:.2f}' for v in r[0])} | {np.abs(r[1:]).max():.2f} | "
            f"{100 * steady:.0f} / {100 * changing:.0f} % | "
            f"{100 * np.mean(np.abs(innovation) <= 1.96):.0f} %")


def heading_deg(quat):
    """Of the nose, from north, clockwise."""
    nose = Rotation.from_quat(quat).apply([1.0, 0.0, 0.0])
    return np.degrees(np.arctan2(nose[:, 0], nose[:, 1]))


def compass_deg(quat, mag, declination_deg):
    """Heading of the bare magnetometer (n, 3), levelled by the tilt of quat (n, 4): the nose
    from where the horizontal field points."""
    field = Rotation.from_quat(quat).apply(mag)
    return (heading_deg(quat) - np.degrees(np.arctan2(field[:, 0], field[:, 1]))
            + declination_deg)


def spread_deg(angle):
    """RMS of angles, wrapped to half a turn."""
    return float(np.sqrt(np.mean(((angle + 180.0) % 360.0 - 180.0) ** 2)))


def velocity_changes(stamp, quat, imu, velocity, late):
    """In flight: what the force, turned by quat and freed from gravity, has added to the velocity
    by each fix (m, 3) m/s, the GNSS velocity (m, 3) m/s, and the times of both (m,) s."""
    since = (imu.stamp - imu.stamp[0]) * 1e-9
    force = np.column_stack([np.interp((stamp - imu.stamp[0]) * 1e-9, since, c)
                             for c in imu.acc.T])
    at = (stamp - stamp[0]) * 1e-9
    acc = Rotation.from_quat(quat).apply(force) - [0.0, 0.0, 9.807]
    speed = np.concatenate([np.zeros((1, 3)), np.cumsum(
        0.5 * (acc[1:] + acc[:-1]) * np.diff(at)[:, None], axis=0)])
    fixes = (velocity.stamp - stamp[0]) * 1e-9 - late
    use = np.flatnonzero((fixes > FLYING) & (fixes < at[-1]))
    gained = np.column_stack([np.interp(fixes[use], at, c) for c in speed.T])
    return gained, velocity.vel_world[use], fixes[use]


def acceleration_misfit(stamp, quat, imu, velocity, late):
    """RMS (east, north, up) m/s^2 by which the force misses the change of GNSS velocity, over
    steps of about a second in flight. Neither wind nor compass enters."""
    gained, v, time = velocity_changes(stamp, quat, imu, velocity, late)
    miss = (gained[5:] - gained[:-5] - v[5:] + v[:-5]) / (time[5:] - time[:-5])[:, None]
    return np.sqrt(np.mean(miss ** 2, axis=0))


def receiver_gains(stamp, quat, imu, velocity, late):
    """Lines of a table: how much of the inertial change of velocity the receiver shows, by
    frequency, and the coherence of the two."""
    gained, v, _ = velocity_changes(stamp, quat, imu, replace(
        velocity, stamp=even_stamps(velocity.stamp)), late)
    steps, shown = np.diff(gained, axis=0), np.diff(v, axis=0)
    spectra = dict(fs=5.0, nperseg=50, axis=0)
    frequency, power = welch(steps, **spectra)
    gain = np.abs(csd(steps, shown, **spectra)[1]) / power
    common = coherence(steps, shown, **spectra)[1]
    lines = ["| frequency, Hz | gain east/north/up | coherence |", "|---|---|---|"]
    for i in (1, 4, 7, 10, 13):
        lines.append(f"| {frequency[i]:.1f} | " + " | ".join(
            "/".join(f"{value:.2f}" for value in row[i]) for row in (gain, common)) + " |")
    return ["What the receiver's velocity shows of the inertial one:", "", *lines, "",
            "The vertical velocity is smoothed: neighbouring fixes share its error. Noise of the "
            "inertial one lowers the gain by the coherence at most."]


def attitudes(result, data):
    """Lines of the table that sets our attitude and the autopilot's beside independent
    readings."""
    imu, mag, fix, velocity, (stamp, reference) = data
    late = result.states["gnss_time_offset"][0][0, 0]
    samples = result.samples
    gains = receiver_gains(samples["stamp"], samples["quat_world_imu"], imu, velocity, late)
    ours = Slerp((samples["stamp"] - stamp[0]) * 1e-9, Rotation.from_quat(
        samples["quat_world_imu"]))((stamp - stamp[0]) * 1e-9).as_quat()
    since = (stamp - stamp[0]) * 1e-9
    later = since > FLYING
    track = np.unwrap(np.arctan2(velocity.vel_world[:, 0], velocity.vel_world[:, 1]))
    course = np.degrees(np.interp(since, (velocity.stamp - stamp[0]) * 1e-9 - late, track))
    field = mag.mag[np.searchsorted(mag.stamp, stamp).clip(max=len(mag) - 1)]
    east = np.degrees(declination(fix.latitude_deg[0], fix.longitude_deg[0], fix.height[0],
                                  decimal_year(fix.stamp[0])))
    lines = ["| attitude | heading less GNSS course, RMS deg | heading less bare compass, RMS deg "
             "| misfit of force and GNSS velocity, RMS east/north/up m/s^2 |", "|---|---|---|---|"]
    for name, quat in (("smoothed, without magnetometer", ours), ("autopilot", reference)):
        heading = heading_deg(quat)
        misfit = acceleration_misfit(stamp, quat, imu, velocity, late)
        lines.append(f"| {name} | {spread_deg((heading - course)[later]):.1f} | "
                     f"{spread_deg((heading - compass_deg(quat, field, east))[later]):.1f} | "
                     + "/".join(f"{m:.2f}" for m in misfit) + " |")
    difference = (Rotation.from_quat(ours) * Rotation.from_quat(reference).inv()).as_rotvec(
        degrees=True)[later]
    lines += ["", "The two differ by "
              + "/".join(f"{a:.1f}" for a in np.sqrt(np.mean(difference ** 2, axis=0)))
              + f" deg RMS about east/north/up. Declination there is {east:.1f} deg. A heading "
              "differs from the course by the wind as well; the last column is free of it.",
              "", *gains]
    return lines


def main():
    data = load()
    if data is None:
        print("px4_plane is not at hand: set IMU_FUSION_DATA")
        return
    imu, mag, fix, velocity, _ = data
    lines = ["Fixed-wing flight of 100 s (priseborough/InertialNav, BSD-3). Innovations are those "
             "of the filter forward, one reading ahead. The 95 % bound of the "
             "autocorrelation of white noise is given twice: for noise of constant size, and for "
             "one whose size may change (Taylor 1984), as it does in the dives.", "",
             "| | innovations | RMS (ideal 1) | autocorrelation, lag 1 | largest, lags 2-10 | "
             "autocorrelations within the bound, constant / changing size (ideal 95 %) | "
             "innovations within 1.96 (ideal 95 %) | iterations | GNSS delay ms |",
             "|---|---|---|---|---|---|---|---|---|"]
    for name, params, log, first in (
            ("white errors, stamps as logged", WHITE, None, 0),
            ("white errors, even stamps", WHITE.replace(**{"gnss.even_stamps": True}), None, 0),
            ("wandering errors, even stamps", WANDERING, None, 0),
            ("the same, every second fix", PARAMS, None, 0),
            ("the same, beginning with the second", PARAMS, None, 1),
            ("every second fix, magnetometer", PARAMS, mag, 0),
            ("the same, beginning with the second", PARAMS, mag, 1)):
        result = Smoother(params).run(imu, log, fix[first:], velocity[first:])
        offset, sd = (a[0, 0] for a in result.states["gnss_time_offset"])
        for kind in ("fix", "velocity"):
            lines.append(f"| {name} | {kind} | {whiteness(result.innovations[kind][1])} | "
                         f"{result.iterations}{'' if result.converged else ' (did not converge)'}"
                         f" | {1e3 * offset:.0f} +- {1e3 * sd:.0f} |")
        if params is PARAMS and log is None and first == 0:
            beside = attitudes(result, data)
    write("smoother_flight", "\n".join([*lines, "", *beside]))


if __name__ == "__main__":
    main()
