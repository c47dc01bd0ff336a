"""Speed of the orientation step beside vqf, imufusion and ahrs, in one run.

us of processor time per sample on one synthetic recording (100 s, 286 Hz, magnetometer at
the same rate), best of seven rounds over all; ``single call`` is one Python call per
sample. Cold: a fresh interpreter with an empty numba cache compiles; warm: the cache is
filled.
"""

import os
import subprocess
import sys
import tempfile
import time

import ahrs.filters
import imufusion
import numpy as np
from vqf import VQF, offlineVQF

from benchmarks.table import write_table
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.simulation.rotation import Sensors, Tumbling, simulate

_START = """
import time
start = time.process_time()
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.simulation.rotation import Tumbling, simulate
imu, mag, _, _ = simulate(Tumbling(seed=1), 2.0)
OrientationEstimator(OrientationParams(method="{}")).run(imu, mag)
print(time.process_time() - start)
"""


def best_times(runs, rounds=7):
    """Least processor time of each run, s. In rounds, so that a slow spell of the machine meets
    all; the first round compiles."""
    best = [float("inf")] * len(runs)
    for _ in range(1 + rounds):
        for i, run in enumerate(runs):
            start = time.process_time()
            run()
            best[i] = min(best[i], time.process_time() - start)
    return best


def starts(method):
    """Processor seconds to the first result in a fresh interpreter: empty cache, filled cache."""
    with tempfile.TemporaryDirectory() as cache:
        environment = dict(os.environ, NUMBA_CACHE_DIR=cache)
        return [float(subprocess.run([sys.executable, "-c", _START.format(method)], check=True,
                                     env=environment, capture_output=True, text=True).stdout)
                for _ in range(2)]


def main():
    sensors = Sensors(gyr_density=1e-4, acc_density=2e-3, mag_sd=3e-7)
    imu, mag, _, _ = simulate(Tumbling(seed=1), 100.0, rate=286.0, sensors=sensors)
    n = len(imu)
    stamps = imu.stamp.tolist()
    dt = 1 / 286.0
    mag_ut = mag.mag * 1e6

    def batch(**params):
        return lambda: OrientationEstimator(OrientationParams.from_mapping(params)).run(imu, mag)

    def single(**params):
        def run():
            estimator = OrientationEstimator(OrientationParams.from_mapping(params))
            add_mag, add_imu, gyr, acc, field = (
                estimator.add_mag, estimator.add_imu, imu.gyr, imu.acc, mag.mag)
            for i in range(n):
                add_mag(stamps[i], field[i])
                add_imu(stamps[i], gyr[i], acc[i])
        return run

    def vqf_single():
        filter_ = VQF(dt)
        for i in range(n):
            filter_.update(imu.gyr[i], imu.acc[i], mag_ut[i])
            filter_.getQuat9D()

    def imufusion_single():
        filter_ = imufusion.Ahrs()
        filter_.set_sample_period(dt)
        gyr, acc = np.degrees(imu.gyr), imu.acc / 9.80665
        for i in range(n):
            filter_.update(gyr[i], acc[i], mag_ut[i])
            filter_.get_quaternion()

    measured = [
        ("fusion, causal", batch(), single()),
        ("fusion, smoothed", batch(mode="smoothed"), None),
        ("gyro_mag", batch(method="gyro_mag"), single(method="gyro_mag")),
        ("VQF", lambda: VQF(dt).updateBatch(imu.gyr, imu.acc, mag_ut), vqf_single),
        ("OfflineVQF", lambda: offlineVQF(imu.gyr, imu.acc, mag_ut, dt), None),
        ("imufusion", None, imufusion_single),
        ("Madgwick (ahrs)", lambda: ahrs.filters.Madgwick(
            imu.gyr[:3000], imu.acc[:3000], mag_ut[:3000] * 1e3, frequency=286.0), None)]
    best = iter(best_times([run for _, *runs in measured for run in runs if run]))
    rows = []
    for name, *runs in measured:
        count = 3000 if name.startswith("Madgwick") else n
        rows.append([name, *(next(best) / count * 1e6 if run else None for run in runs)])
    reference = next(row[1] for row in rows if row[0] == "VQF")
    cells = [[name, *("" if t is None else f"{t:.2f}" for t in times),
              "" if times[0] is None else f"{times[0] / reference:.1f}"]
             for name, *times in rows]
    for row in cells:
        row.append(" / ".join(f"{s:.1f}" for s in starts(row[0].split(",")[0]))
                   if row[0] in ("fusion, causal", "gyro_mag") else "")
    write_table("orientation_speed", [
        "estimator", "batch, us/sample", "single call, us", "batch relative to VQF",
        "first result cold / warm, s"], cells,
        note="Processor time. Ours includes both calls, magnetometer and Imu, and writes "
             "covariances, bias and flags with every row.")


if __name__ == "__main__":
    main()
