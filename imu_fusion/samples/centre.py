"""The centre of a body that tumbles, as its accelerometers tell it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from imu_fusion.samples.free_fall import force_at

_FAST = 4.0        # rad/s, at which a body tumbles
_ENOUGH = 0.1      # share of the samples at which it does
_FEWEST = 400      # of these
_PARTS = 10        # whose scatter tells the standard deviation
_USUAL = 10.0      # m/s^2, beyond which a force counts less: blows
_ROUNDS = 3
_FLIGHT = 0.25       # s of a flight
_SHORTEST = 12       # samples of it
_FLIGHTS = 2         # that overlap by half of it
_FLIES = 8.0         # rad/s, at which a sensor off the centre does not show it
_FELT = 2.5          # m/s^2: what is felt less is free fall
_EXPLAINED = 0.4     # of what is felt at the given point, that another one may leave
_NOTHING = 1.5       # m/s^2, RMS of what is felt at the centre: noise, and 3 % of a calibration
_TOLD = 1e-2         # of the largest eigenvalue: what tells less is left as it was given
_INSIDE = 0.15       # m
_ONE_AXIS = 1e10   # condition, beyond which the body turns about one axis alone


class Centre(NamedTuple):
    """``point`` (3,) m from the accelerometers, in their axes, and its standard deviation ``sd``
    (3,) m."""

    point: np.ndarray
    sd: np.ndarray


def find_centre(time: np.ndarray, force: np.ndarray, rate: np.ndarray) -> Centre | None:
    """The point whose specific force has least to do with how the body turns: what is felt there
    comes from outside, and turns about in the body's axes, while a centripetal force stands still
    in them. None of a body that does not tumble, or about one axis alone.

    Args:
        time: (n,) s. force, rate: (n, 3) m/s^2, rad/s.
    """
    fast = np.linalg.norm(rate, axis=1) > _FAST
    if fast.sum() < max(_FEWEST, _ENOUGH * len(time)):
        return None
    nothing = np.zeros_like(force)
    # Columns: the force at a point 1 m along an axis, less that at the accelerometers.
    arms = np.stack([force_at(axis, time, nothing, rate) for axis in np.eye(3)], axis=2)
    parts = np.array_split(np.flatnonzero(fast), _PARTS)
    weight = np.ones(len(time))
    for _ in range(_ROUNDS):
        sums = [_normal(arms[part], force[part], weight[part]) for part in parts]
        normal, right = sum(n for n, _ in sums), sum(r for _, r in sums)
        if not np.linalg.cond(normal) < _ONE_AXIS:
            return None
        point = np.linalg.solve(normal, right)
        left = np.linalg.norm(force + arms @ point, axis=1)
        weight = 1.0 / (1.0 + (left / _USUAL) ** 2)
    inverse = np.linalg.inv(normal)
    scatter = sum(np.outer(e, e) for e in (r - n @ point for n, r in sums))
    cov = inverse @ scatter @ inverse * _PARTS / (_PARTS - 3.0)
    return Centre(point, np.sqrt(cov.diagonal()))


def centre_in_flight(time: np.ndarray, force: np.ndarray, rate: np.ndarray,
                     given: ArrayLike) -> np.ndarray | None:
    """The point (3,) m that a body turns about while it flies, where nothing is felt, if it is not
    the one that is given: a quarter of a second tells. Along the axis of the turn it is the given.

    Args: as :func:`find_centre`; given: (3,) m.
    """
    given = np.asarray(given, dtype=float)
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    length = round(_FLIGHT / step) if step > 0.0 else 0
    if length < _SHORTEST:
        return None
    nothing = np.zeros_like(force)
    arms = np.stack([force_at(axis, time, nothing, rate) for axis in np.eye(3)], axis=2)
    there = force + arms @ given
    flights = []
    for first in range(0, len(time) - length + 1, length // 2):
        part = slice(first, first + length)
        if (time[part][-1] - time[first] < 1.5 * _FLIGHT
                and np.median(np.linalg.norm(rate[part], axis=1)) > _FLIES
                and np.median(np.linalg.norm(there[part], axis=1)) > _FELT
                and _explains(_nearest(arms[part], there[part]), given, arms[part], there[part])):
            flights.append(part)
    if len(flights) < _FLIGHTS:
        return None
    flown = np.unique(np.concatenate([np.arange(len(time))[part] for part in flights]))
    off = _nearest(arms[flown], there[flown])
    return given + off if _explains(off, given, arms[flown], there[flown]) else None


def _explains(off, given, arms, force):
    """Whether hardly anything is felt at a point of the body that is ``off`` the given."""
    left, before = (np.sqrt(np.mean(np.sum(v ** 2, axis=1))) for v in (force + arms @ off, force))
    return left < min(_NOTHING, _EXPLAINED * before) and np.linalg.norm(given + off) < _INSIDE


def _nearest(arms, force):
    """The smallest correction (3,) m after which nothing is felt, as far as the turn tells one."""
    values, axes = np.linalg.eigh(np.einsum("nij,nik->jk", arms, arms))
    told = values > _TOLD * values[-1]
    axes = axes[:, told]
    right = axes.T @ np.einsum("nij,ni->j", arms, force)
    return -axes @ (right / values[told])


def _normal(arms, force, weight):
    """Normal equations of force + arms @ point = bias of a part, the bias left out."""
    total = weight.sum()
    arms = arms - np.einsum("n,nij->ij", weight, arms) / total
    force = force - weight @ force / total
    return (np.einsum("n,nji,njk->ik", weight, arms, arms),
            -np.einsum("n,nji,nj->i", weight, arms, force))
