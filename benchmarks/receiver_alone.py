"""A 10 Hz receiver in an avalanche without any Imu, simulated: python -m benchmarks.receiver_alone [SEEDS]"""

import sys

import numpy as np

from benchmarks.table import write_table
from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.evaluation.consistency import nees
from imu_fusion.simulation.avalanche import Avalanche
from imu_fusion.simulation.ball_sensors import AVANODE, EPOCH, record_ball

SEEDS = 12
# What the receiver does while it lies still, as its user would state it.
STATED = {"gnss.position_error_sd": AVANODE.position_sd, "gnss.position_error_tau": 15.0,
          "gnss.velocity_error_sd": AVANODE.velocity_sd, "gnss.velocity_error_tau": 0.8,
          "gnss.fix_sd": (0.4, 0.4, 1.0), "gnss.velocity_sd": (0.02, 0.02, 0.03),
          "gnss.covariances": False}
SEEN = {"always": (), "but for 2.2, 8 and 10 s": ((0.3, 2.5), (4.0, 12.0), (30.0, 40.0))}


def score(avalanche, log, params):
    """RMS (2), stated (2) and NEES (2) of position, m, and velocity, m/s."""
    result = Smoother(SmootherParams().replace(**params)).run(None, None, log.fix, log.velocity)
    s, motion = result.samples, avalanche.motion
    rows = np.searchsorted(motion.time, (s["stamp"] - EPOCH) * 1e-9 - 1e-6)
    origin = avalanche.origin.to_enu(*result.frame.to_geodetic(np.zeros(3)))
    errors = (s["position_world"] + origin - motion.position[rows], s["vel_world"] - motion.vel[rows])
    covs = s["cov_position"], s["cov_velocity"]
    return [*(np.sqrt(np.mean(np.sum(e ** 2, axis=1))) for e in errors),
            *(np.sqrt(np.trace(c, axis1=1, axis2=2).mean()) for c in covs),
            *(nees(e, c).mean() for e, c in zip(errors, covs))]


def main(count=SEEDS):
    rows = []
    for seen, outages in SEEN.items():
        found = {"defaults": [], "what it does at rest": []}
        for seed in range(count):
            avalanche = Avalanche(rng=np.random.default_rng([seed, 0]))
            log = record_ball(avalanche, np.random.default_rng([seed, 1]), gnss=AVANODE,
                              gnss_rate=10.0, outages=outages)
            for scores, params in zip(found.values(), ({}, STATED)):
                scores.append(score(avalanche, log, params))
        for name, scores in found.items():
            s = np.array(scores)
            rms, middle = np.sqrt(np.mean(s[:, :4] ** 2, axis=0)), np.median(s[:, 4:], axis=0)
            rows.append((seen, name, *(
                f"{rms[k]:.2f} ({rms[k + 2]:.2f}); {s[:, 4 + k].mean():.1f} ({middle[k]:.1f})"
                for k in range(2))))
    write_table("receiver_alone", ("fixes", "parameters",
                                   "position, m (stated); NEES (median)",
                                   "velocity, m/s (stated); NEES (median)"), rows,
                f"Fixes and velocities of simulated balls (92 s, {count} seeds), no Imu, no terrain. RMS, three-dimensional; "
                "NEES: 3 is ideal.")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
