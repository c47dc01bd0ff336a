"""The state of the smoother: what it holds always, which blocks it can hold besides, where.

A state is a row of an array x (N, n + 1): position and velocity in the world, attitude quaternion,
gyroscope bias, accelerometer bias, then those blocks of :data:`BLOCKS` that are present. The error
state is one shorter, as the attitude's error is a rotation vector in imu axes. All indices are
those of the error state; :func:`attitude` and :func:`slow` find the entries of x.

A further state is one line of BLOCKS and one of :class:`StateBlocks`, at their ends.
"""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.geometry.rotation import (
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_normalize,
)
from imu_fusion.kernels import njit

#: First error index of what is always there, three entries each, and their number.
POS, VEL, ATT, GYR_BIAS, ACC_BIAS, CORE = 0, 3, 6, 9, 12, 15

#: Error indices from here on are slow states: constant, walking or wandering sensor errors.
SLOW = GYR_BIAS

_ENU, _XYZ = ("east", "north", "up"), ("x", "y", "z")


class StateBlocks(NamedTuple):
    """First error index of each optional block, -1 where it is absent; kernels read it by name."""

    mag_bias: int = -1
    mag_scale: int = -1
    gnss_position_error: int = -1
    gnss_time_offset: int = -1
    velocity_time_offset: int = -1
    acc_matrix: int = -1
    gyr_scale: int = -1
    gnss_lever_arm: int = -1
    body_height: int = -1
    surface_lever_arm: int = -1
    gnss_velocity_error: int = -1
    gnss_step: int = -1
    mag_axes: int = -1


@dataclass(frozen=True)
class Block:
    """One optional block.

    ``sd`` of the prior, in the units of the state, one for each component or one for all; the
    block is present where any is above zero, and where there are readings of the measurement
    ``needs``, if named. ``mean`` of the prior, else zero. ``tau`` (s): the block is a Gauss-Markov
    process of standard deviation ``sd``, else it is constant. ``si``: factor from the state's
    units to SI. ``title``, ``unit``, ``factor`` (from SI) and ``components`` are for reports.
    """

    name: str
    title: str
    unit: str
    factor: float
    components: Sequence[str]
    sd: Callable[[SmootherParams], float | Sequence[float]]
    mean: Callable[[SmootherParams], float | Sequence[float]] | None = None
    tau: Callable[[SmootherParams], float] | None = None
    needs: str = ""
    si: float = 1.0

    @property
    def width(self) -> int:
        """Number of error states."""
        return len(self.components)


#: All optional blocks, in their order in the state. Magnetic ones are kept in microtesla, near one
#: in size.
BLOCKS = (
    Block("mag_bias", "magnetometer bias", "µT", 1e6, _XYZ, lambda p: p.sensor.mag_bias_sd * 1e6,
          needs="mag", si=1e-6),
    Block("mag_scale", "magnetometer scale", "%", 100.0, _XYZ, lambda p: p.sensor.mag_scale_sd,
          needs="mag"),
    Block("gnss_position_error", "GNSS position error", "m", 1.0, _ENU,
          lambda p: p.gnss.position_error_sd, tau=lambda p: p.gnss.position_error_tau),
    Block("gnss_time_offset", "delay of the GNSS", "ms", 1e3, ("delay",),
          lambda p: p.gnss.time_offset_sd),
    Block("velocity_time_offset", "further delay of velocities", "ms", 1e3, ("delay",),
          lambda p: p.gnss.velocity_time_offset_sd),
    Block("acc_matrix", "accelerometer matrix", "%", 100.0,
          tuple(a + b for a in _XYZ for b in _XYZ), lambda p: p.sensor.acc_matrix_sd),
    Block("gyr_scale", "gyroscope scale", "%", 100.0, _XYZ, lambda p: p.sensor.gyro_scale_sd),
    Block("gnss_lever_arm", "antenna in the imu frame", "m", 1.0, _XYZ,
          lambda p: p.gnss.lever_arm_sd, mean=lambda p: p.gnss.lever_arm),
    Block("body_height", "height above the surface", "m", 1.0, ("height",),
          lambda p: p.surface.body_height_sd, mean=lambda p: p.surface.body_height),
    Block("surface_lever_arm", "point on the surface in the imu frame", "m", 1.0, _XYZ,
          lambda p: p.surface.lever_arm_sd, mean=lambda p: p.surface.lever_arm),
    Block("gnss_velocity_error", "GNSS velocity error", "m/s", 1.0, _ENU,
          lambda p: p.gnss.velocity_error_sd, tau=lambda p: p.gnss.velocity_error_tau),
    Block("gnss_step", "step of the fixes", "m", 1.0, _ENU, lambda p: p.initial.position_sd,
          needs="moved_fix"),
    Block("mag_axes", "axes of the magnetometer in the imu frame", "°", 180.0 / math.pi, _XYZ,
          lambda p: p.sensor.mag_axes_sd, needs="mag"),
)

# Least standard deviation of a Gauss-Markov component, in m or m/s: one that is given as zero
# beside others stays, in effect, zero.
_LEAST_SD = 1e-6

#: Most error states that there can be: the size of rows in kernels.
MOST = CORE + sum(block.width for block in BLOCKS)


def place_blocks(present: Collection[str]) -> tuple[StateBlocks, int]:
    """The StateBlocks with the blocks of these names, and the size of the error state."""
    places, size = {}, CORE
    for block in BLOCKS:
        if block.name in present:
            places[block.name] = size
            size += block.width
    return StateBlocks(**places), size


@dataclass(frozen=True)
class StatePrior:
    """What is known before any measurement: ``mean`` (n + 1,), of which the first fix, velocity
    and attitude are still to be set, ``sd`` (n,); ``decay_rate`` (1/s) and variance density of the
    ``walk`` (n,) of each error state."""

    blocks: StateBlocks
    mean: np.ndarray
    sd: np.ndarray
    decay_rate: np.ndarray
    walk: np.ndarray

    @classmethod
    def of(cls, params: SmootherParams, measured: Collection[str]) -> "StatePrior":
        """From parameters, for readings of the measurements of these names."""
        p = params
        sds = {block.name: np.broadcast_to(block.sd(p), block.width) for block in BLOCKS
               if not block.needs or block.needs in measured}
        blocks, size = place_blocks([name for name, sd in sds.items() if np.any(sd)])
        sd, mean = np.empty(size), np.zeros(size + 1)
        decay_rate, walk = np.zeros(size), np.zeros(size)
        for first, value in ((POS, p.initial.position_sd), (VEL, p.initial.speed_sd),
                             (ATT, p.initial.attitude_sd), (GYR_BIAS, p.sensor.gyro_bias_sd),
                             (ACC_BIAS, p.sensor.acc_bias_sd)):
            sd[first:first + 3] = value
        walk[GYR_BIAS:GYR_BIAS + 3] = p.sensor.gyro_bias_walk ** 2
        walk[ACC_BIAS:ACC_BIAS + 3] = p.sensor.acc_bias_walk ** 2
        for block in BLOCKS:
            first = getattr(blocks, block.name)
            if first < 0:
                continue
            here = slice(first, first + block.width)
            sd[here] = sds[block.name]
            if block.mean is not None:
                mean[first + 1:first + 1 + block.width] = block.mean(p)
            if block.tau is not None:
                decay_rate[here] = 1.0 / block.tau(p)
                walk[here] = 2.0 * sd[here] ** 2 * decay_rate[here]
                sd[here] = np.maximum(sd[here], _LEAST_SD)
        return cls(blocks, mean, sd, decay_rate, walk)


def slow_states(x: np.ndarray, first: int, width: int) -> np.ndarray:
    """View (..., width) of the slow states with error indices from ``first`` on, of states
    (..., n + 1)."""
    return x[..., first + 1:first + 1 + width]


@njit
def attitude(x: np.ndarray) -> np.ndarray:
    """View (4,) of the quaternion of a state (n + 1,)."""
    return x[ATT:ATT + 4]


@njit
def slow(x: np.ndarray, i: int) -> float:
    """The slow state with error index i of a state (n + 1,)."""
    return x[i + 1]


@njit
def boxplus(x: np.ndarray, delta: np.ndarray) -> None:
    """State x (n + 1,) moved by an error state delta (n,), in place."""
    attitude(x)[:] = quat_normalize(quat_multiply(attitude(x), quat_exp(delta[ATT:ATT + 3])))
    for i in range(ATT):
        x[i] += delta[i]
    for i in range(SLOW, len(delta)):
        x[i + 1] += delta[i]


@njit
def boxminus(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    """out (n,) with a = b [+] out, for states a, b (n + 1,)."""
    out[ATT:ATT + 3] = quat_log(quat_multiply(quat_conjugate(attitude(b)), attitude(a)))
    for i in range(ATT):
        out[i] = a[i] - b[i]
    for i in range(SLOW, len(out)):
        out[i] = a[i + 1] - b[i + 1]
