"""Simulated jumps, smoothed and scored against their truth (used by smoother_*)."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.estimation.smoother import Smoother
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.simulation.jump_sensors import GnssErrors, PhoneErrors, record


@dataclass
class Scores:
    """One row per seed: mean squared errors position, velocity, attitude (9), NEES (3),
    iterations, mean squared attitude errors in hill axes (3), mean variances of the attitude as
    stated (3), error and standard deviation of the jump length."""

    rows: np.ndarray

    def rms(self):
        """Position m, velocity m/s, attitude deg (9,), hill axes and rotation vector."""
        return np.sqrt(self.rows[:, :9].mean(axis=0))

    def nees(self):
        """Position, velocity, attitude; ideal 3."""
        return self.rows[:, 9:12].mean(axis=0)

    def nees_error(self):
        """Standard error of :meth:`nees` over the seeds."""
        return self.rows[:, 9:12].std(axis=0) / np.sqrt(len(self.rows))

    def hill_attitude(self):
        """RMS of the attitude error about the hill's axes (3,), deg: whatever the mount."""
        return np.sqrt(self.rows[:, 13:16].mean(axis=0))

    def stated_attitude(self):
        """RMS (3,) of the attitude error as the covariance states it, deg, rotation vector."""
        return np.sqrt(self.rows[:, 16:19].mean(axis=0))

    def length_errors(self):
        """Errors (n,) of the jump length and stated standard deviations (n,), m."""
        return self.rows[:, 19], self.rows[:, 20]

    def cells(self):
        """Cells of a table row."""
        r, n = self.rms(), self.nees()
        length = np.sqrt(np.mean(self.length_errors()[0] ** 2))
        return [f"{r[0]:.3f}/{r[1]:.3f}/{r[2]:.3f}", f"{r[3]:.4f}/{r[4]:.4f}/{r[5]:.4f}",
                f"{r[6]:.2f}/{r[7]:.2f}/{r[8]:.2f}", f"{n[0]:.2f}/{n[1]:.2f}/{n[2]:.2f}",
                "-" if np.isnan(length) else f"{length:.3f}",
                f"{self.rows[:, 12].mean():.1f} (max {self.rows[:, 12].max():.0f})"]


def moved(hill, north=0.0, up=0.0):
    """The hill elsewhere, m: what the smoother is given when the origin is off."""
    o = hill.origin
    return dataclasses.replace(hill, origin=LocalFrame(
        o.latitude_deg + np.degrees(north / 6.37e6), o.longitude_deg, o.height + up))


HEADER = ("| | position x/y/z m | velocity m/s | rotation vector deg | NEES p/v/a | "
          "length m | iterations |\n|---|---|---|---|---|---|---|")


def score(result, recording, hill):
    """One row of :class:`Scores`, over the samples that both hold."""
    samples = result.samples
    index = np.searchsorted(recording.imu.stamp, samples["stamp"])
    motion = recording.motion
    place = hill.origin.to_enu(*result.frame.to_geodetic(samples["position_world"]))
    found, true = (Rotation.from_quat(q) for q in (samples["quat_world_imu"],
                                                   motion.quat_world_imu[index]))
    errors = [place - motion.position_world[index], samples["vel_world"] - motion.vel_world[index],
              (found.inv() * true).as_rotvec()]
    covs = [samples[c] for c in ("cov_position", "cov_velocity", "cov_attitude")]
    nees = [np.mean(np.einsum("ni,ni->n", e, np.linalg.solve(c, e[..., None])[..., 0]))
            for e, c in zip(errors, covs)]
    errors = [hill.to_hill(errors[0]), hill.to_hill(errors[1]), np.degrees(errors[2])]
    turned = hill.to_hill(found.apply(errors[2]))
    stated = np.degrees(1.0) ** 2 * np.einsum("nii->i", covs[2]) / len(samples)
    return np.concatenate([*(np.mean(e ** 2, axis=0) for e in errors), nees,
                           [result.iterations], np.mean(turned ** 2, axis=0), stated])


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
        length = np.full(2, np.nan)
        if result.jump is not None:
            length[:] = result.jump.length - jump.length, result.jump.length_sd
        rows.append(np.concatenate([score(result, recording, jump.hill), length]))
    return Scores(np.array(rows))


def write(name, text):
    """Print a table and keep it in benchmarks/results."""
    from pathlib import Path
    print(text)
    path = Path(__file__).parent / "results" / f"{name}.md"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text + "\n")
