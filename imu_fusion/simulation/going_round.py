"""Bodies that go round: vehicles in circles, walkers on laps; and to and fro: swings.

Positions and attitudes in closed form, rates and accelerations from their differences: the truth is
exact to 1e-6 rad/s and 1e-3 m/s^2, less than any sensor's noise.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.simulation.rotation import GRAVITY, smooth_step

_TURN_STEP, _PLACE_STEP = 1e-4, 2e-3   # s, of the differences
_FADE = 4.0                            # s, in which a body gets going


def waves(seed: int, lowest: float, highest: float, count: int = 5) -> "_Waves":
    """Three sums of sines (n, 3) of unit variance, frequencies in Hz, as a function of t (n,)."""
    rng = np.random.default_rng(seed)
    return _Waves(2 * math.pi * rng.uniform(lowest, highest, (3, count)),
                  rng.uniform(0, 2 * math.pi, (3, count)), math.sqrt(2 / count))


@dataclass(frozen=True)
class _Waves:
    frequency: np.ndarray
    phase: np.ndarray
    amplitude: float

    def __call__(self, t: np.ndarray) -> np.ndarray:
        return self.amplitude * np.sin(self.frequency * t[:, None, None] + self.phase).sum(axis=-1)


def _gone(t, rest):
    """Seconds gone at full speed, (n,), and the share (n,) of it, after ``rest`` s."""
    s = np.clip((t - rest) / _FADE, 0.0, None)
    x = np.minimum(s, 1.0)
    # The integral of the smooth step x^3 (10 - 15 x + 6 x^2).
    return (_FADE * (x ** 4 * (2.5 - 3 * x + x * x) + s - x), smooth_step(t, rest, _FADE)[0])


class _Differences:
    """Truth of what has ``attitude(t)`` (a Rotation) and ``position(t)`` (n, 3)."""

    def truth(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """As of :meth:`imu_fusion.simulation.rotation.Tumbling.truth`."""
        t, h = np.asarray(t), _PLACE_STEP
        turn = (self.attitude(t - _TURN_STEP).inv() * self.attitude(t + _TURN_STEP)).as_rotvec()
        place = self.position(t)
        return (self.attitude(t).as_quat(), turn / (2.0 * _TURN_STEP), place,
                (self.position(t + h) - 2.0 * place + self.position(t - h)) / h ** 2)

    def attitude(self, t: np.ndarray) -> Rotation:
        """From imu to world axes."""
        raise NotImplementedError

    def position(self, t: np.ndarray) -> np.ndarray:
        """m, world axes."""
        raise NotImplementedError


@dataclass(frozen=True)
class Circles(_Differences):
    """At rest, then circles at a steady rate, with some swaying.

    seed: of swaying and mounting. radius: m; rate: rad/s, positive to the left; leans: into the
    circle as a scooter does, so that the force stays in its plane of symmetry, or level as a cart;
    sway: rad per axis, .3 to 1.5 Hz; rest: s.
    """

    seed: int
    radius: float = 2.0
    rate: float = 1.0
    leans: bool = False
    sway: float = 0.03
    rest: float = 3.0

    def attitude(self, t: np.ndarray) -> Rotation:
        """From imu to world axes."""
        gone, share = _gone(t, self.rest)
        inwards = (self.rate * share) ** 2 * self.radius * np.sign(self.rate)
        lean = -np.arctan2(inwards, GRAVITY) * self.leans
        sway = self.sway * share[:, None] * waves(self.seed, 0.3, 1.5)(t)
        return (Rotation.from_euler("ZX", np.column_stack([self.rate * gone, lean]))
                * Rotation.from_rotvec(sway) * Rotation.random(random_state=self.seed))

    def position(self, t: np.ndarray) -> np.ndarray:
        """m, world axes."""
        angle = self.rate * _gone(t, self.rest)[0]
        return self.radius * np.sign(self.rate) * np.column_stack(
            [np.sin(angle), -np.cos(angle), 0.0 * t])


@dataclass(frozen=True)
class Walk(_Differences):
    """At rest, then a walker's laps of a room, who swings what he holds and changes its pose.

    seed: of swinging and mounting. radius: m; speed: m/s; steps: Hz; swing: rad per axis, .7 to
    1.1 Hz; pose: rad per axis, .02 to .08 Hz; rest: s.
    """

    seed: int
    radius: float = 2.0
    speed: float = 1.2
    steps: float = 1.8
    swing: float = 0.3
    pose: float = 0.4
    rest: float = 3.0

    def attitude(self, t: np.ndarray) -> Rotation:
        """From imu to world axes."""
        gone, share = _gone(t, self.rest)
        turn = (self.swing * waves(self.seed, 0.7, 1.1)(t)
                + self.pose * waves(self.seed + 1, 0.02, 0.08)(t)) * share[:, None]
        lap = self.speed / self.radius * gone[:, None] * [0.0, 0.0, 1.0]
        return (Rotation.from_rotvec(lap) * Rotation.from_rotvec(turn)
                * Rotation.random(random_state=self.seed))

    def position(self, t: np.ndarray) -> np.ndarray:
        """m, world axes."""
        gone, share = _gone(t, self.rest)
        angle, step = self.speed / self.radius * gone, 2 * math.pi * self.steps * t
        radius = self.radius + 0.03 * share * np.sin(0.5 * step)
        return np.column_stack([radius * np.cos(angle), radius * np.sin(angle),
                                0.035 * share * np.sin(step)])


@dataclass(frozen=True)
class Swing(_Differences):
    """At rest, then to and fro on a swing, whose seat twists a little: the force is along its rope.

    seed: of heading, twisting and mounting. rope: m; angle: rad, how far it swings, once it does so
    after half a minute; twist: rad, .03 to .1 Hz; rest: s.
    """

    seed: int
    rope: float = 2.5
    angle: float = 0.9
    twist: float = 0.25
    rest: float = 3.0

    def _parts(self, t):
        """Angles of rope and seat, (n,) rad, and the heading of the swing."""
        angle = (self.angle * smooth_step(t, self.rest, 25.0)[0]
                 * np.sin(math.sqrt(GRAVITY / self.rope) * t))
        twist = (self.twist * smooth_step(t, self.rest, _FADE)[0]
                 * waves(self.seed, 0.03, 0.1)(t)[:, 2])
        heading = np.random.default_rng(self.seed).uniform(0.0, 2.0 * math.pi)
        return angle, twist, Rotation.from_euler("Z", heading)

    def attitude(self, t: np.ndarray) -> Rotation:
        """From imu to world axes."""
        angle, twist, heading = self._parts(t)
        return (heading * Rotation.from_euler("YZ", np.column_stack([-angle, twist]))
                * Rotation.random(random_state=self.seed))

    def position(self, t: np.ndarray) -> np.ndarray:
        """m, world axes."""
        angle, _, heading = self._parts(t)
        return heading.apply(self.rope * np.column_stack([np.sin(angle), 0.0 * t, -np.cos(angle)]))
