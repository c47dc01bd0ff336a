"""Real data: eight accelerometers and gyroscopes on one board, turned by hand (mimu4444).

    python -m benchmarks.acceleration_field_mimu4444

Clipped gyroscopes: all gyroscopes are clipped at 1000 deg/s; the mean of the eight, unclipped,
is the truth where none of them is at its own range of 2000 deg/s. Accelerometers only: windows
of 2 s, each started from the gyroscopes' rate.
"""

import numpy as np
from scipy.interpolate import CubicSpline

from benchmarks.acceleration_field_cases import EXACT
from benchmarks.data import data_path
from benchmarks.table import write_table
from imu_fusion.estimation.acceleration_field.estimator import AccelerationFieldEstimator
from imu_fusion.estimation.acceleration_field.params import (
    AccelerationFieldParams,
    AccelerometerParams,
    Initial,
    Iteration,
    Motion,
)
from imu_fusion.sensors.accelerometer_calibration import calibrate_array

RATE = 62.5
LIMIT = np.radians(1000)
# Where maximum likelihood begins: a hand's angular acceleration of about 500 rad/s^2 that
# changes within 10 ms.
BEGIN = AccelerationFieldParams(    # chips on a board: as in config/mimu4444.yaml
    sensor=EXACT,
    sample_rate=RATE, mode="smoothed", initial=Initial(duration=5.0),
    motion=Motion(rate=100.0, jerk_density=1e6, acceleration_rate_density=1e4),
    noise_scale=10.0, maximum_likelihood="motion_and_noise", iteration=Iteration(max=1))
ITERATIONS = 10
FIT_SAMPLES = 2000  # of the recording, for maximum likelihood: 32 s, of which 20 s in motion


def load(run):
    """One recording: stamp (n,), acc (n, 8, 3) in the axes of chip 0, gyr (n, 8, 3) rad/s,
    at_range (n, 3) whether any chip's gyroscope was, positions (8, 3), still noise m/s^2."""
    d = np.load(data_path("mimu4444") / f"exp{run}_dynamic.npz")
    calibration = calibrate_array(d["static_means_mps2"])
    acc = calibration.apply(d["acc_counts"] * float(d["acc_lsb_mps2"]))
    turn = d["frame_R"].astype(float)
    gyr = np.radians(d["gyr_counts"] * float(d["gyr_lsb_dps"])) - d["gyro_bias_radps"]
    at_range = np.abs(d["gyr_counts"].astype(int)) >= 32767
    moved = np.einsum("kij,nkj->nki", np.abs(np.round(turn)), at_range.astype(float)) > 0.5
    table = np.genfromtxt(data_path("mimu4444") / "IMU_positions.csv", delimiter=",",
                          skip_header=1)
    still = d["t"] < 10
    noise = np.std(np.diff(acc[still], axis=0)) / np.sqrt(2)
    return (np.round(d["t"] * 1e9).astype(np.int64), acc, np.einsum("kij,nkj->nki", turn, gyr),
            moved.any(axis=1), table[:, 1:].T, noise)


def sensors(positions, noise):
    """The calibrated accelerometers, all in the axes of chip 0."""
    return [AccelerometerParams(position=tuple(p), noise_density=noise / np.sqrt(RATE),
                                bias_sd=0.1, range=(150.0,)) for p in positions]


def clipped_gyroscope(run):
    """Rows of the table: rms errors on the clipped axes."""
    stamp, acc, gyr, at_range, positions, noise = load(run)
    truth = gyr.mean(axis=1)
    clipped = (np.abs(gyr) >= LIMIT).any(axis=1)
    given = np.where(clipped, LIMIT * np.sign(truth), truth)
    judged = clipped & ~at_range
    # The chips differ this much, by their scale factors; their mean is trusted no better.
    spread = np.sqrt(np.mean(np.var(gyr, axis=1)[~at_range.any(axis=1)]))
    gyroscope = EXACT.replace(gyro_noise_density=spread / np.sqrt(RATE) / BEGIN.noise_scale,
                              gyro_range=(LIMIT,), gyro_axes_sd=0.0, gyro_scale_sd=0.0)
    fit = AccelerationFieldEstimator(BEGIN.replace(use_gyro=True, sensor=gyroscope),
                                     sensors(positions, noise))
    fit.run(stamp[:FIT_SAMPLES], acc[:FIT_SAMPLES], given[:FIT_SAMPLES])
    results = {}
    seconds = stamp * 1e-9
    spline = np.column_stack([CubicSpline(seconds[~c], truth[~c, k])(seconds)
                              for k, c in enumerate(clipped.T)])
    results["cubic spline through the rest"] = (spline - truth)[judged], np.nan
    for mode in ("causal", "smoothed"):
        iteration = Iteration(max=ITERATIONS) if mode == "smoothed" else Iteration()
        params = fit.fitted.replace(mode=mode, maximum_likelihood="off", iteration=iteration)
        rows = AccelerationFieldEstimator(params, sensors(positions, noise)).run(stamp, acc, given)
        begin = len(stamp) - len(rows)
        use = judged[begin:]
        sd = np.sqrt(np.mean(np.einsum("nii->ni", rows["cov_omega"])[use]))
        results[f"rigid_body, {mode}"] = (rows["omega"] - truth[begin:])[use], sd
    return [[f"run {run}", name, f"{np.sqrt(np.mean(e ** 2)):.2f}", f"{np.median(abs(e)):.2f}",
             "" if np.isnan(sd) else f"{sd:.2f}", len(e)] for name, (e, sd) in results.items()]


def accelerometers_only(run):
    """Rows of the table: rms error of the rate vector, median over windows of 2 s."""
    stamp, acc, gyr, at_range, positions, noise = load(run)
    truth = gyr.mean(axis=1)
    unusable = at_range.any(axis=1)
    length = int(2 * RATE)
    windows = [slice(k, k + length) for k in range(700, len(stamp) - length, length)
               if np.sqrt(np.mean(np.sum(truth[k:k + length] ** 2, axis=1))) > 15
               and not unusable[k] and np.mean(unusable[k:k + length]) < 0.3]
    begin = BEGIN.replace(initial=Initial(mode="given", angular_velocity_sd=0.2))
    # Five windows of maximum likelihood; the rest of the recording has no say.
    fits = []
    for window in windows[:5]:
        fit = AccelerationFieldEstimator(
            begin.replace(**{"initial.angular_velocity": tuple(truth[window.start])}),
            sensors(positions, noise))
        fit.run(stamp[window], acc[window])
        fits.append(fit.fitted)
    names = ("motion.rate", "motion.jerk_density", "motion.acceleration_rate_density",
             "noise_scale")
    fitted = {name: float(np.exp(np.median([np.log(f.get(name)) for f in fits])))
              for name in names}
    given = AccelerationFieldParams(sample_rate=RATE, sensor=EXACT, initial=begin.initial,
                                    max_condition=1e4)
    cases = {"AO (paper)": {"method": "ao"}, "sqrt-AO": {"method": "sqrt_ao"},
             "rigid_body, causal": fitted,
             "rigid_body, smoothed": {**fitted, "mode": "smoothed", "iteration.max": ITERATIONS}}
    table = []
    for name, change in cases.items():
        found = []
        for window in windows:
            params = given.replace(**{
                "initial.angular_velocity": tuple(truth[window.start]), **change})
            rows = AccelerationFieldEstimator(params, sensors(positions, noise)).run(
                stamp[window], acc[window])
            error = np.sum((rows["omega"] - truth[window])[~unusable[window]] ** 2, axis=1)
            found.append(np.sqrt(np.mean(error)))
        low, middle, high = np.percentile(found, [25, 50, 75])
        table.append([f"run {run}", name, f"{middle:.2f}", f"{low:.2f} - {high:.2f}",
                      len(windows)])
    speed = np.median([np.sqrt(np.mean(np.sum(truth[w] ** 2, axis=1))) for w in windows])
    print(run, fitted, f"speed {speed:.1f} rad/s")
    return table


def main():
    """Write both tables."""
    if not data_path("mimu4444").exists():
        raise SystemExit("mimu4444 is not at hand; set IMU_FUSION_DATA to the folder of the data")
    write_table("acceleration_field_clipped",
                ["recording", "method", "rms error, rad/s", "median |error|, rad/s",
                 "predicted sd, rad/s", "clipped axis samples"],
                clipped_gyroscope(1) + clipped_gyroscope(2),
                "mimu4444 (MIT, H. Carlsson): gyroscopes clipped at 1000 deg/s; errors on the "
                "clipped axes. Densities by maximum likelihood from the first 32 s, no truth used.")
    write_table("acceleration_field_accelerometers_only",
                ["recording", "method", "rms error, rad/s (median window)", "quartiles",
                 "windows"], accelerometers_only(1) + accelerometers_only(2),
                "mimu4444, eight accelerometers in two planes 2 mm apart, no gyroscope: error of "
                "the angular velocity vector over windows of 2 s.")


if __name__ == "__main__":
    main()
