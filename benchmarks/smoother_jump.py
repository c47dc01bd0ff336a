"""Accuracy on a simulated jump, beside the paper's method: python -m benchmarks.smoother_jump"""

import numpy as np

from benchmarks.jumps import HEADER, join, monte_carlo, write
from imu_fusion.estimation.smoother import SmootherParams
from imu_fusion.simulation.ski_jump import FASTEST_WOBBLE, JumpParams, SkiJump
from imu_fusion.surfaces.file import load_surface

SEEDS = 300
PAPER_SEEDS = 30
TURNED = (0.3, -0.2, 0.5)  # rad, rotation vector


def main():
    hill = load_surface("oberstdorf_hs106")
    params = SmootherParams()
    jump = SkiJump(hill)
    wobble = jump.params.wobble
    lines = [f"A jump of {jump.length:.1f} m on Oberstdorf HS106, "
             f"{jump.params.duration:.0f} s, noise of Fang's tables 4 and 5, biases drawn from "
             f"table 3; RMS over samples and seeds, {SEEDS} of them in the first line, 100 in the "
             f"others, {PAPER_SEEDS} for the paper's method. NEES: 3 is ideal. A person wears the "
             f"sensor: on the ground it moves at random by {100 * wobble:.1f} cm (standard "
             f"deviation, below {FASTEST_WOBBLE:g} Hz, up and sideways) against the profile, which "
             "is what rows of sigma = 0.1 m allow. x, y, z are the hill's axes: forward, right, "
             "down.",
             "", HEADER]

    def row(name, jump=jump, seeds=100, surface=hill, params=params):
        scores = monte_carlo(jump, range(seeds), params, surface)
        lines.append(f"| {name} | " + " | ".join(scores.cells()) + " |")
        return scores

    ours = row(f"iterated, {SEEDS} seeds", seeds=SEEDS)
    row("iterated, first 100 seeds")
    row("iterated, sensor exactly on the profile", SkiJump(hill, JumpParams(wobble=0.0)))
    row(f"iterated, sensor moves by {200 * wobble:.1f} cm",
        SkiJump(hill, JumpParams(wobble=2.0 * wobble)))
    row("iterated, no hill", surface=None)
    row(f"iterated, first {PAPER_SEEDS} seeds", seeds=PAPER_SEEDS)
    paper = row("extended_rts (Fang 2020, in this package)", seeds=PAPER_SEEDS,
                params=params.replace(method="extended_rts"))
    lines.append("| the same, median over seeds | "
                 + " | ".join(join(paper.median_rms(name), digits) for name, digits in
                              (("position", 3), ("velocity", 4), ("attitude", 3)))
                 + " | " + join(np.median(paper.rows["nees"], axis=0), 1)
                 + f" | {np.median(np.abs(paper.rows['length_error'])):.3f} | 1 |")
    lines.append("| paper's table 6 (its own trajectory; velocity N/E/D, Euler angles) | 0.159/0.123/0.109 | "
                 "0.021/0.026/0.023 | 0.584/0.319/0.759 | - | - | 1 |")
    turned = monte_carlo(SkiJump(hill, JumpParams(mount=TURNED)), range(100), params, hill)
    square = monte_carlo(jump, range(PAPER_SEEDS),
                         params.replace(**{"gnss.loss": "squared", "mag.loss": "squared"}),
                         hill)
    lines += ["", "The paper's method starts from one magnetometer and one accelerometer sample "
              "and passes once: seeds that start tens of degrees off stay off, hence the median.",
              "", "Attitude: the heading is what these sensors know least, and in which of the "
              "phone's axes it counts depends on how the phone is worn. In the axes of a phone in "
              "an armband, x along the upper arm, the first line errs by "
              + join(ours.rms("attitude_phone"), 3) + " deg; of one turned from there by "
              f"({join(TURNED, 1)}) rad by " + join(turned.rms("attitude_phone"), 3)
              + " deg (100 seeds; about the hill's axes " + join(turned.rms("attitude"), 3)
              + "). The square roots of the mean variances stated about the hill's axes are "
              + join(ours.rms("attitude_stated"), 3) + ", with a squared loss "
              + join(square.rms("attitude_stated"), 3) + f" ({PAPER_SEEDS} seeds).",
              "", "Jump length of the first line: mean error "
              f"{ours.rows['length_error'].mean():+.3f} m, standard deviation stated "
              f"{ours.rows['length_sd'].mean():.3f} m. Standard error of its NEES over the seeds: "
              + join(ours.nees_error(), 2) + "."]
    write("smoother_jump", "\n".join(lines))


if __name__ == "__main__":
    main()
