"""BROAD: orientation error beside VQF, Madgwick, Mahony and imufusion, in one run.

Every estimator runs with and without compensation of the sensors' delays (gyroscope
and accelerometer 4 ms, magnetometer 15 ms behind the optical reference: properties
of the data set, known before). Where something is tuned, it is one parameter set
for all trials, chosen by leave-one-trial-out: the figures of a trial come from
the set that was best on the others.

    python -m benchmarks.orientation_broad [--ours]

``--ours`` computes our estimators anew and keeps the peers' lines of the last whole run,
which takes half an hour.
"""

import itertools
import sys

import ahrs.filters
import imufusion
import numpy as np
from scipy.spatial.transform import Rotation
from vqf import VQF, offlineVQF

from benchmarks.data import broad_errors, broad_trials, load_broad
from benchmarks.table import lines_of_last_run, write_table
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.samples.logs import ImuLog, MagLog

GYR_DELAY, MAG_DELAY = 0.004, 0.015
# Madgwick's world is NWU.
_FROM_NWU = Rotation.from_euler("Z", 90, degrees=True)
# chi2 with 3 degrees of freedom, the probability of 3 sigma of a normal variate.
_THREE_SIGMA = 14.156


def advance(log, column, delay):
    """Samples of ``column`` as they would be without delay, by linear interpolation."""
    t = log.stamp * 1e-9
    return np.column_stack([np.interp(t + delay, t, v) for v in getattr(log, column).T])


def compensated(imu, mag):
    """The logs with their delays taken out (accelerometer and gyroscope share a chip)."""
    return (ImuLog(imu.stamp, advance(imu, "gyr", GYR_DELAY), advance(imu, "acc", GYR_DELAY)),
            MagLog(mag.stamp, advance(mag, "mag", MAG_DELAY)))


def _field(mag):
    """What VQF takes for a magnetometer, or None, and the name of its result."""
    return (None, "quat6D") if mag is None else (mag.mag * 1e6, "quat9D")


def vqf(imu, mag, tau_acc=3.0, tau_mag=9.0):
    dt = (imu.stamp[-1] - imu.stamp[0]) * 1e-9 / (len(imu) - 1)
    field, key = _field(mag)
    out = VQF(dt, tauAcc=tau_acc, tauMag=tau_mag).updateBatch(imu.gyr, imu.acc, field)
    return out[key][:, [1, 2, 3, 0]]


def offline_vqf(imu, mag, tau_acc=3.0, tau_mag=9.0):
    dt = (imu.stamp[-1] - imu.stamp[0]) * 1e-9 / (len(imu) - 1)
    field, key = _field(mag)
    out = offlineVQF(imu.gyr, imu.acc, field, dt, dict(tauAcc=tau_acc, tauMag=tau_mag))
    return out[key][:, [1, 2, 3, 0]]


def madgwick(imu, mag):
    f = ahrs.filters.Madgwick(imu.gyr, imu.acc, mag.mag * 1e9, frequency=_frequency(imu))
    return (_FROM_NWU * Rotation.from_quat(f.Q[:, [1, 2, 3, 0]])).as_quat()


def mahony(imu, mag):
    """ahrs starts Mahony from an ENU attitude and keeps to it: no rotation of the world."""
    f = ahrs.filters.Mahony(imu.gyr, imu.acc, mag.mag * 1e6, frequency=_frequency(imu))
    return f.Q[:, [1, 2, 3, 0]]


def fusion(imu, mag):
    """imufusion with its documented example settings."""
    filter_ = imufusion.Ahrs()
    settings = imufusion.AhrsSettings()
    settings.convention = imufusion.CONVENTION_ENU
    settings.gain = 0.5
    settings.gyroscope_range = 2000
    settings.acceleration_rejection = 10
    settings.magnetic_rejection = 10
    settings.rejection_timeout = 5.0
    settings.sample_rate = _frequency(imu)
    filter_.set_settings(settings)
    gyr, acc, field = np.degrees(imu.gyr), imu.acc / 9.80665, mag.mag * 1e6
    quat = np.empty((len(imu), 4))
    for i in range(len(imu)):
        filter_.update(gyr[i], acc[i], field[i])
        quat[i] = filter_.get_quaternion()
    return quat[:, [1, 2, 3, 0]]


def ours(imu, mag, changes):
    """Rows of the orientation estimator."""
    return OrientationEstimator(OrientationParams.from_mapping(changes)).run(imu, mag)


def share_within(rows, reference, mask):
    """Share of masked samples whose error lies within 3 sigma of the estimate."""
    keep = mask & np.isfinite(reference).all(axis=1)
    error = (Rotation.from_quat(rows["quat_world_imu"][keep]).inv()
             * Rotation.from_quat(reference[keep])).as_rotvec()
    distance = np.einsum("ni,nij,nj->n", error, np.linalg.inv(rows["cov_attitude"][keep]), error)
    return float((distance < _THREE_SIGMA).mean())


def _frequency(imu):
    return (len(imu) - 1) / ((imu.stamp[-1] - imu.stamp[0]) * 1e-9)


def leave_one_out(errors):
    """errors: (sets, trials, 3). Per trial, the errors of the set best on the others."""
    chosen = []
    for trial in range(errors.shape[1]):
        others = np.delete(errors[:, :, 0], trial, axis=1).mean(axis=1)
        chosen.append(errors[int(np.argmin(others)), trial])
    return np.array(chosen)


def peers_of_last_run():
    """The table's lines of peers as the last whole run wrote them."""
    return [row for row in lines_of_last_run("orientation_broad") if not row[0].startswith(("fusion", "gyro_mag"))]


def main(only_ours=False):
    trials = [load_broad(path) for path in broad_trials()]
    if not trials:
        print("BROAD is not here: set IMU_FUSION_DATA (see benchmarks/data.py)")
        return
    prepared = [[(imu, mag) for imu, mag, _, _ in trials],
                [compensated(imu, mag) for imu, mag, _, _ in trials]]

    def score(run, delays):
        return np.array([broad_errors(run(*logs), ref, mask) for logs, (_, _, ref, mask)
                         in zip(prepared[delays], trials, strict=True)])

    rows = []
    kept = peers_of_last_run() if only_ours else []

    names = " ".join(path.name[:2] for path in broad_trials())

    def add(name, tuning, plain, delayed, share=""):
        rows.append([name, tuning, *("" if e is None
                                     else " / ".join(f"{v:.2f}" for v in e.mean(axis=0))
                                     for e in (plain, delayed)),
                     " ".join(f"{v:.1f}" for v in delayed[:, 0]), share])
        # Written after every line: the slow peers come last.
        write_table("orientation_broad", [
            "estimator", "parameters", "as recorded: total / heading / inclination, deg",
            "delays compensated", f"total of trials {names}", "within 3 sigma"], rows + kept,
            note=f"BROAD (Laidig et al. 2021), {len(trials)} trials: RMSE over the samples in "
                 "motion, mean over the trials. 'Within 3 sigma' counts samples whose attitude "
                 "error has a Mahalanobis distance below the 99.73 % quantile.")

    # Ours takes the gyroscope's delay as its parameter and finds the magnetometer's itself,
    # so it always gets the recordings as they are.
    def mine(changes):
        results = [ours(imu, mag, changes) for imu, mag in prepared[0]]
        errors = np.array([broad_errors(r["quat_world_imu"], ref, mask)
                           for r, (_, _, ref, mask) in zip(results, trials, strict=True)])
        share = np.mean([share_within(r, ref, mask)
                         for r, (_, _, ref, mask) in zip(results, trials, strict=True)])
        return errors, share

    for name, changes in [("gyro_mag", dict(method="gyro_mag")),
                          ("gyro_mag as printed (Winkler 2025)",
                           {"method": "gyro_mag", "gyro_mag.as_printed": True}),
                          ("fusion, causal, use_acc false", {"fusion.use_acc": False}),
                          ("fusion, smoothed, use_acc false",
                           {"fusion.use_acc": False, "mode": "smoothed"}),
                          ("fusion, causal", {}), ("fusion, smoothed", dict(mode="smoothed"))]:
        delays = {"sensor.gyro_delay": GYR_DELAY}
        if name.startswith("gyro_mag as printed"):
            delays["sensor.mag_delay"] = MAG_DELAY
        plain, _ = mine(changes)
        errors, share = mine(changes | delays)
        add(name, "defaults", plain, errors, f"{100 * share:.0f} %")
        if "method" in changes or "fusion.use_acc" in changes:
            continue
        default = OrientationParams()
        sets = [{}, {"fusion.mag_disturbance_sd": 0.5}, {"fusion.mag_disturbance_sd": 2.0}]
        tuned = leave_one_out(np.array([mine(changes | delays | {
            k: default.get(k) * v for k, v in s.items()})[0] for s in sets]))
        add(name, "leave one out", None, tuned)

    if only_ours:
        return
    for name, run in [("Madgwick (ahrs)", madgwick), ("Mahony (ahrs)", mahony),
                      ("imufusion", fusion), ("VQF", vqf), ("OfflineVQF", offline_vqf)]:
        add(name, "defaults", score(run, 0), score(run, 1))
    grid = list(itertools.product((1.5, 3.0, 5.0), (9.0, 25.0, 70.0)))
    for name, run in [("VQF", vqf), ("OfflineVQF", offline_vqf)]:
        add(name, "leave one out", *(leave_one_out(np.array(
            [score(lambda i, m, s=s, run=run: run(i, m, *s), d) for s in grid])) for d in (0, 1)))


if __name__ == "__main__":
    main(only_ours="--ours" in sys.argv[1:])
