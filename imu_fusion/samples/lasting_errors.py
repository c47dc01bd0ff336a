"""Errors of sensors that last: a constant of the accelerometer, a gyroscope that is late or that
feels forces.

In axes that do not turn gravity and the Earth's field stand still. What each error of a list would
make of them there, carried by the gyroscope, is a column of a regression; all are fitted at once,
so that none is taken for another: those that any sensor has a little of by what is usual, beside.
Accelerations are felt, too. But a body stays about where it is, so that they have hardly any slow
part: sums of them count beside them. What is left follows itself for a while, which the standard
deviations include (Newey and West 1987).

A walker who goes round in laps feels forces that turn with him, as a constant does. They are level:
what is up alone has to tell of the constant, too.
"""

from typing import NamedTuple

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.samples.disagreement import late_finding
from imu_fusion.samples.findings import Finding
from imu_fusion.samples.flat_tops import GYRO_FLOOR, flat_tops
from imu_fusion.samples.logs import ImuLog, MagLog, seconds

_STEP = 0.02            # s, over which samples are averaged
_LONG, _SHORT = 24.0, 8.0   # s of a stretch, of gravity and of the field, which changes with place
_LEAST = 8.0            # s of a recording, which may be one stretch
_MOST = 200.0           # s that are looked at, those in which it turns most
_STAYS = 0.2            # s, from which on sums of accelerations count more than these
_FOLLOWS = 2.0          # s, for which what is left follows itself
_ROUNDS = 8             # at most, of those that any sensor has, and again of all,
_FOUND = 0.3            # standard deviations, by which a last one moves any
_SURELY = 3.0           # standard deviations that are taken off before an error is judged,
_CLEARLY = 5.0          # and that it must have; by what is up alone _SURELY do
_CONSTANT = 0.4         # m/s^2: more than accelerometers are off by, once calibrated
_TURNS = 3.0            # rad on the way, that a body turns in a stretch
_WILD = 20.0            # times what all but a hundredth of the samples are off their neighbours
_CLIPPED = 0.999        # of a limit
_LATE = 0.02            # s: less is a matter of filters
_FEELS = 5e-3           # rad/s per m/s^2 (3 deg/s per g): fifteen times what gyroscopes feel
_GRAVITY = 9.81         # m/s^2, that change as a body is laid on its side: in a second, say
_CALM = 2e-3            # of it, sd: where the field is as disturbed as that it tells nothing
# Where a body hardly tumbles, a constant is part of what stands still. How much of its column no
# other explains, in its mean square: along an axis that is judged, along the others, for the field.
_TOLD, _TOLD_OTHERS, _TOLD_FIELD = 6.0, 2.0, 0.1

#: Sizes of the errors, and what any sensor has of them: constants along the axes of the vectors,
#: m/s^2 or of the field, of which next to nothing is known; the sensor's place, m, from the point
#: that stays; biases of rates, rad/s, and errors of their scales; s by which they are late; rad/s
#: per m/s^2 that they feel, by rows.
_USUAL = {"constant": (3, 10.0), "place": (3, 0.3), "bias": (3, 0.1), "scale": (3, 0.03),
          "delay": (1, 0.1), "feels": (9, 0.03)}


class Stretches(NamedTuple):
    """Parts of a recording, means over ``step`` s: rates, forces and the ``vectors`` that should
    stand still, (w, n, 3) each."""

    step: float
    rates: np.ndarray
    forces: np.ndarray
    vectors: np.ndarray


class Errors(NamedTuple):
    """What was fitted, by name, with standard deviations; ``told`` (3,) how much of the columns of
    constants no others explain; ``upwards`` (3,) constants by what is up alone, in standard
    deviations."""

    value: dict[str, np.ndarray]
    sd: dict[str, np.ndarray]
    told: np.ndarray
    upwards: np.ndarray


def check_force_errors(imu: ImuLog, name: str) -> list[Finding]:
    """Findings about a constant of the accelerometer and a delay, of a body that tumbles."""
    parts = _stretches(imu, imu.acc, _LONG)
    if parts is None:
        return []
    found = _fit(parts, ("constant", "place", "bias", "scale", "delay"), ("place", "bias"), _STAYS)
    if found.told.min() < _TOLD_OTHERS:
        return []
    result = []
    constant, sd = found.value["constant"], found.sd["constant"]
    sure = (_is_sure(constant, sd, _CONSTANT) & (found.told > _TOLD)
            & (np.sign(constant) * found.upwards > _SURELY))
    if sure.any():
        values = ", ".join(f"{v:.1f}" for v in constant)
        result.append(Finding(
            "unit", f"{name}: while it turns the accelerometer reads some ({values}) m/s^2 more "
            "than gravity and accelerations make: calibrate it (imu_fusion calibrate "
            f"accelerometer), or set sensor.acc_bias_sd to {np.abs(constant).max():.1f} or more; "
            "until then tilts are off by as much as that is of gravity"))
    late = found.value["delay"]
    if _is_sure(late, found.sd["delay"], _LATE).any():
        result.append(late_finding(float(late[0]), "gravity", name))
    return result


def check_field_errors(imu: ImuLog, mag: MagLog, name: str) -> list[Finding]:
    """A finding about a gyroscope that feels forces, by the Earth's field."""
    if min(len(imu), len(mag)) < 2 or np.any(np.diff(mag.stamp) <= 0):
        return []
    time, measured = seconds(imu.stamp, imu.stamp[0]), seconds(mag.stamp, imu.stamp[0])
    field = np.column_stack([np.interp(time, measured, mag.mag[:, i], left=np.nan, right=np.nan)
                             for i in range(3)])
    parts = _stretches(imu, field, _SHORT)
    if parts is None:
        return []
    size = np.linalg.norm(parts.vectors, axis=2).mean()
    found = _fit(parts._replace(vectors=parts.vectors / max(size, 1e-12)),
                 ("constant", "bias", "scale", "delay", "feels"), ("bias",), None)
    feels, sd = found.value["feels"], found.sd["feels"]
    if found.told.min() < _TOLD_FIELD or not (_is_sure(feels, sd, _FEELS) & (sd < _CALM)).any():
        return []
    most = 1e3 * float(feels[np.argmax(np.abs(feels))])
    return [Finding(
        "axes", f"{name}: the field turns as if the gyroscope felt forces, by up to {most:.1f} "
        "mrad/s per m/s^2: its bias changes with how it lies and moves; mount it softly, take "
        "another one, or set sensor.gyro_bias_walk and sensor.gyro_bias_sd to "
        f"{_GRAVITY * 1e-3 * abs(most):.2g}")]


def _is_sure(value, sd, least):
    return (np.abs(value) - _SURELY * sd > least) & (np.abs(value) > _CLEARLY * sd)


def _stretches(imu, vectors, length):
    """The :class:`Stretches` of about ``length`` s without gaps in which rates say that it turns
    most; None where there are none."""
    stamp, gyr = imu.stamp, imu.gyr
    for top in flat_tops(gyr, GYRO_FLOOR):    # where it clips it tells no turn
        gyr = np.where(np.abs(gyr[:, top.axis:top.axis + 1]) < _CLIPPED * top.limit, gyr, np.nan)
    interval = float(np.median(np.diff(stamp))) * 1e-9 if len(stamp) > 1 else np.nan
    if not 0.0 < interval < 5.0 * _STEP:
        return None
    group = max(int(round(_STEP / interval)), 1)
    if len(stamp) * interval < _LEAST:
        return None
    count = max(int(len(stamp) * interval / length), 1)
    size = len(stamp) // (count * group)
    used = count * size * group
    rates, forces, vectors = (
        _without_spikes(values[:used]).reshape(count, size, group, 3).mean(axis=2)
        for values in (gyr, imu.acc, vectors))
    steps = np.diff(stamp[:used].reshape(count, size * group), axis=1)
    # A gap shifts all that comes after it.
    whole = np.abs(steps.sum(axis=1) * 1e-9 / interval - (size * group - 1)) < 0.05 * size * group
    for values in (rates, forces, vectors):
        whole &= np.isfinite(values).all(axis=(1, 2))
    whole &= vectors.any(axis=(1, 2))    # zeros: there is no such sensor
    path = np.where(whole, np.linalg.norm(rates, axis=2).sum(axis=1), 0.0)
    best = np.argsort(-path, kind="stable")[:max(int(_MOST / (size * group * interval)), 1)]
    best = best[path[best] * group * interval > _TURNS]
    return Stretches(group * interval, rates[best], forces[best], vectors[best]) if len(
        best) else None


def _without_spikes(values):
    """Values (n, 3), single ones that are wild replaced by a neighbour."""
    values = np.asarray(values, dtype=float)
    near = scipy.ndimage.median_filter(values, (3, 1), mode="nearest")
    off = np.abs(values - near)
    usual = np.nanpercentile(off, 99.0) if np.isfinite(off).any() else 0.0
    return np.where(off > _WILD * usual, near, values)


def _fit(parts, names, first, stays):
    """The :class:`Errors` of these names, those of ``first`` before the others: far from what is
    right their columns are not, either."""
    sizes = [_USUAL[name][0] for name in names]
    at = dict(zip(names, np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])))
    usual = np.repeat([_USUAL[name][1] for name in names], sizes)
    value = np.zeros(len(usual))
    known = np.isin(np.repeat(names, sizes), first)
    for use in (known, np.ones(len(value), bool)):
        for _ in range(_ROUNDS):
            carried, columns = _rows(parts, names, at, value)
            move, sd, told = _solve(_free(carried, parts.step, stays),
                                    _free(columns[..., use], parts.step, stays), value[use],
                                    usual[use], parts.step)
            if np.all(np.abs(move) < _FOUND * sd):
                break
            value[use] += move
    up = carried.mean(axis=1)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    use = at["constant"]
    move, spread, _ = _solve(
        _free(np.einsum("wni,wi->wn", carried, up), parts.step, stays)[..., None],
        _free(np.einsum("wnik,wi->wnk", columns[..., use], up), parts.step, stays)[:, :, None],
        value[use], usual[use], parts.step)
    return Errors({name: value[k] for name, k in at.items()},
                  {name: sd[k] for name, k in at.items()}, told[use], (value[use] + move) / spread)


def _solve(left, columns, value, usual, step):
    """What the errors ``value`` (k,) must change by to explain what is ``left`` (w, n, i) by
    columns (w, n, i, k), with standard deviations, and how much of each no other explains."""
    w, n, i = left.shape
    scale = max(float(np.mean(left ** 2)) * _FOLLOWS / step / i, 1e-20)    # as if it were white
    known = np.diag(usual ** -2.0)
    inverse = np.linalg.inv(
        np.einsum("wnij,wnik->jk", columns, columns, optimize=True) / scale + known)
    scores = np.einsum("wnij,wni->wnj", columns, left) / scale
    move = inverse @ (scores.sum(axis=(0, 1)) - value / usual ** 2)
    # Their products with those up to a while later, the less the later: sums over that while.
    length = min(max(int(_FOLLOWS / step), 1), n)
    sums = np.cumsum(np.pad(scores, ((0, 0), (length, length - 1), (0, 0))), axis=1)
    sums = sums[:, length:] - sums[:, :-length]
    spread = known + np.einsum("wnj,wnk->jk", sums, sums, optimize=True) / length
    sd = np.sqrt(np.diag(inverse @ spread @ inverse))
    return move, sd, scale / (np.diag(inverse) * w * n)


def _rows(parts, names, at, value):
    """The carried vectors (w, n, 3) but for the errors ``value``, and what changes of these make of
    them, (w, n, 3, k)."""
    h = parts.step
    errors = {name: value[k] for name, k in at.items()}
    feels = errors.get("feels", np.zeros(9)).reshape(3, 3)
    reported = _at(parts.rates, float(errors["delay"][0]) / h)
    change = np.gradient(reported, h, axis=1)
    rates = (reported * (1.0 - errors["scale"]) - errors["bias"] - parts.forces @ feels.T)
    turns = _turns(rates, h)
    arms = _arms(rates, np.gradient(rates, h, axis=1)) if "place" in names else None
    vectors = parts.vectors - errors["constant"]
    if arms is not None:
        vectors = vectors - arms @ errors["place"]
    carried = np.einsum("wnij,wnj->wni", turns, vectors)
    eye = np.broadcast_to(np.eye(3), (*parts.rates.shape, 3))
    columns = []
    for name in names:
        if name == "constant":
            columns.append(turns)
        elif name == "place":
            columns.append(turns @ arms)
        else:
            wrong = {"bias": lambda: eye, "scale": lambda: reported[..., None] * np.eye(3),
                     "delay": lambda: -change[..., None],
                     "feels": lambda: np.einsum("ij,wnk->wnijk", np.eye(3), parts.forces).reshape(
                         *parts.rates.shape, 9)}[name]()
            moved = h * (turns @ wrong)
            moved = np.cumsum(moved, axis=1) - 0.5 * moved
            columns.append(np.cross(moved, carried[..., None], axisa=2, axisb=2, axisc=2))
    return carried, np.concatenate(columns, axis=3)


def _at(rates, later):
    """Rates (w, n, 3) ``later`` steps later, between steps on straight lines."""
    n = rates.shape[1]
    at = np.clip(np.arange(n) + later, 0.0, n - 1.0)
    first = np.minimum(at.astype(int), n - 2)
    share = (at - first)[:, None]
    return (1.0 - share) * rates[:, first] + share * rates[:, first + 1]


def _turns(rates, step):
    """Rotations (w, n, 3, 3) from the axes of each step to those of the first."""
    w, n, _ = rates.shape
    between = scipy.spatial.transform.Rotation.from_rotvec(
        (0.5 * step * (rates[:, 1:] + rates[:, :-1])).reshape(-1, 3)).as_matrix()
    between = between.reshape(w, n - 1, 3, 3)
    turns = np.empty((w, n, 3, 3))
    turns[:, 0] = np.eye(3)
    for i in range(1, n):
        turns[:, i] = turns[:, i - 1] @ between[:, i - 1]
    return turns


def _arms(rates, change):
    """(w, n, 3, 3): the force at 1 m along each axis, less that at the origin."""
    return np.stack([np.cross(change, axis) + np.cross(rates, np.cross(rates, axis))
                     for axis in np.eye(3)], axis=3)


def _free(values, step, stays):
    """Values (w, n, ...) with their sums, free of what is constant in a stretch, and of what that
    makes of the sums."""
    n = values.shape[1]
    known = [np.ones(n)]
    if stays is not None:
        values = values + np.cumsum(values, axis=1) * (step / stays)
        known.append(np.linspace(-1.0, 1.0, n))
    flat = values.reshape(len(values), n, -1)
    basis = np.linalg.qr(np.column_stack(known))[0]
    return (flat - basis @ (basis.T @ flat)).reshape(values.shape)
