"""A surface under the body: rows 0 = height above it - height of the body + noise.

Unlike readings these belong to samples, and are evaluated for whole trajectories before each
linear solution: surfaces are Python (grids, splines). The kernel adds the height of the body.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.estimation.smoother.jump_events import JumpEvents
from imu_fusion.estimation.smoother.measurements.rough_surface import linearise
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.records import CONTACT
from imu_fusion.estimation.smoother.state import ATT, POS, slow
from imu_fusion.kernels import njit
from imu_fusion.samples.free_fall import force_at, free_falls
from imu_fusion.samples.logs import ImuLog, seconds
from imu_fusion.surfaces.constraint import Constraint

# g: what stands, slides or rolls on a slope feels more (cos 50 deg = .64); in flight a dense flow
# drags at a body, and calibrations err, so that it may feel more than the .25 of a free fall.
_HELD = 0.5


class Spread(NamedTuple):
    """Covariances (N, 3, 3) m^2 of positions; None: nothing is known of them yet."""

    cov: np.ndarray | None


def surface_points(position_world: np.ndarray, quat_world_imu: np.ndarray,
                   lever_imu: np.ndarray | Sequence[float]) -> np.ndarray:
    """Points (N, 3) m that are held on the surface: p + R l.

    Args:
        position_world: (N, 3) m, of the sensor.
        quat_world_imu: (N, 4).
        lever_imu: l, (3,) or (N, 3) m. Zeros give ``position_world`` itself.
    """
    if not np.any(lever_imu):
        return position_world
    attitude = scipy.spatial.transform.Rotation.from_quat(quat_world_imu)
    return position_world + attitude.apply(np.array(lever_imu))


def in_flight(log: ImuLog, gravity: float, lever_imu: Sequence[float]) -> np.ndarray:
    """Mask (N,) of the samples at which a body whose point (3,) m is held by a surface feels too
    little for that."""
    time = seconds(log.stamp, log.stamp[0])
    free = np.zeros(len(log), bool)
    force = force_at(lever_imu, time, log.acc, log.gyr)
    for start, end in free_falls(time, force, gravity, _HELD):
        free[start:end] = True
    return free


def holds(constraint: Constraint, stamp: np.ndarray, events: JumpEvents | None,
          windows: Sequence[float], margin: float, free: np.ndarray | None = None) -> np.ndarray:
    """Mask (N,) of the samples at which a constraint holds: its phase of a jump, or else where
    something is felt, and the windows.

    Args:
        constraint, stamp, events: as of :func:`evaluate_constraints`.
        windows: s since the first stamp, start and stop in turn; empty: always.
        margin: s around the events in which heights are free.
        free: as of :func:`evaluate_constraints`.
    """
    late = np.int64(round(margin * 1e9)) if constraint.height else np.int64(0)
    active = np.ones(len(stamp), bool)
    if constraint.phase != "always":
        if events is None:
            raise ValueError(f"constraint {constraint.name} holds in a part of a jump: give events")
        active = (stamp <= events.takeoff - late if constraint.phase == "in_run" else
                  stamp >= events.touchdown + late)
    elif free is not None:
        active = ~free
    if windows:
        # An odd number of bounds passed: inside of a window.
        bounds = np.round(np.array(windows) * 1e9).astype(np.int64)
        active = active & (np.searchsorted(bounds, stamp - stamp[0], side="right") % 2 == 1)
    return active


def evaluate_constraints(constraints: Sequence[Constraint], position_world: np.ndarray,
                         stamp: np.ndarray, events: JumpEvents | None, params: SmootherParams,
                         free: np.ndarray | None = None,
                         spread: Spread | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Rows of all constraints on the samples where they hold.

    A row of every sample says as much per second at any rate of the Imu: the standard deviation
    of a constraint is that of rows ``surface.interval`` apart.

    Args:
        constraints: of the surface.
        position_world: (N, 3) m, in the frame of the surface, of the points held on it.
        stamp: (N,) ns.
        events: take-off and touch-down, or None when no constraint needs them.
        params: ``jump.event_margin`` around the events heights are free.
        free: mask (N,) of the samples :func:`in_flight`, at which nothing holds that holds
            always; None: none.
        spread: of the positions; None: rough surfaces, too, are linearised where they are.

    Returns:
        start (N + 1,) of the rows of each sample, rows (r,) of CONTACT, without derivatives but
        that to the position.
    """
    # Samples beside a gap do not speak for it.
    step = np.gradient(stamp - stamp[0])
    step = np.minimum(step, max(params.gap.max * 1e9, 1.5 * np.median(step)))
    share = np.sqrt(params.surface.interval * 1e9 / step)
    samples, pieces = [np.empty(0, np.int64)], [np.empty(0, CONTACT)]
    for constraint in constraints:
        sample = np.flatnonzero(holds(constraint, stamp, events, params.surface.windows,
                                      params.jump.event_margin, free))
        if not len(sample):
            continue
        bend = np.zeros(len(sample))
        if constraint.rough and spread is not None:
            residual, gradient, bend = linearise(
                constraint.evaluate, position_world[sample],
                None if spread.cov is None else spread.cov[sample])
        else:
            residual, gradient = constraint.evaluate(position_world[sample])
        keep = np.isfinite(residual)
        rows = np.zeros(keep.sum(), CONTACT)
        rows["residual"], rows["position"] = residual[keep], gradient[keep]
        rows["sigma"] = np.sqrt(constraint.sigma ** 2 + bend[keep]) * share[sample[keep]]
        rows["height"] = constraint.height
        samples.append(sample[keep])
        pieces.append(rows)
    sample = np.concatenate(samples)
    order = np.argsort(sample, kind="stable")
    start = np.searchsorted(sample[order], np.arange(len(stamp) + 1))
    return start, np.concatenate(pieces)[order]


def put_lever_derivatives(start: np.ndarray, contacts: np.ndarray, quat_world_imu: np.ndarray,
                          lever_imu: np.ndarray | Sequence[float]) -> None:
    """Derivatives of rows at p + R l to the attitude (m/rad, in imu axes) and to the lever arm l.

    With a = R' g for a gradient g: a . (dtheta x l) = dtheta . (l x a), and a . dl.

    Args:
        start, contacts: of :func:`evaluate_constraints`; the latter are completed.
        quat_world_imu: (N, 4). lever_imu: (3,) or (N, 3) m.
    """
    sample = np.repeat(np.arange(len(quat_world_imu)), np.diff(start))
    attitude = scipy.spatial.transform.Rotation.from_quat(quat_world_imu[sample])
    along = attitude.inv().apply(contacts["position"])
    lever = np.broadcast_to(lever_imu, quat_world_imu[:, :3].shape)[sample]
    contacts["attitude"], contacts["lever_arm"] = np.cross(lever, along), along


@njit
def put_row(contact, x, model, rows):
    """The whitened row of a contact at a state; returns its residual.

    Args:
        contact, model: records of CONTACT and MODEL. x: (n + 1,).
        rows: record of ROWS; its length, entries and states are set.
    """
    blocks, sigma, gap = model.blocks, contact.sigma, -contact.residual
    rows.length = 0
    for i in range(3):
        append(rows, POS + i, contact.position[i] / sigma)
    for i in range(3):
        append(rows, ATT + i, contact.attitude[i] / sigma)
    if blocks.surface_lever_arm >= 0:
        for i in range(3):
            append(rows, blocks.surface_lever_arm + i, contact.lever_arm[i] / sigma)
    if contact.height and blocks.body_height >= 0:
        gap += slow(x, blocks.body_height)
        append(rows, blocks.body_height, -1.0 / sigma)
    return gap / sigma


@njit
def append(rows, state, entry):
    """Append an entry to the row of a record of ROWS, unless it is zero."""
    if entry != 0.0:
        rows.entries[rows.length], rows.states[rows.length] = entry, state
        rows.length += 1
