"""Orientation on every set at hand beside VQF and OfflineVQF, in one run.

    python -m benchmarks.orientation_sets [--quick] [--trials] [SET ...]

``--quick`` takes two recordings of each set and writes nothing, ``--trials`` prints every
recording; of sets that are named only their lines in the tables are written anew. Parameters are
the defaults everywhere, also the peers'.

**Time.** An estimate at stamp t is the attitude at t, and a rate is the rate at its stamp:
between stamps it changes linearly. VQF applies the rate of a stamp to the whole step that ends
there, so that its estimates are those of half a step later; they are moved back by that, along the
rotation between two of them.

**References** that jump (markers mixed up) do not count near the jump.

**Frames.** Where a reference has frames of its own, one turn of its world and one of its body are
fitted per recording and estimator, over all rows (``fit_frames``). A constant error of heading is
then not in the error, but what is stated allows for it: that ratio stands in brackets.
"""

import sys
from dataclasses import dataclass, replace
from importlib.metadata import version

import numpy as np
from scipy.spatial.transform import Rotation
from vqf import VQF, offlineVQF

from benchmarks.data import broad_trials, data_path, load_broad
from benchmarks.table import lines_of_last_run, write_table
from imu_fusion.estimation.orientation.estimator import OrientationEstimator, OrientationParams
from imu_fusion.evaluation.orientation_error import split_angles
from imu_fusion.recordings.bag_reader import open_bag
from imu_fusion.recordings.logs import read_log
from imu_fusion.samples.logs import ImuLog, MagLog

# chi2 with 3 degrees of freedom, the probability of 3 sigma of a normal variate.
_THREE_SIGMA = 14.156
WORSE = 1.25
_FEW = 0.9               # share within 3 sigma below which a recording is named
_CUT = 1500              # samples after motion begins
_JUMP = 0.25             # s, about a jump of a reference within which it does not count
_TURN_ROWS = 20          # over which turns show how a body is mounted
_FIT_ROUNDS = 100
_STILL_RATE, _STILL_FORCE = 0.05, 0.2   # rad/s, m/s^2: largest standard deviations at rest
_STILL_SIZE = 0.03       # of the force's norm, by which it may differ from the usual one at rest
_GRAVITY = 9.807         # m/s^2
_FORCE_BIAS_SD = 0.1     # m/s^2, of an accelerometer before its sizes are looked at
_SIZE_SD = 0.02          # m/s^2, of a rest, that a bias leaves
_FAST = ("06", "08", "21", "28")


@dataclass(frozen=True, eq=False)
class Recording:
    """Samples and reference, (n, 4) xyzw, nan where unknown; mask (n,) of the rows that count.

    frames: what is fitted before an error is taken: "" nothing, "yaw" the reference's heading,
    "level" that and its body, "full" its world and its body; "tilt": each row's heading, as the
    reference is gravity alone.
    """

    name: str
    imu: ImuLog
    mag: MagLog | None
    reference: np.ndarray
    mask: np.ndarray
    frames: str = ""


@dataclass(frozen=True)
class Score:
    """RMSE in degrees; where a covariance is stated: share of rows within 3 sigma, and stated over
    actual standard deviation of inclination and heading; what most of the error is."""

    total: float
    inclination: float
    heading: float
    within: float = np.nan
    tilt_ratio: float = np.nan
    heading_ratio: float = np.nan
    cause: str = ""


def _broad():
    for path in broad_trials():
        yield Recording(f"broad {path.name[:2]}", *load_broad(path))


def _in_motion():
    for r in _broad():
        first = int(np.argmax(r.mask)) + _CUT
        yield replace(r, name=r.name + " cut", imu=r.imu[first:], mag=r.mag[first:],
                      reference=r.reference[first:], mask=r.mask[first:])


def _clipped():
    """Fast trials clipped at 500 deg/s behind a calibration: flat tops that are not equal."""
    for k, r in enumerate(r for r in _broad() if r.name[-2:] in _FAST):
        rng = np.random.default_rng(k)
        matrix = np.eye(3) + rng.normal(0, 0.003, (3, 3))
        limit = np.radians(500)
        raw = np.clip(r.imu.gyr @ np.linalg.inv(matrix).T, -limit, limit)
        gyr = raw @ matrix.T + rng.normal(0, 2e-3, raw.shape)
        yield replace(r, name=r.name + " clipped", imu=ImuLog(r.imu.stamp, gyr, r.imu.acc))


def _poor_gyroscope():
    """Moderate trials without magnetometer, the scale of each axis off by 4 to 8 %."""
    for k, r in enumerate(r for r in _broad() if r.name[-2:] not in _FAST + ("01",)):
        rng = np.random.default_rng(k)
        gyr = r.imu.gyr * (1.0 + rng.uniform(0.04, 0.08, 3) * rng.choice([-1.0, 1.0], 3))
        yield replace(r, name=r.name + " poor", imu=ImuLog(r.imu.stamp, gyr, r.imu.acc), mag=None,
                      frames="yaw")


def _npz(folder, pattern="*.npz"):
    """Files of benchmarks/data: rows gyr, acc, quat, mov, and a magnetometer in step or not."""
    for path in sorted(data_path(folder).glob(pattern)):
        d = np.load(path)
        t = d["t"] if "t" in d else np.arange(len(d["gyr"])) / float(d["fs"])
        stamp = np.round(t * 1e9).astype(np.int64)
        mag = None
        if "mag" in d:
            mag = MagLog(stamp, d["mag"] * 1e-6)
        elif "mag_n" in d:
            mag = MagLog(np.round(d["mag_t"] * 1e9).astype(np.int64), d["mag_n"] * 1e-6)
        quat = d["quat"].astype(float)[:, [1, 2, 3, 0]]
        imu = ImuLog(stamp, d["gyr"], d["acc"])
        frames = "yaw" if d["align"] == "yaw" else "level" if d["vertical"] else "full"
        mask = d["mov"].astype(bool) & ~_near_jumps(imu, quat)
        yield Recording(f"{folder} {path.stem}", imu, mag, quat, mask, frames)


def _near_jumps(imu, reference):
    """Mask (n,) of rows near a step over which the reference turns more than twice as fast as the
    gyroscope ever does: markers that were mixed up."""
    known = np.flatnonzero(np.isfinite(reference).all(axis=1))
    turn = Rotation.from_quat(reference[known])
    stamp = imu.stamp[known]
    rate = (turn[:-1].inv() * turn[1:]).magnitude() / (np.diff(stamp) * 1e-9)
    jumps = stamp[:-1][rate > 2.0 * np.linalg.norm(imu.gyr, axis=1).max()]
    near = np.zeros(len(imu), dtype=bool)
    for jump in jumps:
        near |= np.abs(imu.stamp - jump) < _JUMP * 1e9
    return near


def _still(folder, corrected=False):
    """Recordings without a reference: where they lie still, the force shows the vertical, less the
    accelerometer's bias if corrected."""
    for path in sorted(data_path(folder).glob("*")):
        imu, mag = _read(path)
        reference, mask = _vertical(imu, corrected)
        name = f"{folder} {path.stem}" + " less its bias" * corrected
        yield Recording(name, imu, mag, reference, mask, "tilt")


def _read(path):
    """ImuLog and MagLog of a ROS 1 bag or of x-io's table (deg/s, g, uT)."""
    if path.suffix == ".bag":
        with open_bag(path) as bag:
            mag = read_log(bag, "/imu/mag")
            return (read_log(bag, "/imu/data_raw"), mag[np.isfinite(mag.mag).all(axis=1)])
    d = np.loadtxt(path, delimiter=",", skiprows=1)
    stamp = np.round(d[:, 0] * 1e9).astype(np.int64)
    return (ImuLog(stamp, np.radians(d[:, 1:4]), 9.80665 * d[:, 4:7]),
            MagLog(stamp, d[:, 7:10] * 1e-6))


def _vertical(imu, corrected):
    """(n, 4) attitudes, of any heading, whose z is along the force, and mask (n,) of the rows within
    a second in which rate and force stay the same and the force has the size that it has on average
    when they do. corrected: less the bias that the sizes of the forces show."""
    half = int(0.5 * len(imu) / ((imu.stamp[-1] - imu.stamp[0]) * 1e-9))
    around = np.lib.stride_tricks.sliding_window_view(np.hstack([imu.gyr, imu.acc]), 2 * half + 1,
                                                      axis=0)
    sd, mean = around.std(axis=2), around.mean(axis=2)
    still = np.zeros(len(imu), dtype=bool)
    still[half:-half] = (sd[:, :3].max(axis=1) < _STILL_RATE) & (sd[:, 3:].max(axis=1) < _STILL_FORCE)
    size = np.linalg.norm(mean[:, 3:], axis=1)
    usual = np.median(size[still[half:-half]])
    still[half:-half] &= np.abs(size / usual - 1.0) < _STILL_SIZE
    reference = np.full((len(imu), 4), np.nan)
    up = mean[still[half:-half], 3:]
    if corrected:
        rests = np.split(up, np.flatnonzero(np.diff(np.flatnonzero(still)) > 1) + 1)
        up = up - _force_bias(np.array([rest.mean(axis=0) for rest in rests]))
    cross = np.cross(up, [0.0, 0.0, 1.0])
    angle = np.arctan2(np.linalg.norm(cross, axis=1), up[:, 2])
    axis = cross / np.maximum(np.linalg.norm(cross, axis=1), 1e-9)[:, None]
    axis[np.linalg.norm(cross, axis=1) < 1e-9] = [1.0, 0.0, 0.0]
    reference[still] = Rotation.from_rotvec(angle[:, None] * axis).as_quat()
    return reference, still


def _force_bias(force):
    """Bias (3,) of an accelerometer whose mean forces (n, 3) of rests should all have gravity's size: no
    estimate of an attitude is in it. Zero along axes that never point up or down."""
    size = np.linalg.norm(force, axis=1)
    shown = force / size[:, None]
    prior = (_SIZE_SD / _FORCE_BIAS_SD) ** 2 * np.eye(3)
    return np.linalg.solve(shown.T @ shown + prior, shown.T @ (size - _GRAVITY))


SETS = {
    "BROAD": _broad,
    "BROAD, start in motion": _in_motion,
    "BROAD, clipped behind a calibration": _clipped,
    "BROAD, poor gyroscope, no magnetometer": _poor_gyroscope,
    "DIODEM": lambda: _npz("diodem"),
    "phones, no magnets": lambda: _npz("phone", "*_NoDist_*.npz"),
    "phones, magnets": lambda: _npz("phone", "*_Dist_*.npz"),
    "OpenAXES, no magnetometer": lambda: _npz("openaxes"),
    "ros1, force at rest": lambda: _still("ros1"),
    "x-io, force at rest": lambda: _still("xio"),
    "x-io, force at rest less its bias": lambda: _still("xio", corrected=True),
}
"""Name of the set to a function of its Recordings; nothing where the data is not at hand."""


def _nearest(m):
    """Rotation matrix next to a sum of them, (3, 3)."""
    u, _, v = np.linalg.svd(m)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v


def _nearest_yaw(m):
    """Turn about z next to a sum of rotation matrices, (3, 3)."""
    return Rotation.from_euler("z", np.arctan2(m[1, 0] - m[0, 1], m[0, 0] + m[1, 1])).as_matrix()


def _body_start(est, ref, step):
    """Body of the reference in the estimate's axes from turns over ``step`` rows (Wahba)."""
    turned = [Rotation.from_matrix(m[:-step].transpose(0, 2, 1) @ m[step:]).as_rotvec()
              for m in (ref, est)]
    return _nearest(turned[0].T @ turned[1])


def fit_frames(estimate, r):
    """r.reference (n, 4) in the frames of the estimate (n, 4), nan where unknown."""
    if not r.frames:
        return r.reference
    known = np.isfinite(r.reference).all(axis=1)
    est = Rotation.from_quat(estimate[known]).as_matrix()
    ref = Rotation.from_quat(r.reference[known]).as_matrix()
    out = np.full(r.reference.shape, np.nan)
    if r.frames == "tilt":
        own = est @ ref.transpose(0, 2, 1)
        yaw = np.arctan2(own[:, 1, 0] - own[:, 0, 1], own[:, 0, 0] + own[:, 1, 1])
        out[known] = (Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0]) * Rotation.from_matrix(ref)).as_quat()
        return out
    nearest = _nearest if r.frames == "full" else _nearest_yaw
    products = np.einsum("nai,nbk->aibk", est, ref)
    body = np.eye(3) if r.frames == "yaw" else _body_start(est, ref, _TURN_ROWS)
    for _ in range(_FIT_ROUNDS):
        world = nearest(np.einsum("aibk,ki->ab", products, body))
        if r.frames != "yaw":
            body = _nearest(np.einsum("aibk,ab->ki", products, world))
    out[known] = Rotation.from_matrix(world @ ref @ body).as_quat()
    return out


def score(r, quat, cov=None):
    """Score of estimates (n, 4) at the recording's rows; cov (n, 3, 3) of the local error."""
    reference = fit_frames(quat, r)
    keep = r.mask & np.isfinite(reference).all(axis=1)
    estimate = Rotation.from_quat(quat[keep])
    error = estimate * Rotation.from_quat(reference[keep]).inv()
    angles = np.degrees(split_angles(error.as_quat()))
    total, heading, inclination = np.sqrt((angles ** 2).mean(axis=1))
    if cov is None:
        return Score(total, inclination, heading)
    turn = estimate.as_matrix()
    world = turn @ cov[keep] @ turn.transpose(0, 2, 1)
    vector = _tilt_and_heading(error)
    cause = _cause(vector, (r.imu.stamp[keep] - r.imu.stamp[0]) * 1e-9)
    distance = (vector * np.linalg.solve(world, vector[..., None])[..., 0]).sum(axis=1)
    tilt = np.degrees(np.sqrt((world[:, 0, 0] + world[:, 1, 1]).mean()))
    yaw = np.degrees(np.sqrt(world[:, 2, 2].mean()))
    return Score(total, inclination, heading, float((distance < _THREE_SIGMA).mean()),
                 tilt / inclination,
                 np.nan if r.mag is None or r.frames == "tilt" else yaw / heading,
                 cause)


def _tilt_and_heading(error):
    """Errors (n,) Rotation in world axes as (n, 3) rad: of the vertical, and the turn about it,
    which may be any where there is no heading."""
    quat = error.as_quat()
    heading = Rotation.from_quat(quat * [0.0, 0.0, 1.0, 1.0])
    vector = (error * heading.inv()).as_rotvec()
    vector[:, 2] = heading.as_rotvec()[:, 2]
    return vector


def _cause(error, seconds):
    """In words: which part of errors (n, 3), rad, most of their square is, and when."""
    heading = np.degrees(error[:, 2])
    parts = {"inclination": np.degrees(error[:, :2]) ** 2 @ np.ones(2),
             f"heading, constant {heading.mean():.1f} deg": heading.mean() ** 2 + 0.0 * heading,
             "heading that wanders": (heading - heading.mean()) ** 2}
    largest = max(parts, key=lambda part: parts[part].mean())
    when = np.searchsorted(np.cumsum(parts[largest]), 0.5 * parts[largest].sum())
    return f"{largest}; half of it before {seconds[when]:.0f} of {seconds[-1]:.0f} s"


def _half_a_step_back(quat):
    """Estimates (n, 4) that are ahead by half a step, at their stamps."""
    turn = Rotation.from_quat(quat)
    between = (turn[1:].inv() * turn[:-1]).as_rotvec()
    return np.vstack([quat[:1], (turn[1:] * Rotation.from_rotvec(0.5 * between)).as_quat()])


def _peer(r, offline):
    """VQF's estimates, magnetometer interpolated at the rows of the Imu."""
    dt = float((r.imu.stamp[-1] - r.imu.stamp[0]) * 1e-9 / (len(r.imu) - 1))
    field = None
    if r.mag is not None:
        field = 1e6 * np.column_stack([np.interp(r.imu.stamp, r.mag.stamp, m)
                                       for m in r.mag.mag.T])
    gyr, acc = (np.ascontiguousarray(v, dtype=float) for v in (r.imu.gyr, r.imu.acc))
    out = offlineVQF(gyr, acc, field, dt) if offline else VQF(dt).updateBatch(gyr, acc, field)
    return _half_a_step_back(out["quat6D" if field is None else "quat9D"][:, [1, 2, 3, 0]])


def ours(r, mode, changes=None):
    """(n, 4), (n, 3, 3) of our estimator at the recording's rows."""
    estimator = OrientationEstimator(OrientationParams.from_mapping({"mode": mode,
                                                                     **(changes or {})}))
    rows = np.concatenate([estimator.run(r.imu, r.mag), estimator.finish()])
    if len(rows) != len(r.imu):
        raise ValueError(f"{r.name}: {len(rows)} rows of {len(r.imu)} samples")
    return rows["quat_world_imu"], rows["cov_attitude"]


def peers(r):
    """Scores of one recording by peer's name."""
    return {"VQF": score(r, _peer(r, False)), "OfflineVQF": score(r, _peer(r, True))}


def score_ours(r, changes=None):
    """Our scores of one recording by mode."""
    return {mode: score(r, *ours(r, mode, changes)) for mode in ("causal", "smoothed")}


def summary(name, scores, is_fitted=False):
    """Cells of a set's two lines, causal and smoothed: scores a list of dicts by estimator's name;
    is_fitted: the reference's heading was."""
    for mode, peer in (("causal", "VQF"), ("smoothed", "OfflineVQF")):
        mine, other = [s[mode] for s in scores], [s[peer] for s in scores]
        means = [" / ".join(f"{np.mean([getattr(s, part) for s in group]):.2f}"
                            for part in ("total", "inclination", "heading"))
                 for group in (other, mine)]
        worse = sum(m.total > WORSE * o.total for m, o in zip(mine, other))
        ratio = f"{np.median([m.heading_ratio for m in mine]):.1f}"
        yield [name, str(len(scores)), mode, *means,
               f"{sum(m.total for m in mine) / sum(o.total for o in other):.2f}",
               f"{np.mean([m.within for m in mine]):.2f}",
               f"{np.median([m.tilt_ratio for m in mine]):.1f}",
               f"({ratio})" if is_fitted and ratio != "nan" else ratio, str(worse)]


def trial_line(name, scores):
    """One recording's totals, for the terminal."""
    return f"  {name:45s}" + "  ".join(
        f"{k} {s.total:6.2f} i{s.inclination:5.2f} h{s.heading:6.2f}"
        + ("" if np.isnan(s.within) else
           f" in{s.within:4.2f} x{s.tilt_ratio:4.1f},{s.heading_ratio:4.1f}")
        for k, s in scores.items())


def worst(name, scores):
    """Rows of a recording's modes that are worse than the peer, or than they say, by much."""
    for mode, peer in (("causal", "VQF"), ("smoothed", "OfflineVQF")):
        mine, other = scores[mode], scores[peer]
        if mine.total > WORSE * other.total or mine.within < _FEW:
            yield [name, mode, f"{other.total:.2f}",
                   f"{mine.total:.2f} / {mine.inclination:.2f} / {mine.heading:.2f}",
                   f"{mine.within:.2f}", mine.cause]


HEADER = ["set", "trials", "mode", "peer: total / inclination / heading, deg", "ours",
          "ours / peer", "within 3 sigma", "stated / actual, inclination", "heading",
          "trials > 25 % worse"]


def _in_order(rows):
    """Rows of sets or recordings in the order of SETS; of recordings as they come."""
    order = list(SETS)
    return sorted(rows, key=lambda row: order.index(row[0]) if row[0] in order else 0)


def main(arguments):
    quick, trials = "--quick" in arguments, "--trials" in arguments
    chosen = [a for a in arguments if not a.startswith("--")] or list(SETS)
    rows, named = [], []
    for name in chosen:
        recordings = list(SETS[name]())[:2 if quick else None]
        scores = []
        for r in recordings:
            scores.append(peers(r) | score_ours(r))
            named += worst(r.name, scores[-1])
            if trials:
                print(trial_line(r.name, scores[-1]), flush=True)
        rows += summary(name, scores, any(r.frames for r in recordings)) if scores else []
    if quick:
        for row in rows + named:
            print(" | ".join(row))
        return
    if chosen != list(SETS):
        tried = {row[0] for row in rows} | {r.name for name in chosen for r in SETS[name]()}
        rows, named = (_in_order([row for row in lines_of_last_run(table) if row[0] not in tried]
                                 + new) for table, new in (("orientation_sets", rows),
                                                           ("orientation_worst", named)))
    write_table("orientation_worst", ["recording", "mode", "peer, deg",
                                      "ours: total / inclination / heading", "within 3 sigma",
                                      "most of it"],
                named, note=f"Recordings of orientation_sets that are {WORSE} times worse than the "
                            f"peer, or with fewer than {_FEW} of the rows within 3 sigma.")
    write_table("orientation_sets", HEADER, rows,
                note=f"Peers: VQF (causal) and OfflineVQF (smoothed) of vqf {version('vqf')}, "
                     "default parameters, as ours. RMSE over the rows that count, mean over the "
                     "trials. In brackets: a constant error of heading, which what is stated allows "
                     "for, is not in the error, as the reference's heading is fitted. Time and "
                     "frames: see the benchmark's docstring.")


if __name__ == "__main__":
    main(sys.argv[1:])
