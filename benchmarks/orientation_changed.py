"""Recordings at hand, changed in ways whose truth is known: python -m benchmarks.orientation_changed

    python -m benchmarks.orientation_changed [--trials] [CHANGE ...]

Nobody has tuned anything on these: another mounting, rate or noise, a part of a recording, time
reversed, sensors off by what strangers' are off by. Peers run beside on the same samples. What
counts is a recording that is more than ``WORSE`` times the peer's error, mostly outside of 3 sigma
and without a remark. Changes that are not asked for keep their lines of the table.
"""

import sys
from dataclasses import replace
from functools import partial
from importlib.metadata import version

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from benchmarks.orientation_sets import SETS, WORSE, peers, score
from benchmarks.table import lines_of_last_run, write_table
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.samples.logs import ImuLog, MagLog

_MOST = 120.0            # s of a recording
_MANY = 0.9              # share within 3 sigma below which an error is not what was stated
_BASES = {"BROAD": ("01", "08", "11", "21", "25", "34"), "DIODEM": ("seg2", "seg4"),
          "phones, no magnets": ("BackPocket", "iPhone5_NoDist_Swinging"),
          "phones, magnets": ("Nexus5_Dist_Swinging",),
          "OpenAXES, no magnetometer": ("circle200", "triangle250")}


def bases():
    """Recordings that are changed: name of the set, Recording."""
    for name, which in _BASES.items():
        for r in SETS[name]():
            if any(part in r.name for part in which):
                yield name, part_of(r, 0.0, _MOST)


def part_of(r, start, end):
    """What lies between ``start`` and ``end`` s."""
    first, last = np.searchsorted(r.imu.stamp, r.imu.stamp[0] + np.array([start, end]) * 1e9)
    return _rows(r, slice(first, last))


def _rows(r, rows):
    stamp = r.imu.stamp[rows]
    mag = r.mag
    if mag is not None:
        mag = mag[(mag.stamp >= stamp[0]) & (mag.stamp <= stamp[-1])]
    return replace(r, imu=r.imu[rows], mag=mag, reference=r.reference[rows], mask=r.mask[rows])


def _with(r, gyr=None, acc=None, mag=None):
    imu = ImuLog(r.imu.stamp, r.imu.gyr if gyr is None else gyr, r.imu.acc if acc is None else acc)
    return replace(r, imu=imu, mag=r.mag if mag is None else MagLog(r.mag.stamp, mag))


def _duration(r):
    return (r.imu.stamp[-1] - r.imu.stamp[0]) * 1e-9


def turned(r, rng):
    """Mounted otherwise."""
    turn = Rotation.random(random_state=int(rng.integers(1 << 30)))
    r = replace(r, reference=_times(r.reference, turn.inv()))
    return _with(r, turn.apply(r.imu.gyr), turn.apply(r.imu.acc),
                 None if r.mag is None else turn.apply(r.mag.mag))


def _times(reference, turn):
    known = np.isfinite(reference).all(axis=1)
    out = np.full(reference.shape, np.nan)
    out[known] = (Rotation.from_quat(reference[known]) * turn).as_quat()
    return out


def at_rate(rate, r, rng):
    """Sampled at another rate: means over the new interval where it is longer."""
    old = (len(r.imu) - 1) / _duration(r)
    time = (r.imu.stamp - r.imu.stamp[0]) * 1e-9
    new = np.arange(0.5 / rate, time[-1] - 0.5 / rate, 1.0 / rate)
    values = np.hstack([r.imu.gyr, r.imu.acc])
    if rate < old:
        summed = np.vstack([np.zeros(6), np.cumsum(0.5 * (values[1:] + values[:-1])
                                                   * np.diff(time)[:, None], axis=0)])
        upto, since = (np.column_stack([np.interp(new + part / rate, time, s) for s in summed.T])
                       for part in (0.5, -0.5))
        values = (upto - since) * rate
    else:
        values = np.column_stack([np.interp(new, time, v) for v in values.T])
    known = np.isfinite(r.reference).all(axis=1)
    near = np.searchsorted(time, new).clip(1, len(time) - 1)
    good = known[near] & known[near - 1]
    reference = np.full((len(new), 4), np.nan)
    reference[good] = Slerp(time[known], Rotation.from_quat(r.reference[known]))(new[good]).as_quat()
    stamp = r.imu.stamp[0] + np.round(new * 1e9).astype(np.int64)
    return replace(r, imu=ImuLog(stamp, values[:, :3], values[:, 3:]), reference=reference,
                   mask=r.mask[near] & r.mask[near - 1])


def cut(begin, end, r, rng):
    """The part between two shares of a recording, or of so many s from the first one on."""
    whole = _duration(r)
    return part_of(r, begin * whole, begin * whole + end if end > 1.0 else end * whole)


def scaled(size, r, rng):
    """Gyroscope's scale off, each axis in a direction of its own."""
    return _with(r, r.imu.gyr * (1.0 + size * rng.choice([-1.0, 1.0], 3)))


def biased(size_deg, r, rng):
    return _with(r, r.imu.gyr + np.radians(size_deg) * _direction(rng))


def _direction(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def pushed(size, r, rng):
    """Accelerometer off, m/s^2."""
    return _with(r, acc=r.imu.acc + size * _direction(rng))


def noisy(r, rng):
    """Ten times a phone's noise, white."""
    root = np.sqrt((len(r.imu) - 1) / _duration(r))
    noise = rng.normal(size=(len(r.imu), 6)) * root
    mag = None if r.mag is None else r.mag.mag + 3e-6 * rng.normal(size=r.mag.mag.shape)
    return _with(r, r.imu.gyr + 3e-3 * noise[:, :3], r.imu.acc + 2e-2 * noise[:, 3:], mag)


def clipped(share, r, rng):
    """Gyroscope clipped at a share of its peak."""
    limit = share * np.abs(r.imu.gyr).max()
    return _with(r, np.clip(r.imu.gyr, -limit, limit))


def thinned(share, r, rng):
    """Imu samples lost at random."""
    kept = rng.random(len(r.imu)) >= share
    return _rows(r, np.flatnonzero(kept))


def reversed_in_time(r, rng):
    """Rates change their sign, forces and fields do not."""
    def back(stamp):
        return (r.imu.stamp[0] + r.imu.stamp[-1] - stamp)[::-1]

    mag = None if r.mag is None else MagLog(back(r.mag.stamp), r.mag.mag[::-1])
    return replace(r, imu=ImuLog(back(r.imu.stamp), -r.imu.gyr[::-1], r.imu.acc[::-1]), mag=mag,
                   reference=r.reference[::-1], mask=r.mask[::-1])


def interrupted(gap, r, rng):
    """A second half that follows the first after ``gap`` s without samples, while it turned."""
    half = _duration(r) / 2
    a, b = part_of(r, 0.0, half), part_of(r, half + gap, _duration(r))
    mag = None if r.mag is None else MagLog(np.concatenate([a.mag.stamp, b.mag.stamp]),
                                            np.concatenate([a.mag.mag, b.mag.mag]))
    return replace(r, imu=ImuLog(*(np.concatenate([getattr(x.imu, n) for x in (a, b)])
                                   for n in ("stamp", "gyr", "acc"))), mag=mag,
                   reference=np.concatenate([a.reference, b.reference]),
                   mask=np.concatenate([a.mask, b.mask]))


def no_magnetometer(r, rng):
    return replace(r, mag=None, frames=r.frames or "yaw")


def hard_iron(size, r, rng):
    """T, constant in the sensor's axes."""
    return _with(r, mag=r.mag.mag + size * _direction(rng))


def soft_iron(size, r, rng):
    matrix = rng.normal(size=(3, 3))
    return _with(r, mag=r.mag.mag @ (np.eye(3) + size * (matrix + matrix.T) / 2))


def delayed(seconds, r, rng):
    """Magnetometer stamped late."""
    return replace(r, mag=MagLog(r.mag.stamp + int(seconds * 1e9), r.mag.mag))


def seldom(rate, r, rng):
    """Magnetometer at a lower rate."""
    step = max(int(round((len(r.mag) - 1) / _duration(r) / rate)), 1)
    return replace(r, mag=r.mag[::step])


def scaled_force(size, r, rng):
    """Accelerometer's scale off, each axis in a direction of its own."""
    return _with(r, acc=r.imu.acc * (1.0 + size * rng.choice([-1.0, 1.0], 3)))


def clipped_force(limit, r, rng):
    return _with(r, acc=np.clip(r.imu.acc, -limit, limit))


def drifting(size_deg, r, rng):
    """Gyroscope's bias that grows from zero on, as in one that warms up."""
    part = np.linspace(0.0, 1.0, len(r.imu))[:, None]
    return _with(r, r.imu.gyr + np.radians(size_deg) * part * _direction(rng))


def feels_force(size_deg, r, rng):
    """Gyroscope that turns by forces, deg/s per m/s^2."""
    return _with(r, r.imu.gyr + np.radians(size_deg) * r.imu.acc @ Rotation.random(
        random_state=int(rng.integers(1 << 30))).as_matrix())


def coarse(size_deg, r, rng):
    """Gyroscope in steps, deg/s."""
    step = np.radians(size_deg)
    return _with(r, step * np.round(r.imu.gyr / step))


def misaligned(size_deg, r, rng):
    """Gyroscope turned in the case, its accelerometer not."""
    return _with(r, Rotation.from_rotvec(np.radians(size_deg) * _direction(rng)).apply(r.imu.gyr))


def late_rates(seconds, r, rng):
    """Gyroscope behind its accelerometer."""
    time = (r.imu.stamp - r.imu.stamp[0]) * 1e-9
    return _with(r, np.column_stack([np.interp(time - seconds, time, v) for v in r.imu.gyr.T]))


def jittered(seconds, r, rng):
    """Stamps of when samples arrived, in order."""
    stamp = np.sort(r.imu.stamp + (1e9 * seconds * rng.random(len(r.imu))).astype(np.int64))
    kept = np.append(True, np.diff(stamp) > 0)
    return _rows(replace(r, imu=ImuLog(stamp, r.imu.gyr, r.imu.acc)), np.flatnonzero(kept))


def turned_magnetometer(size_deg, r, rng):
    return _with(r, mag=Rotation.from_rotvec(np.radians(size_deg) * _direction(rng)).apply(r.mag.mag))


def comes_later(size, r, rng):
    """A magnet that is put into the case half-way, T."""
    part = (r.mag.stamp > r.imu.stamp[0] + 0.5e9 * _duration(r))[:, None]
    return _with(r, mag=r.mag.mag + size * part * _direction(rng))


def swings(size, r, rng):
    """A magnet that dangles from the case, T."""
    time = (r.mag.stamp - r.mag.stamp[0])[:, None] * 1e-9
    return _with(r, mag=r.mag.mag + size * np.sin(2.0 * np.pi * (0.7 * time + rng.random(3))))


def stuck(sensor, r, rng):
    """A sensor that repeats its last sample from half-way on."""
    if sensor == "mag":
        return _with(r, mag=_repeated(r.mag.mag))
    return _with(r, **{sensor: _repeated(getattr(r.imu, sensor))})


def _repeated(values):
    half = len(values) // 2
    return np.vstack([values[:half], np.tile(values[half], (len(values) - half, 1))])


def held(rate, r, rng):
    """Magnetometer at a lower rate, its last value in every message between."""
    step = max(int(round((len(r.mag) - 1) / _duration(r) / rate)), 1)
    return _with(r, mag=r.mag.mag[np.arange(len(r.mag)) // step * step])


CHANGES = {
    "as recorded": (lambda r, rng: r, False),
    "turned in its case": (turned, False),
    "50 Hz": (partial(at_rate, 50.0), False), "100 Hz": (partial(at_rate, 100.0), False),
    "400 Hz": (partial(at_rate, 400.0), False),
    "from 30 % on": (partial(cut, 0.3, 1.0), False), "from 60 % on": (partial(cut, 0.6, 1.0), False),
    "20 s from the middle": (partial(cut, 0.5, 20.0), False),
    "last 15 %": (partial(cut, 0.85, 1.0), False),
    "first 60 %": (partial(cut, 0.0, 0.6), False),
    "gyroscope's scale off by 3 %": (partial(scaled, 0.03), False),
    "gyroscope's scale off by 8 %": (partial(scaled, 0.08), False),
    "gyroscope's bias 1 deg/s": (partial(biased, 1.0), False),
    "gyroscope's bias 3 deg/s": (partial(biased, 3.0), False),
    "gyroscope's bias 3 deg/s, from 30 % on": (
        lambda r, rng: cut(0.3, 1.0, biased(3.0, r, rng), rng), False),
    "noise ten times a phone's": (noisy, False),
    "accelerometer off by 0.3 m/s^2": (partial(pushed, 0.3), False),
    "gyroscope clipped at 60 % of its peak": (partial(clipped, 0.6), False),
    "1 % of the samples lost": (partial(thinned, 0.01), False),
    "5 % of the samples lost": (partial(thinned, 0.05), False),
    "time reversed": (reversed_in_time, False),
    "0.5 s missing in the middle": (partial(interrupted, 0.5), False),
    "3 s missing in the middle": (partial(interrupted, 3.0), False),
    "magnetometer removed": (no_magnetometer, True),
    "hard iron of 10 uT": (partial(hard_iron, 10e-6), True),
    "hard iron of 20 uT": (partial(hard_iron, 20e-6), True),
    "hard iron of 60 uT": (partial(hard_iron, 60e-6), True),
    "hard iron of 60 uT, from 30 % on": (
        lambda r, rng: cut(0.3, 1.0, hard_iron(60e-6, r, rng), rng), True),
    "soft iron of 10 %": (partial(soft_iron, 0.1), True),
    "magnetometer late by 20 ms": (partial(delayed, 0.02), True),
    "magnetometer late by 50 ms": (partial(delayed, 0.05), True),
    "magnetometer at 10 Hz": (partial(seldom, 10.0), True),
    "accelerometer's scale off by 2 %": (partial(scaled_force, 0.02), False),
    "accelerometer clipped at 2 g": (partial(clipped_force, 19.6), False),
    "gyroscope's bias grows to 2 deg/s": (partial(drifting, 2.0), False),
    "gyroscope that feels forces, 0.1 deg/s per m/s^2": (partial(feels_force, 0.1), False),
    "gyroscope in steps of 1 deg/s": (partial(coarse, 1.0), False),
    "gyroscope turned by 3 deg against the accelerometer": (partial(misaligned, 3.0), False),
    "gyroscope 20 ms behind the accelerometer": (partial(late_rates, 0.02), False),
    "stamps late by up to 20 ms": (partial(jittered, 0.02), False),
    "magnetometer turned by 5 deg": (partial(turned_magnetometer, 5.0), True),
    "hard iron of 20 uT from half-way on": (partial(comes_later, 20e-6), True),
    "magnet of 10 uT that swings": (partial(swings, 10e-6), True),
    "magnetometer at 10 Hz, repeated between": (partial(held, 10.0), True),
    "magnetometer stuck from half-way on": (partial(stuck, "mag"), True),
    "gyroscope stuck from half-way on": (partial(stuck, "gyr"), False),
    "accelerometer stuck from half-way on": (partial(stuck, "acc"), False),
}
"""What is changed: a function of a Recording and a generator, and whether it needs a magnetometer."""


HEADER = ["change", "trials", "mode", "peer, deg", "ours, deg", "ours / peer", "within 3 sigma",
          "> 25 % worse", "outside of 3 sigma, silent", "both"]


def ours(r, mode):
    """Score and remarks of our estimator at the recording's rows."""
    estimator = OrientationEstimator(OrientationParams.from_mapping({"mode": mode}))
    rows = np.concatenate([estimator.run(r.imu, r.mag), estimator.finish()])
    if len(rows) != len(r.imu):
        raise ValueError(f"{r.name}: {len(rows)} rows of {len(r.imu)} samples")
    return score(r, rows["quat_world_imu"], rows["cov_attitude"]), estimator.remarks()


def tried(r):
    """One changed Recording by mode: score, the peer's, remarks."""
    other = peers(r)
    return {mode: (*ours(r, mode), other[peer])
            for mode, peer in (("causal", "VQF"), ("smoothed", "OfflineVQF"))}


def main(arguments):
    trials = "--trials" in arguments
    chosen = [a for a in arguments if not a.startswith("--")] or list(CHANGES)
    some = list(bases())
    rows = []
    for change in chosen:
        function, needs_mag = CHANGES[change]
        found = []
        for k, (_, r) in enumerate(some):
            if needs_mag and r.mag is None:
                continue
            changed = function(r, np.random.default_rng(k))
            if not (changed.mask & np.isfinite(changed.reference).all(axis=1)).any():
                continue
            found.append((r.name, tried(changed)))
            if trials:
                for mode, (mine, remarks, peer) in found[-1][1].items():
                    print(f"  {change:42s} {r.name:42s} {mode:8s} {peer.total:7.2f} {mine.total:7.2f} "
                          f"i{mine.inclination:6.2f} in{mine.within:5.2f} x{mine.tilt_ratio:4.1f},"
                          f"{mine.heading_ratio:4.1f} {'said ' if remarks else ''}"
                          f"{'WORSE' if mine.total > WORSE * peer.total else ''}"
                          f"{' SILENT' if mine.within < _MANY and not remarks else ''}", flush=True)
        for mode in ("causal", "smoothed"):
            group = [results[mode] for _, results in found]
            ratio = np.exp(np.mean([np.log(mine.total / peer.total) for mine, _, peer in group]))
            worse = [mine.total > WORSE * peer.total for mine, _, peer in group]
            silent = [mine.within < _MANY and not remarks for mine, remarks, _ in group]
            rows.append([change, str(len(group)), mode,
                         f"{np.mean([peer.total for _, _, peer in group]):.2f}",
                         f"{np.mean([mine.total for mine, _, _ in group]):.2f}", f"{ratio:.2f}",
                         f"{np.mean([mine.within for mine, _, _ in group]):.2f}", str(sum(worse)),
                         str(sum(silent)), str(sum(a and b for a, b in zip(worse, silent)))])
            print(" | ".join(rows[-1]), flush=True)
    kept = {} if chosen == list(CHANGES) else {
        tuple(row[:3:2]): row for row in lines_of_last_run("orientation_changed")}
    kept |= {tuple(row[:3:2]): row for row in rows}
    write_table("orientation_changed", HEADER, [
        kept[change, mode] for change in CHANGES for mode in ("causal", "smoothed")
        if (change, mode) in kept],
        note=f"Peers: VQF (causal) and OfflineVQF (smoothed), vqf {version('vqf')}. Total error, "
             "mean over the trials; the ratio is the geometric mean of theirs. Silent: fewer "
             f"than {_MANY} of the rows within 3 sigma and no remark.")


if __name__ == "__main__":
    main(sys.argv[1:])
