"""A ground robot whose GNSS height wanders: python -m benchmarks.smoother_ground

No truth: the site is flat, so the spread of the smoothed height is set beside that of the
fixes. The Imu runs at 30 Hz and the bag has no magnetometer and no GNSS velocity.
"""

import numpy as np

from benchmarks.data import config, data_path
from benchmarks.jumps import write
from imu_fusion.errors import ImuFusionError
from imu_fusion.estimation.smoother import Smoother
from imu_fusion.estimation.smoother.params import Gnss
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.streams.smoother_params import SurfaceFile
from imu_fusion.surfaces.file import load_surface

# A site is flat to 0.3 m over its length, not anew every 10 ms: some seconds of driving.
FLAT = config("husky")
# Fixes wander by metres over minutes and scatter by some 0.3 m from one to the next.
WANDER = FLAT.replace(surface=SurfaceFile())
BASE = WANDER.replace(gnss=Gnss(covariances=FLAT.gnss.covariances))


def main():
    path = data_path("husky") / "test1.bag"
    if not path.exists():
        print("husky is not at hand: set IMU_FUSION_DATA")
        return
    with open_bag(path) as reader:
        imu, fix = read_log(reader, "/imu/data"), read_log(reader, "/fix")
    valid = np.flatnonzero(fix.status >= 0)
    plane = load_surface(FLAT.surface.file)
    lines = [f"Husky (cra-ros-pkg/robot_localization, BSD): {len(imu)} Imu samples, {len(valid)} "
             f"fixes, whose height spans {np.ptp(fix.height[valid]):.0f} m.", "",
             "| | iterations | height of the trajectory, span m | vertical sd m, median | RMS of "
             "normalised fix innovations |", "|---|---|---|---|---|"]
    for name, params, surface in (
            ("white fixes, nothing fitted", BASE.replace(maximum_likelihood="off"), None),
            ("white fixes, what the data tell (default)", BASE, None),
            ("wandering fixes", WANDER, None), ("wandering fixes, plane", FLAT, plane)):
        try:
            result = Smoother(params, surface).run(imu, None, fix)
        except ImuFusionError as error:
            lines.append(f"| {name} | - | {error} | | |")
            continue
        s = result.samples
        state = "" if result.converged else " (did not converge)"
        rms = np.sqrt(np.mean(result.innovations["fix"][1] ** 2, axis=0))
        lines.append(f"| {name} | {result.iterations}{state} | "
                     f"{np.ptp(s['position_world'][:, 2]):.1f} | "
                     f"{np.median(np.sqrt(s['cov_position'][:, 2, 2])):.2f} | "
                     + "/".join(f"{r:.2f}" for r in rms) + " |")
    write("smoother_ground", "\n".join(lines))


if __name__ == "__main__":
    main()
