"""Simulated jumps, smoothed and scored against their truth (used by smoother_*)."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.smoother import Smoother
from imu_fusion.evaluation.consistency import nees
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.simulation.jump_sensors import GnssErrors, PhoneErrors, record

_ROW = np.dtype([("position", "f8", 3), ("velocity", "f8", 3), ("attitude", "f8", 3),
                 ("attitude_phone", "f8", 3), ("attitude_stated", "f8", 3), ("nees", "f8", 3),
                 ("iterations", "f8"), ("length_error", "f8"), ("length_sd", "f8")])


@dataclass
class Scores:
    """One row (``_ROW``) per seed. Means over its samples: squared errors of position (m),
    velocity (m/s) and attitude (rotation vector, deg) along and about the hill's axes, of the
    attitude about the phone's axes, variances of the attitude about the hill's axes as stated;
    NEES of position, velocity, attitude (ideal 3). Length of the jump: m."""

    rows: np.ndarray

    def rms(self, name):
        """Root mean square (3,) over samples and seeds."""
        return np.sqrt(self.rows[name].mean(axis=0))

    def median_rms(self, name):
        """Median over the seeds of their mean squares, as a root (3,)."""
        return np.sqrt(np.median(self.rows[name], axis=0))

    def nees_error(self):
        """Standard error (3,) of the mean NEES over the seeds."""
        return self.rows["nees"].std(axis=0) / np.sqrt(len(self.rows))

    def cells(self):
        """Cells of a table row."""
        length = np.sqrt(np.mean(self.rows["length_error"] ** 2))
        iterations = self.rows["iterations"]
        return [join(self.rms("position"), 3), join(self.rms("velocity"), 4),
                join(self.rms("attitude"), 3), join(self.rows["nees"].mean(axis=0), 2),
                "-" if np.isnan(length) else f"{length:.3f}",
                f"{iterations.mean():.1f} (max {iterations.max():.0f})"]


def join(values, digits):
    """x/y/z."""
    return "/".join(f"{v:.{digits}f}" for v in values)


def moved(hill, north=0.0, up=0.0):
    """The hill elsewhere, m: what the smoother is given when the origin is off."""
    o = hill.origin
    return dataclasses.replace(hill, origin=LocalFrame(
        o.latitude_deg + np.degrees(north / 6.37e6), o.longitude_deg, o.height + up))


HEADER = ("| | position x/y/z m | velocity x/y/z m/s | rotation vector x/y/z deg | NEES p/v/a | "
          "length m | iterations |\n|---|---|---|---|---|---|---|")


def score(result, recording, jump):
    """One row of :class:`Scores`, over the samples that both hold."""
    hill, samples = jump.hill, result.samples
    index = np.searchsorted(recording.imu.stamp, samples["stamp"])
    motion = recording.motion
    place = hill.origin.to_enu(*result.frame.to_geodetic(samples["position_world"]))
    found, true = (Rotation.from_quat(q) for q in (samples["quat_world_imu"],
                                                   motion.quat_world_imu[index]))
    errors = [place - motion.position_world[index], samples["vel_world"] - motion.vel_world[index],
              (found.inv() * true).as_rotvec()]
    covs = [samples[c] for c in ("cov_position", "cov_velocity", "cov_attitude")]
    hill_imu = hill.axes @ found.as_matrix()
    degree = np.degrees(1.0)
    row = np.zeros((), _ROW)
    row["nees"] = [nees(e, c).mean() for e, c in zip(errors, covs)]
    for name, error in (("position", hill.to_hill(errors[0])),
                        ("velocity", hill.to_hill(errors[1])),
                        ("attitude", degree * hill.to_hill(found.apply(errors[2]))),
                        ("attitude_phone", degree * errors[2])):
        row[name] = np.mean(error ** 2, axis=0)
    row["attitude_stated"] = degree ** 2 * np.einsum("nij,njk,nik->i", hill_imu, covs[2],
                                                     hill_imu) / len(samples)
    row["iterations"] = result.iterations
    row["length_error"] = row["length_sd"] = np.nan
    if result.jump is not None:
        row["length_error"] = result.jump.length - jump.length
        row["length_sd"] = result.jump.length_sd
    return row


def monte_carlo(jump, seeds, params, surface, phone=PhoneErrors(), gnss=GnssErrors(),
                events=None, initial=None, change=None, **options):
    """Scores of many recordings of one jump.

    Args:
        jump: SkiJump. seeds: iterable of int. params: SmootherParams. surface: or None.
        events: given JumpEvents, or None. initial: recording -> first attitude, or None.
        change: recording -> recording, applied before smoothing.
        options: passed to ``record``.
    """
    rows = []
    smoother = Smoother(params, surface)
    for seed in seeds:
        shaken = jump.shaken(np.random.default_rng([seed, 1]))
        recording = record(shaken, np.random.default_rng(seed), phone, gnss, **options)
        if change is not None:
            recording = change(recording)
        result = smoother.run(recording.imu, recording.mag, recording.fix, recording.velocity,
                              events=events,
                              initial_quat=None if initial is None else initial(recording))
        rows.append(score(result, recording, jump))
    return Scores(np.array(rows))


def write(name, text):
    """Print a table and keep it in benchmarks/results."""
    from pathlib import Path
    print(text)
    path = Path(__file__).parent / "results" / f"{name}.md"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text + "\n")
