"""Orientation on simulated motions that no set at hand has: python -m benchmarks.orientation_simulated

    python -m benchmarks.orientation_simulated [--trials] [CASE ...]

What is decided by physics or simulation, and not on the recordings of ``orientation_sets``, is
decided here: which hypotheses there are, their prior odds, and what widens the covariance. Sensors
are a phone's, but for what a case says; the truth is exact. Of cases that are named only their lines
in the table are written anew.
"""

import math
import sys
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.orientation_sets import HEADER, Recording, peers, score_ours, summary, trial_line
from benchmarks.table import lines_of_last_run, write_table
from imu_fusion.samples.logs import MagLog
from imu_fusion.simulation.going_round import Circles, Swing, Walk, waves
from imu_fusion.simulation.rotation import Motion, Sensors, Tumbling, earth_field, simulate

SEEDS = range(4)
_RATE, _REST, _CUT = 100.0, 3.0, 10.0   # Hz; s of rest; s cut off where the start is in motion
_NORM = 48e-6                           # T
_TURNED_OFF = {"fusion.lasting_acc_sd": 0.0}


@dataclass(frozen=True)
class Case:
    """A kind of recordings: a motion for each seed, and what is off.

    place: standard deviation per axis of the field of places, 1 m apart, relative to its norm;
    current: the same of a magnet that comes and goes with a current, in imu axes, iron: of one that
    stays there; bias: of the gyroscope, rad/s, scale: of each of its axes, limit: rad/s, at which
    it clips; acc_bias: m/s^2; cut: start in motion.
    """

    motion: object
    magnetometer: bool = True
    place: float = 0.0
    current: float = 0.0
    iron: float = 0.01
    bias: float = 0.01
    scale: float = 0.0
    limit: float = math.inf
    acc_bias: float = 0.03
    cut: bool = False
    duration: float = 63.0


def _tumbling(seed):
    return Tumbling(seed=seed, rate_sd=1.5, rest=_REST)


def _stick(seed):
    return Tumbling(seed=seed, rate_sd=4.0, rest=_REST)


def _arm(seed):
    return Tumbling(seed=seed, rate_sd=0.4, frequencies=(0.03, 0.3), travel_sd=0.3, rest=_REST)


def _circles(leans, seed):
    rng = np.random.default_rng(seed)
    rate = rng.uniform(0.4, 1.2)
    return Circles(seed, min(rng.uniform(1.5, 5.0), 3.5 / rate ** 2),
                   rate * rng.choice([-1.0, 1.0]), leans)


_scooter, _cart = partial(_circles, True), partial(_circles, False)

CASES = {
    "hand": Case(_tumbling),
    "hand, no magnetometer": Case(_tumbling, magnetometer=False),
    "hand, start in motion": Case(_tumbling, cut=True),
    "hand in a building": Case(_tumbling, place=0.1),
    "hand in a building, start in motion": Case(_tumbling, place=0.1, cut=True),
    "walker's laps in a building": Case(Walk, place=0.1),
    "walker's laps in a building, start in motion": Case(Walk, place=0.1, cut=True),
    "walker's laps, start in motion, no magnetometer": Case(Walk, magnetometer=False, cut=True),
    "leaning circles, no magnetometer": Case(_scooter, magnetometer=False, duration=90.0),
    "leaning circles": Case(_scooter, duration=90.0),
    "level circles, no magnetometer": Case(_cart, magnetometer=False, duration=90.0),
    "level circles, start in motion, no magnetometer": Case(_cart, magnetometer=False, cut=True,
                                                            duration=90.0),
    "leaning circles, start in motion, no magnetometer": Case(_scooter, magnetometer=False, cut=True,
                                                              duration=90.0),
    "robot arm, no magnetometer": Case(_arm, magnetometer=False),
    "robot arm, start in motion, no magnetometer": Case(_arm, magnetometer=False, cut=True),
    "stick, clipped at 8 rad/s": Case(_stick, limit=8.0),
    "stick, clipped at 8 rad/s, start in motion": Case(_stick, limit=8.0, cut=True),
    "magnet in the case, 15 %": Case(_tumbling, iron=0.15),
    "magnet in the case, 15 %, start in motion": Case(_tumbling, iron=0.15, cut=True),
    "swing, iron of 3 %, as is stated": Case(Swing, iron=0.03, duration=93.0),
    "swing, iron of 6 %": Case(Swing, iron=0.06, duration=93.0),
    "swing, iron of 6 %, start in motion": Case(Swing, iron=0.06, cut=True, duration=93.0),
    "magnet that comes with a current": Case(_tumbling, current=0.15),
    "gyroscope's scale off by 4 to 8 %, no magnetometer": Case(_tumbling, magnetometer=False,
                                                               scale=0.06),
    "gyroscope's scale off by 4 to 8 %, start in motion, no magnetometer": Case(
        _tumbling, magnetometer=False, scale=0.06, cut=True),
    "bias of 3 deg/s per axis, start in motion": Case(_tumbling, bias=0.05, cut=True),
    "accelerometer off by 0.2 m/s^2 per axis, no magnetometer": Case(_tumbling, magnetometer=False,
                                                                     acc_bias=0.2),
}


def _building(seed):
    """Field of places (n, 3) at positions (n, 3) m, relative to ``Case.place``."""
    rng = np.random.default_rng(seed)
    k, phase = rng.normal(0, 1.0, (24, 3)), rng.uniform(0, 2 * math.pi, (24, 3))
    size = rng.normal(0, math.sqrt(2 / 24), (24, 3))
    return lambda place: (size * np.sin((place @ k.T)[:, :, None] + phase)).sum(axis=1)


def record(name, case, seed):
    """Recording of a case."""
    rng = np.random.default_rng(1000 + seed)
    matrix = np.eye(3) + rng.normal(0, 0.005, (3, 3)) + np.diag(
        case.scale * rng.uniform(0.7, 1.3, 3) * rng.choice([-1.0, 1.0], 3))
    sensors = Sensors(
        gyr_density=3e-4, acc_density=2e-3, mag_sd=4e-7, gyr_walk=2e-5, gyr_matrix=matrix,
        gyr_bias=tuple(rng.normal(0, case.bias, 3)), gyr_limit=case.limit,
        acc_bias=tuple(rng.normal(0, case.acc_bias, 3)),
        mag_offset=tuple(rng.normal(0, case.iron * _NORM, 3)))
    motion: Motion = case.motion(seed)
    imu, mag, truth, _ = simulate(motion, case.duration, rate=_RATE, sensors=sensors, seed=seed,
                                  field_world=earth_field(_NORM, math.radians(65)))
    time = mag.stamp * 1e-9
    quat, _, place, _ = motion.truth(time)
    added = (case.place * Rotation.from_quat(quat).inv().apply(_building(seed)(place))
             + case.current * np.tanh(5.0 * waves(seed, 0.02, 0.2)(time)) * (time > _REST)[:, None])
    mag = MagLog(mag.stamp, mag.mag + _NORM * added)
    first = int((_CUT if case.cut else 0.0) * _RATE)
    counts = imu.stamp[first:] > (0.0 if case.cut else _REST * 1e9)
    return Recording(f"{name} {seed}", imu[first:], mag[first:] if case.magnetometer else None,
                     np.asarray(truth.quat_world_imu)[first:], counts,
                     "" if case.magnetometer else "yaw")


def main(arguments):
    trials = "--trials" in arguments
    chosen = [a for a in arguments if not a.startswith("--")] or list(CASES)
    rows = []
    for name in chosen:
        scores, without = [], []
        for seed in SEEDS:
            r = record(name, CASES[name], seed)
            scores.append(peers(r) | score_ours(r))
            without.append(scores[-1] | score_ours(r, _TURNED_OFF))
            if trials:
                print(trial_line(r.name, scores[-1]), flush=True)
        for row, other in zip(summary(name, scores), summary(name, without)):
            rows.append([*row, f"{other[4]} ({other[6]})"])
            print(" | ".join(rows[-1]), flush=True)
    kept = {} if chosen == list(CASES) else {
        tuple(row[:3:2]): row for row in lines_of_last_run("orientation_simulated")}
    kept |= {tuple(row[:3:2]): row for row in rows}
    write_table("orientation_simulated", [*HEADER, "ours without lasting accelerations"],
                [kept[name, mode] for name in CASES for mode in ("causal", "smoothed")
                 if (name, mode) in kept],
                note=f"Peers and columns as in orientation_sets, vqf {version('vqf')}; "
                     f"{len(SEEDS)} seeds each. In brackets: share within 3 sigma.")


if __name__ == "__main__":
    main(sys.argv[1:])
