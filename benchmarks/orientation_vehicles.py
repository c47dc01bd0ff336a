"""Tilt on a car and an aeroplane: python -m benchmarks.orientation_vehicles

The reference is the smoother with GNSS, which knows the accelerations that an orientation
estimator must guess; its own standard deviation is in the table. The preset's magnetometer
errors were chosen after a look at this aeroplane, the rest of it in round numbers.
"""

import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import smoother_drive, smoother_flight
from benchmarks.orientation_broad import offline_vqf, vqf
from benchmarks.table import write_table
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.estimation.smoother import Smoother
from imu_fusion.parameters.file import load

_VEHICLE = Path(__file__).parent.parent / "config/orientation_vehicle.yaml"


def tilt_deg(quat, reference):
    """Angle (n,) between both verticals."""
    error = Rotation.from_quat(quat) * Rotation.from_quat(reference).inv()
    return np.degrees(np.arccos(np.clip(error.as_matrix()[:, 2, 2], -1.0, 1.0)))


def main():
    rows = []
    for name, module in (("car, 549 s, no magnetometer", smoother_drive),
                         ("fixed-wing aeroplane, 100 s", smoother_flight)):
        data = module.load()
        if data is None:
            print(f"{name}: not at hand, set IMU_FUSION_DATA")
            continue
        imu, mag, fix, velocity = ((data[0], None, *data[1:3]) if module is smoother_drive
                                   else data[:4])
        known = Smoother(module.PARAMS).run(imu, None, fix, velocity).samples
        sd = math.degrees(math.sqrt(np.median(np.trace(known["cov_attitude"][:, :2, :2],
                                                       axis1=1, axis2=2))))
        found = {}
        vehicle = load(_VEHICLE)["orientation_estimator"]
        for label, changes in (("fusion", {}), ("fusion, orientation_vehicle.yaml", vehicle)):
            for mode in ("causal", "smoothed"):
                out = OrientationEstimator(OrientationParams.from_mapping(
                    {"mode": mode, **changes})).run(imu, mag)
                found[f"{label}, {mode}"] = (out["stamp"], out["quat_world_imu"],
                                             out["cov_attitude"])
        found["VQF"] = (imu.stamp, vqf(imu, mag), None)
        found["OfflineVQF"] = (imu.stamp, offline_vqf(imu, mag), None)
        for estimator, (stamp, quat, cov) in found.items():
            _, i, j = np.intersect1d(stamp, known["stamp"], return_indices=True)
            error = tilt_deg(quat[i], known["quat_world_imu"][j])
            stated = within = ""
            if cov is not None:
                r = Rotation.from_quat(quat[i]).as_matrix()
                world = r @ cov[i] @ r.transpose(0, 2, 1)
                spread = np.degrees(np.sqrt(world[:, 0, 0] + world[:, 1, 1]))
                stated = f"{np.sqrt((spread ** 2).mean()):.2f}"
                within = f"{100 * (error < 3 * spread).mean():.0f} %"
            rows.append([name, f"{sd:.1f}", estimator, f"{np.sqrt((error ** 2).mean()):.2f}",
                         f"{error.max():.1f}", stated, within])
            print(rows[-1], flush=True)
    write_table("orientation_vehicles", [
        "recording", "sd of the reference, deg", "estimator", "tilt RMS, deg", "largest",
        "stated RMS", "within 3 sigma"], rows,
        note="A vehicle keeps its accelerations longer than a hand. By default the errors are "
             "smaller than the peers', and the covariance is widened by what the innovations "
             "show; told what a vehicle is like, it is closer. The preset's magnetometer errors were chosen on this "
             "aeroplane.")


if __name__ == "__main__":
    main()
