"""The centre of a body that tumbles, as its accelerometers tell it."""

from typing import NamedTuple

import numpy as np

from imu_fusion.samples.free_fall import force_at

_FAST = 4.0        # rad/s, at which a body tumbles
_ENOUGH = 0.1      # share of the samples at which it does
_FEWEST = 400      # of these
_PARTS = 10        # whose scatter tells the standard deviation
_USUAL = 10.0      # m/s^2, beyond which a force counts less: blows
_ROUNDS = 3
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


def _normal(arms, force, weight):
    """Normal equations of force + arms @ point = bias of a part, the bias left out."""
    total = weight.sum()
    arms = arms - np.einsum("n,nij->ij", weight, arms) / total
    force = force - weight @ force / total
    return (np.einsum("n,nji,njk->ik", weight, arms, arms),
            -np.einsum("n,nji,nj->i", weight, arms, force))
