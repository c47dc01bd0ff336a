"""Surfaces that are not those of the jump, and what the smoother says about them:
python -m benchmarks.smoother_surface_fit"""

import dataclasses

import numpy as np
import yaml

from benchmarks.jumps import moved, score, write
from imu_fusion.demos.data import data_folder
from imu_fusion.errors import ImuFusionError
from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.simulation.jump_sensors import record
from imu_fusion.simulation.ski_jump import JumpParams, SkiJump
from imu_fusion.surfaces.file import load_surface, surface_from_mapping

SEEDS = range(20)
NAME = "oberstdorf_hs106"


def main():
    hill = load_surface(NAME)
    certificate = yaml.safe_load((data_folder("config") / "surfaces" / f"{NAME}.yaml").read_text())

    def built(**changes):
        return surface_from_mapping({**certificate, **changes})

    jump = SkiJump(hill)
    wobble = jump.params.wobble
    cases = [("that of the jump", jump, hill)]
    cases += [(f"that of the jump, sensor moves by {100 * k * wobble:.1f} cm",
               SkiJump(hill, JumpParams(wobble=k * wobble)), hill) for k in (0.0, 2.0, 4.0)]
    cases += [(name, jump, surface) for name, surface in (
        ("1 degree turned", dataclasses.replace(hill, azimuth_deg=hill.azimuth_deg + 1.0)),
        ("5 m to the north", moved(hill, north=5.0)), ("1 m lower", moved(hill, up=-1.0)),
        ("3 m lower", moved(hill, up=-3.0)),
        ("in-run radius 10 % larger", built(r1=1.1 * certificate["r1"])),
        ("in-run 0.5 degrees flatter", built(gamma_deg=certificate["gamma_deg"] - 0.5)),
        ("landing radius 10 % larger", built(rL=1.1 * certificate["rL"])),
        ("the neighbouring large hill", load_surface("oberstdorf_hs137")))]
    lines = [f"Simulated jumps on {NAME}, {len(SEEDS)} seeds each, smoothed with a surface that "
             "may be another. Deviation over seconds: of the trajectory from the part of the "
             "surface that fits worst, by what sigma allows (SurfaceFit.excess). Fixes beside: "
             "largest component of the median innovation of fixes, in standard deviations of a "
             "fix.", "",
             "| surface given | position x/y/z m | length m | deviation over seconds: median, "
             "largest | fixes beside: median | runs with a remark |", "|---|---|---|---|---|---|"]
    for name, ridden, surface in cases:
        smoother, rows, remarked = Smoother(SmootherParams(), surface), [], 0
        for seed in SEEDS:
            r = record(ridden.shaken(np.random.default_rng([seed, 1])), np.random.default_rng(seed))
            try:
                result = smoother.run(r.imu, r.mag, r.fix, r.velocity)
            except ImuFusionError:
                remarked += 1
                continue
            remarked += bool(result.remarks())
            beside = np.abs(np.median(result.innovations["fix"][1], axis=0)).max()
            marks = score(result, r, ridden)
            rows.append([*marks["position"], marks["length_error"] ** 2,
                         max(fit.excess for fit in result.surface.values()), beside])
        rows = np.array(rows)
        rms = np.sqrt(rows[:, :4].mean(axis=0))
        lines.append(f"| {name} | " + "/".join(f"{v:.2f}" for v in rms[:3]) + f" | {rms[3]:.2f} | "
                     f"{np.median(rows[:, 4]):.1f}, {rows[:, 4].max():.1f} | "
                     f"{np.median(rows[:, 5]):.2f} | {remarked} of {len(SEEDS)} |")
        print(lines[-1], flush=True)
    write("smoother_surface_fit", "\n".join(lines))


if __name__ == "__main__":
    main()
