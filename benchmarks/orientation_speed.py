"""Microseconds per sample of the orientation estimators, beside their peers.

    python -m benchmarks.orientation_speed

One BROAD trial (Imu and magnetometer at 285.7 Hz) from bags/, every estimator in
this process, the best of several passes. Cold start is a new process with an empty
compilation cache, cached start one with a full cache.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.table import write_table
from imu_fusion.estimation.orientation import OrientationEstimator, OrientationParams
from imu_fusion.messages.bag import open_bag
from imu_fusion.messages.convert import read_log

BAG = Path(__file__).resolve().parents[1] / "bags" / "broad_06_fast_rotation"
SINGLE = 5000  # samples of a pass of single calls
PASSES = 5
START = """
import time; began = time.perf_counter()
import numpy as np
from imu_fusion.estimation.orientation import OrientationEstimator
estimator = OrientationEstimator()
for i in range(300):
    estimator.add_mag(i * 10**7, np.array([0.0, 2e-5, -4e-5]))
    estimator.add_imu(i * 10**7, np.zeros(3), np.array([0.0, 0.0, 9.81]))
print(time.perf_counter() - began)
"""


def best(function, samples):
    """Microseconds per sample of the fastest of PASSES calls."""
    times = []
    for _ in range(PASSES):
        began = time.perf_counter()
        function()
        times.append(time.perf_counter() - began)
    return min(times) / samples * 1e6


def ours(imu, mag, **params):
    """(batch, single) us per Imu sample; every one has a magnetometer sample beside it."""
    params = OrientationParams(**params)
    batch = best(lambda: OrientationEstimator(params).run(imu, mag), len(imu))
    if params.mode == "smoothed":
        return batch, None

    def single():
        estimator = OrientationEstimator(params)
        for i in range(SINGLE):
            estimator.add_mag(stamps[i], mag.mag[i])
            estimator.add_imu(stamps[i], imu.gyr[i], imu.acc[i])

    stamps = imu.stamp[:SINGLE].tolist()
    return batch, best(single, SINGLE)


def peers(imu, mag):
    """{name: (batch, single)} of the estimators on PyPI, with their defaults."""
    import ahrs
    import imufusion
    import vqf
    step = float(np.median(np.diff(imu.stamp))) * 1e-9
    gyr, acc, field = (np.ascontiguousarray(a) for a in (imu.gyr, imu.acc, mag.mag))
    gyr_deg, acc_g, field_ut = np.degrees(gyr), acc / 9.80665, field * 1e6

    def vqf_single():
        estimator = vqf.VQF(step)
        for i in range(SINGLE):
            estimator.update(gyr[i], acc[i], field[i])
            estimator.getQuat9D()

    def imufusion_single():
        estimator = imufusion.Ahrs()
        estimator.set_sample_period(step)
        for i in range(SINGLE):
            estimator.update(gyr_deg[i], acc_g[i], field_ut[i])
            estimator.get_quaternion()

    def madgwick_single():
        estimator = ahrs.filters.Madgwick(Dt=step)
        quat = np.array([1.0, 0.0, 0.0, 0.0])
        for i in range(SINGLE):
            quat = estimator.updateMARG(quat, gyr=gyr[i], acc=acc[i], mag=field[i] * 1e9)

    return {"vqf.VQF (C++)": (best(lambda: vqf.VQF(step).updateBatch(gyr, acc, field), len(gyr)),
                              best(vqf_single, SINGLE)),
            "vqf.offlineVQF (C++)": (best(lambda: vqf.offlineVQF(gyr, acc, field, step), len(gyr)),
                                     None),
            "imufusion.Ahrs (C)": (None, best(imufusion_single, SINGLE)),
            "ahrs Madgwick (numpy)": (None, best(madgwick_single, SINGLE))}


def start_times():
    """Seconds from import to 300 samples: (empty cache, full cache)."""
    with tempfile.TemporaryDirectory() as cache:
        environment = dict(os.environ, NUMBA_CACHE_DIR=cache)
        return [float(subprocess.run([sys.executable, "-c", START], env=environment, check=True,
                                     capture_output=True, text=True).stdout) for _ in range(2)]


def main():
    """Measure, print and write benchmarks/results/orientation_speed.md."""
    with open_bag(BAG) as reader:
        imu, mag = read_log(reader, "imu/data_raw"), read_log(reader, "imu/mag")
    assert np.array_equal(imu.stamp, mag.stamp)
    rows = {"imu_fusion gyro_mag": ours(imu, mag, method="gyro_mag"),
            "imu_fusion fusion, causal": ours(imu, mag),
            "imu_fusion fusion, smoothed": ours(imu, mag, mode="smoothed"),
            **peers(imu, mag)}
    reference = rows["vqf.VQF (C++)"]

    def cell(value, peer):
        if value is None:
            return ""
        return f"{value:.2f} ({value / peer:.1f} x)"

    cold, cached = start_times()
    write_table("orientation_speed", ["estimator", "batch, us/sample", "single call, us/sample"],
                [[name, cell(batch, reference[0]), cell(single, reference[1])]
                 for name, (batch, single) in rows.items()],
                "In brackets the ratio to vqf.VQF in the same run; a single call includes the "
                f"magnetometer sample. From import to 300 samples: {cold:.1f} s with an empty "
                f"compilation cache, {cached:.1f} s with a full one.")


if __name__ == "__main__":
    main()
