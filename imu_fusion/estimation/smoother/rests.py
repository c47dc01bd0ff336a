"""Rests that a recording shows, and what speaks against one: a receiver that says that it moves, or
a trajectory that cannot have stopped."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.smoother.imu_input import ImuInput
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.samples.logs import FixLog, VelocityLog
from imu_fusion.samples.stillness import find_still

_INTERVAL = 100_000_000   # ns, between velocities of zero
_CLEARLY = 1.5            # by which of two rests one is more unlike noise
_FEWEST = 3               # fixes, of which a speed can be told
_SPEED = 0.3              # m/s, that receivers at rest wander by
_SDS = 6.0                # standard deviations by which a receiver or a trajectory contradicts


class Rest(NamedTuple):
    """From stamp ``first`` to ``last`` (ns); ``unrest`` of :class:`.stillness.Still`."""

    first: int
    last: int
    unrest: float


def find_rests(prepared: ImuInput, fix: FixLog | None, velocity: VelocityLog | None,
               frame: LocalFrame, params: SmootherParams) -> tuple[Rest, ...]:
    """Rests of the Imu samples that no receiver contradicts; none where they are not to be used."""
    if not params.rest.found:
        return ()
    log, sensor = prepared.log, params.sensor
    noise = sensor.gyro_noise_density, sensor.acc_noise_density
    whole = prepared.recorded & ~prepared.clipped.any(axis=1)
    rests = [Rest(int(log.stamp[still.start]), int(log.stamp[still.stop - 1]), still.unrest)
             for still in find_still(log, noise, params.rest.shortest)
             if whole[still.start:still.stop].all()]
    return tuple(rest for rest in rests if not _moves(rest, fix, velocity, frame))


def stamps_of(rests: Sequence[Rest], stamp: np.ndarray) -> np.ndarray:
    """(m,) ns, of the samples with stamps (N,) at which the velocity of rests is zero."""
    at = [np.arange(rest.first, rest.last + 1, _INTERVAL) for rest in rests]
    found = np.searchsorted(stamp, np.concatenate([stamp[:0], *at]))
    return stamp[np.unique(found[found < len(stamp)])]


def contradicted(rests: Sequence[Rest], at: np.ndarray, innovations: np.ndarray, begins: bool
                 ) -> tuple[Rest, ...]:
    """Rests to give up, as the trajectory cannot have reached one from the one before: that of both
    which is less like noise, or both if they are alike.

    Args:
        at: (m,) ns, of velocities at rest. innovations: (m, 3) of them, normalised.
        begins: whether it is known that the first is one.
    """
    sizes = np.linalg.norm(innovations, axis=1)
    for k, rest in enumerate(rests):
        if sizes[(at >= rest.first) & (at <= rest.last)].max(initial=0.0) > _SDS:
            before = rests[max(k - 1, 0)]
            if (k == 1 and begins) or rest.unrest > _CLEARLY * before.unrest:
                return (rest,)
            return (before,) if before.unrest > _CLEARLY * rest.unrest else (before, rest)
    return ()


def _moves(rest, fix, velocity, frame):
    """Whether the receiver says that the body moves."""
    span = rest.first, rest.last + 1
    told = []
    if velocity is not None:
        inside = velocity[np.isfinite(velocity.vel_world).all(axis=1)].between(*span)
        if len(inside):
            told.append(np.median(inside.vel_world, axis=0))
    if fix is not None:
        fixes = fix[fix.usable].between(*span)
        if len(fixes) >= _FEWEST:
            place = frame.to_enu(fixes.latitude_deg, fixes.longitude_deg, fixes.height)
            told.append(_slope((fixes.stamp - fixes.stamp[0]) * 1e-9, place[:, :2]))
    return any(np.linalg.norm(v[:2]) > _SPEED for v in told)


def _slope(time, place):
    """Speed (2,) m/s that places (n, 2) are sure to move by, at ``time`` (n,) s."""
    since = time - time.mean()
    square = max(float(since @ since), 1e-9)
    slope = since @ place / square
    left = place - place.mean(axis=0) - since[:, None] * slope
    sd = np.sqrt(np.sum(left ** 2, axis=0) / max(len(time) - 2, 1) / square)
    return np.sign(slope) * np.maximum(np.abs(slope) - _SDS * sd, 0.0)
