"""What the smoother does where data are not as its model has them.

    python -m benchmarks.smoother_misfits [ROW ...]

Rows that are named are put in the place of those of before; else all are run. Each situation is
estimated as a user would, with the defaults, and judged against a truth: the error, what is stated
of it, and whether a remark says that something is wrong. Simulated ones are repeated with other
noise; the drive is real, and its truth the RTK fixes that were withheld.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from benchmarks import smoother_drive
from benchmarks.smoother_speed import FRAME, drive
from benchmarks.table import lines_of_last_run, write_table
from imu_fusion.errors import ImuFusionError
from imu_fusion.estimation.smoother import Smoother, SmootherParams
from imu_fusion.estimation.smoother.points import at_antenna
from imu_fusion.evaluation.consistency import nees
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.logs import FixLog
from imu_fusion.simulation.jump_sensors import record
from imu_fusion.simulation.noise import gauss_markov
from imu_fusion.simulation.noise_gnss import GnssErrors
from imu_fusion.simulation.ski_jump import Fall, JumpParams, SkiJump
from imu_fusion.simulation.walk import FRAME as WALKED
from imu_fusion.simulation.walk import Walk, WalkErrors
from imu_fusion.simulation.walk import record as record_walk
from imu_fusion.surfaces.file import load_surface

SEEDS, WALKS, SECONDS = 20, 5, 60.0
DEFAULTS = SmootherParams()
SIMULATED = SmootherParams(gravity=9.8)
# A receiver for the car: metres that wander over a minute, and what it states of itself.
WANDER_SD, WANDER_TAU, WHITE_SD, STATED_SD = np.array([5.0, 5.0, 8.0]), 60.0, 0.7, 1.9
# A phone's receiver: better in each fix than it says, and astray for half a minute.
PHONE = {"gnss_rate": 1.0, "stated_sd": (4.0, 4.0, 6.0), "gnss": GnssErrors(
    position_sd=(3.0, 3.0, 6.0), position_tau=30.0, correlated_share=0.97,
    velocity_sd=(0.3, 0.3, 0.3))}


@dataclass
class Row:
    """Runs of one situation: errors and variances (n, k) m, m^2, NEES per run, remarks."""

    name: str
    before: str
    errors: list[np.ndarray] = field(default_factory=list)
    variances: list[np.ndarray] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    said: list[bool] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)

    def add(self, error, cov, remarks):
        """One run: errors (n, k) with covariances (n, k, k)."""
        self.errors.append(error)
        self.variances.append(np.diagonal(cov, axis1=1, axis2=2))
        self.nees.append(float(nees(error, cov).mean()))
        self.said.append(bool(remarks))

    def cells(self):
        """Cells of the table."""
        runs = len(self.said) + len(self.refusals)
        if not self.errors:
            return [self.name, runs, "-", "-", "-", "-", f"refused: {self.refusals[0]}",
                    self.before]
        error, variance = np.concatenate(self.errors), np.concatenate(self.variances)
        within = (np.abs(error) < 3.0 * np.sqrt(variance)).mean()
        silent = sum(not said and np.sum(e ** 2) > 9.0 * np.sum(v)
                     for said, e, v in zip(self.said, self.errors, self.variances))
        return [self.name, runs, f"{np.sqrt(np.sum(error ** 2, axis=1).mean()):.2f}",
                f"{np.sqrt(np.sum(variance, axis=1).mean()):.2f}",
                f"{np.mean(self.nees):.1f} of {error.shape[1]}", f"{100 * within:.0f} %",
                f"{sum(self.said)} of {runs}" + (f", {len(self.refusals)} refused"
                                                 if self.refusals else "")
                + (f", **{silent} wrong and silent**" if silent else ""), self.before]


def eights(change: Callable, **params) -> Callable:
    """Runs of figures of eight, with logs (imu, mag, fix, velocity, rng) changed."""
    def run(row):
        for seed in range(SEEDS):
            logs = change(*drive(SECONDS, seed), np.random.default_rng([seed, 7]))
            result = Smoother(SIMULATED.replace(**params) if params else SIMULATED).run(*logs)
            t = (result.samples["stamp"] - result.samples["stamp"][0]) * 1e-9
            truth = np.stack([100 * np.sin(0.1 * t), 50 * np.sin(0.2 * t), 0 * t], axis=1)
            place = FRAME.to_enu(*result.frame.to_geodetic(result.samples["position_world"]))
            row.add(place - truth, result.samples["cov_position"], result.remarks())
    return run


def as_it_is(imu, mag, fix, velocity, rng):
    return imu, mag, fix, velocity


def late(seconds):
    def change(imu, mag, fix, velocity, rng):
        fix, velocity = (replace(log, stamp=log.stamp + round(seconds * 1e9))
                         for log in (fix, velocity))
        return imu, mag, fix, velocity
    return change


def step(metres):
    """Of the height datum, at a time of its own in each run."""
    def change(imu, mag, fix, velocity, rng):
        first = round(rng.uniform(0.2, 0.8) * len(fix))
        return imu, mag, replace(fix, height=fix.height + metres * (
            np.arange(len(fix)) >= first)), velocity
    return change


def null_at_first(imu, mag, fix, velocity, rng):
    none = np.arange(len(fix)) < 20
    return imu, mag, replace(fix, latitude_deg=np.where(none, 0.0, fix.latitude_deg),
                             longitude_deg=np.where(none, 0.0, fix.longitude_deg)), velocity


def unknown(imu, mag, fix, velocity, rng):
    """Status -2 and no covariance, which the log has as zeros."""
    return imu, mag, replace(fix, status=np.full(len(fix), -2.0),
                             cov_enu=np.zeros((len(fix), 3, 3))), velocity


def canyon(imu, mag, fix, velocity, rng):
    """For a sixth of the time fixes lie beside the path."""
    first = round(rng.uniform(0.1, 0.7) * len(fix))
    beside = (np.arange(len(fix)) >= first) & (np.arange(len(fix)) < first + len(fix) // 6)
    return imu, mag, replace(fix, longitude_deg=fix.longitude_deg + 1e-3 * beside), velocity


def shaken(imu, mag, fix, velocity, rng):
    """Noise of the Imu six times what is stated."""
    n = len(imu)
    return replace(imu, gyr=imu.gyr + 0.1 * rng.standard_normal((n, 3)),
                   acc=imu.acc + 0.6 * rng.standard_normal((n, 3))), mag, fix, velocity


def car(every: int, with_velocity: bool) -> Callable:
    """The real drive with a receiver whose fixes wander, one in ``every`` of them."""
    def run(row):
        imu, fix, velocity, _ = smoother_drive.load()
        frame = LocalFrame(fix.latitude_deg[0], fix.longitude_deg[0], fix.height[0])
        enu = frame.to_enu(fix.latitude_deg, fix.longitude_deg, fix.height)
        for seed in range(2):
            rng, n = np.random.default_rng(seed), len(fix)
            off = gauss_markov(0.25 * np.arange(n), WANDER_SD, WANDER_TAU, rng)
            off += WHITE_SD * rng.standard_normal((n, 3))
            worse = FixLog(fix.stamp, *frame.to_geodetic(enu + off),
                           np.broadcast_to(STATED_SD ** 2 * np.eye(3), (n, 3, 3)), fix.status)
            result = Smoother(DEFAULTS).run(imu, None, worse[::every],
                                            velocity[::every] if with_velocity else None)
            error, cov, _ = smoother_drive.errors(result, fix, DEFAULTS)
            row.add(error, cov, result.remarks())
    return run


def withheld(row):
    result, error, cov = smoother_drive.withheld(*smoother_drive.load(), DEFAULTS)
    row.add(error, cov, result.remarks())


def walks(outages: bool, with_velocity: bool = True,
          change: Callable = lambda fix, velocity: (fix, velocity), lever=(0.0, 0.0, 0.0),
          **errors) -> Callable:
    """Walks of 134 s with fixes and velocities changed, and an antenna said to be at ``lever``;
    error of the antenna in the middle of the recording without fixes for three times 15 s, or over
    all of it."""
    own, params = WalkErrors(**errors), DEFAULTS.replace(**{"gnss.lever_arm": lever})

    def run(row):
        for seed in range(WALKS):
            walk = Walk(134.0, np.random.default_rng([seed, 3]))
            recorded = record_walk(walk, np.random.default_rng([seed, 4]), own)
            fix, velocity = recorded.fix, recorded.velocity
            changed = change(fix, velocity)
            t = (fix.stamp - recorded.imu.stamp[0]) * 1e-9
            hold = outages & (((t - 40.0) % 30.0 < 15.0) & (t > 40.0) & (t < 115.0))
            if outages:
                changed = tuple(log[~hold] for log in changed)
            result = Smoother(params).run(recorded.imu, recorded.mag, changed[0],
                                            changed[1] if with_velocity else None)
            samples = at_antenna(result.samples, result.states, params)
            since = (samples["stamp"] - recorded.imu.stamp[0]) * 1e-9
            scored = np.searchsorted(since, t[hold] if outages else t)
            lever = np.array(own.lever_arm)
            place = result.frame.to_enu(*WALKED.to_geodetic(
                walk.antenna(since[scored], lever)[0]))
            row.add(samples["position_world"][scored] - place, samples["cov_position"][scored],
                    result.remarks())
    return run


def apart(fixes, velocities):
    """Fixes and velocities that are late by s of their own."""
    def change(*logs):
        return tuple(replace(log, stamp=log.stamp + round(late * 1e9))
                     for log, late in zip(logs, (fixes, velocities)))
    return change


def holding(fix, velocity):
    """For 20 s the receiver holds its last."""
    held = np.arange(len(fix))
    held[250:350] = 250
    return tuple(replace(log[held], stamp=log.stamp) for log in (fix, velocity))


def drifting(rate):
    """A receiver whose clock runs faster, and was right at the beginning."""
    def change(*logs):
        return tuple(replace(log, stamp=log.stamp + np.round(
            rate * (log.stamp - log.stamp[0])).astype(np.int64)) for log in logs)
    return change


def in_feet(fix, velocity):
    return replace(fix, height=fix.height / 0.3048), velocity


def twice(fix, velocity):
    """Each fix once more, 0.1 s later."""
    both = fix[np.repeat(np.arange(len(fix)), 2)]
    return replace(both, stamp=both.stamp + np.tile([0, 100_000_000], len(fix))), velocity


def jumps(kind: type[SkiJump], *landings: dict) -> Callable:
    """Lengths of 11 to 126 m; the error is that of the length."""
    def run(row):
        hill = load_surface("oberstdorf_hs106")
        for start, own in product((-30.0, -40.0, -50.0, -60.0, -70.0, -78.0, -90.0), landings):
            jump = kind(hill, JumpParams(start_x=start, duration=30.0, **own))
            for seed in range(3):
                recording = record(jump.shaken(np.random.default_rng([seed, 1])),
                                   np.random.default_rng(seed))
                try:
                    result = Smoother(DEFAULTS, hill).run(
                        recording.imu, recording.mag, recording.fix, recording.velocity)
                except ImuFusionError as error:
                    row.refusals.append(str(error))
                    continue
                row.add(np.array([[result.jump.length - jump.length]]),
                        np.array([[[result.jump.length_sd ** 2]]]), result.remarks())
    return run


SITUATIONS = (
    ("figures of eight, as the model has them", "", eights(as_it_is)),
    ("fixes and velocities 18 s late (leap seconds)", "115 m off, sd 3, nothing said",
     eights(late(18.0))),
    ("fixes and velocities 1.2 s late", "7 m off, sd .19, nothing said", eights(late(1.2))),
    ("fixes and velocities 2 s early", "", eights(late(-2.0))),
    ("height datum steps by 48 m", "31 m off, sd .24", eights(step(48.0))),
    ("height datum steps by -15 m", "", eights(step(-15.0))),
    ("height datum steps by 5 m, as much as one sd", "", eights(step(5.0))),
    ("first 20 fixes at 0 deg, 0 deg", "5,096 km off", eights(null_at_first)),
    ("fixes of status -2, without covariances", "refused", eights(unknown)),
    ("a sixth of the fixes 75 m beside the path", "misfit 1.02, nothing said", eights(canyon)),
    ("noise of the Imu six times as stated", "", eights(shaken)),
    ("jumps of 11 to 126 m, soft and hard landings: length", "11 of 80 73-144 m too long, sd 1.9",
     jumps(SkiJump, {}, {"sink_time": 0.03, "braking": 3.5})),
    ("the same, deep landings (sinking by up to 1.2 m)", "",
     jumps(SkiJump, {"sink_time": 0.12, "braking": 3.5})),
    ("the same, falls by 0.8 m", "", jumps(Fall, {}, {"sink_time": 0.12, "braking": 3.5})),
    ("walk, RTK 5 Hz: 3 x 15 s without fixes", "NEES 16-25 (another walk)", walks(True)),
    ("the same, fixes .08 s late, velocities .18 s", "",
     walks(True, gnss=WalkErrors().gnss.replace(time_offset=0.08), velocity_late=0.1)),
    ("the same, antenna 0.5 m above the sensor, not given", "",
     walks(True, lever_arm=(0.1, 0.1, 0.5))),
    ("the same, past iron that bends the field by 8 uT", "", walks(True, iron=8e-6)),
    ("walk, RTK 5 Hz, fixes 2 s early", "2.7 m off, stated .18",
     walks(False, change=apart(-2.0, 0.0))),
    ("the same, velocities 2 s late", "2.0 m off, stated .15",
     walks(False, change=apart(0.0, 2.0))),
    ("the same, fixes alone, 2 s late", "2.9 m off, stated .49",
     walks(False, False, apart(2.0, 0.0))),
    ("the same, the receiver holds its last for 20 s", "5.6 m off, stated .37",
     walks(False, change=holding)),
    ("the same, each fix twice, .1 s apart", "NEES 9.5", walks(False, change=twice)),
    ("walk, RTK 5 Hz, antenna 0.5 m above the sensor, given with the other sign", "",
     walks(False, lever=(-0.1, -0.1, -0.5), lever_arm=(0.1, 0.1, 0.5))),
    ("the same, given in front-right-down axes", "",
     walks(False, lever=(0.1, -0.1, -0.5), lever_arm=(0.1, 0.1, 0.5))),
    ("the same, x and z exchanged", "",
     walks(False, lever=(0.5, 0.1, 0.1), lever_arm=(0.1, 0.1, 0.5))),
    ("walk, RTK 5 Hz, the receiver's clock 1,000 millionths fast", "",
     walks(False, change=drifting(1e-3))),
    ("the same, 5,000 millionths slow", "", walks(False, change=drifting(-5e-3))),
    ("the same, fixes alone", "", walks(False, False, drifting(-5e-3))),
    ("walk, RTK 5 Hz, heights in feet", "", walks(False, change=in_feet)),
    ("walk, fixes of 1 m that wander over 30 s, 10 Hz", "", walks(
        False, gnss_rate=10.0, stated_sd=(1.0, 1.0, 1.5), gnss=GnssErrors(
            position_sd=(1.0, 1.0, 1.5), position_tau=30.0, velocity_sd=(0.1, 0.1, 0.2)))),
    ("walk, fixes of 3 m that wander over 100 s, 10 Hz", "", walks(
        False, gnss_rate=10.0, stated_sd=(3.0, 3.0, 4.5), gnss=GnssErrors(
            position_sd=(3.0, 3.0, 4.5), position_tau=100.0, velocity_sd=(0.1, 0.1, 0.2)))),
    ("the same, 1 Hz", "", walks(
        False, gnss_rate=1.0, stated_sd=(3.0, 3.0, 4.5), gnss=GnssErrors(
            position_sd=(3.0, 3.0, 4.5), position_tau=100.0, velocity_sd=(0.1, 0.1, 0.2)))),
    ("walk, 1 Hz, fixes of stated 4 m that wander by 3 m", "", walks(False, **PHONE)),
    ("the same, past iron that bends the field by 20 uT", "",
     walks(False, **PHONE, iron=20e-6, iron_length=2.0)),
    ("the same, no velocities", "",
     walks(False, False, **PHONE, iron=20e-6, iron_length=2.0)),
    ("real drive, defaults: 11 x 15 s without fixes", "NEES 16-25 (a walk)", withheld),
    ("real drive, wandering receiver, 4 Hz", "", car(1, True)),
    ("real drive, wandering receiver, 1 Hz", "7.7 m off, stated 1.9", car(4, True)),
    ("real drive, wandering receiver, 1 Hz, no velocities", "", car(4, False)),
)


def main(wanted: Sequence[str] = ()) -> None:
    rows = {cells[0]: cells for cells in lines_of_last_run("smoother_misfits")} if wanted else {}
    for name, before, run in SITUATIONS:
        if wanted and name not in wanted:
            continue
        row = Row(name, before)
        run(row)
        rows[name] = row.cells()
        print(" | ".join(map(str, rows[name])), flush=True)
    write_table(
        "smoother_misfits",
        ("situation", "runs", "error m, RMS", "stated m", "NEES", "within 3 sigma",
         "remarks", "before"), [rows[name] for name, _, _ in SITUATIONS if name in rows],
        "Defaults, `gravity` of the simulation. Error and stated: of the position, all three axes, "
        "over all samples (drive: at fixes). Wrong and silent: a run whose RMS error is beyond "
        f"three stated standard deviations without a remark. Wandering receiver: {WANDER_SD[0]:g} "
        f"m (up {WANDER_SD[2]:g} m) over {WANDER_TAU:g} s added to the RTK fixes, {STATED_SD:g} m "
        "stated; NEES over nine minutes of an error that changes once a minute scatters.")


if __name__ == "__main__":
    main(sys.argv[1:])
