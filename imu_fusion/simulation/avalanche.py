"""A ball in a snow avalanche, with exact truth: Winkler 2025, sections 2, 3 and 4.2.

The ball is a mass on terrain, moved by gravity, the snow below it (a damped spring along the normal
that begins without a step, so that impacts are rounded over ``impact_time``), what the flow drags
along the slope, and smooth pulses: the entrainment, the throw into the air, jerks of the flow. Its
spin follows pulses, too, and in the last phase the rolling. All of it is integrated by steps of
1/6000 s; nothing is shared with the estimators.

Time is that since the entrainment. The phases are the paper's (section 3.2): 0 rest, 1 entrainment,
2 ballistic flight, 3 impact, 4 steady flow with saltation, 5 rolling, 6 rest.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from imu_fusion.errors import EstimationError
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.geometry.gravity import earth_rate_world, gravity_world, normal_gravity
from imu_fusion.geometry.rotation import (
    quat_exp,
    quat_multiply,
    quat_normalize,
    quat_rotate,
)
from imu_fusion.kernels import njit
from imu_fusion.parameters.declare import Parameters, param

#: The test site (section 2), with a height of the upper track.
FLUELA = LocalFrame(46.748621, 9.945134, 2600.0)
#: Rows of the truth per second: ten for each sample of the paper's sensors.
ROWS_PER_SECOND = 1500
_STEPS = 4               # of the integration from row to row
_SPIN_TIME = 0.35        # s, in which snow takes the spin along
_AXLE_RATE = 1.0         # rad/s, at which a rolling ball's axle turns into the horizontal
_DAMPING = 0.3           # of the contact, relative to critical
_ROLL = 15.5             # s, when the ball leaves the flow
_LETTING_GO = 0.05       # s, in which the flow does so
_END = 70.0              # s, when it has about stopped

# Columns: time (s), speed (m/s) of what drags the ball, and how fast it does (1/s), spin (rad/s)
# about the contour line that the snow gives it, share of rolling. Linear in between.
_SCHEDULE = np.array([
    [0.0, 16.0, 0.0, 0.0, 0.0],
    [0.3, 16.0, 0.3, 5.0, 0.0],
    [3.2, 14.0, 1.0, 5.0, 0.0],
    [3.6, 13.5, 1.0, 1.5, 0.0],
    [9.0, 11.5, 1.0, 1.5, 0.0],
    [_ROLL, 9.5, 1.0, 1.5, 0.0],
    [_ROLL + _LETTING_GO, 10.5, 1.5, 0.0, 1.0],
    [20.0, 10.5, 1.5, 0.0, 1.0],
    [25.0, 8.5, 1.5, 0.0, 1.0],
    [30.0, 4.5, 1.5, 0.0, 1.0],
    [52.0, 2.5, 1.5, 0.0, 1.0],
    [_END - 2.5, 0.5, 3.0, 0.0, 1.0],
    [_END - 1.5, 0.0, 25.0, 0.0, 1.0],
])
# Entrainment: start, duration (s), change of velocity (m/s) along slope, contour line and normal,
# change of spin (rad/s) about them. The last one throws the ball.
_ENTRAINMENT = np.array([
    [0.0, 0.62, 10.5, 0.0, 0.0, 0.0, 0.0, 0.0],
    [0.2, 0.42, 5.0, 0.1, 5.6, 1.0, 46.0, -1.0],
])


@dataclass(frozen=True)
class AvalancheParams(Parameters):
    """The slope and the ball."""

    slope_deg: float = param(32.0, doc="Inclination of the plane", unit="deg", low=5, high=60)
    aspect_deg: float = param(45.0, doc="Its aspect, clockwise from north", unit="deg")
    hump_height: float = param(0.0, doc="Height of a round hump on the plane: a convexity of the "
                               "terrain", unit="m", low=0, high=20)
    hump_distance: float = param(60.0, doc="Its horizontal distance from the start", unit="m")
    hump_width: float = param(25.0, doc="Its standard width (Gaussian)", unit="m", low=5)
    rest: float = param(10.0, doc="Rest before the entrainment and after the stop", unit="s",
                        low=1)
    radius: float = param(0.08, doc="Of the ball", unit="m", low=0.02)
    rolling_radius: float = param(0.3, doc="With the snow that it collects while it rolls",
                                  unit="m", low=0.05)
    impact_time: float = param(0.1, doc="Half the period of the ball on the snow below it: how "
                               "long an impact lasts at least", unit="s", low=0.005)
    jerk: float = param(0.5, doc="Standard deviation of the change of velocity by one jerk of the "
                        "flow, of which there are five per second", unit="m/s", low=0)
    spin_jerk: float = param(2.0, doc="The same of the spin", unit="rad/s", low=0)


@dataclass(frozen=True)
class Phase:
    """Phase ``number`` of section 3.2, from ``start`` (s since the entrainment) on."""

    number: int
    start: float


@dataclass(frozen=True)
class BallMotion:
    """Truth at ``time`` (n,) s since the entrainment, of the ball's centre.

    ``position``, ``vel`` (n, 3) world; ``quat`` (n, 4) world from ball; ``omega``, ``alpha``
    (n, 3) rad/s, rad/s^2 against the world, ``force`` (n, 3) specific force, all in the ball's
    axes. ``phases`` from the forces that acted, not from signals.
    """

    time: np.ndarray
    position: np.ndarray
    vel: np.ndarray
    quat: np.ndarray
    omega: np.ndarray
    alpha: np.ndarray
    force: np.ndarray
    phases: tuple[Phase, ...]

    def specific_force(self, point: ArrayLike) -> np.ndarray:
        """(n, 3) at a point (3,) m of the ball, in its axes: what moves with the ball feels the
        angular acceleration and the centripetal one."""
        arm = np.asarray(point, dtype=float)
        return (self.force + np.cross(self.alpha, arm)
                + np.cross(self.omega, np.cross(self.omega, arm)))

    def position_of(self, point: ArrayLike) -> np.ndarray:
        """Positions (n, 3) of a point (3,) m of the ball."""
        return self.position + Rotation.from_quat(self.quat).apply(point)


class _Scene(NamedTuple):
    """What does not change during the motion."""

    terrain: np.ndarray     # (6,) fall line east, north; tan slope; hump height, distance, width
    gravity: float
    spin: np.ndarray        # (3,) of the Earth
    radius: float
    rolling_radius: float
    frequency: float        # of the contact, rad/s
    schedule: np.ndarray
    pulses: np.ndarray      # (m, 8) as _ENTRAINMENT, by start


@njit
def _elevation(terrain, east, north):
    """Height of the terrain and its derivatives to the east and the north."""
    de, dn, steep, height, distance, width = terrain
    along, across = de * east + dn * north, de * north - dn * east
    bump = height * np.exp(-0.5 * ((along - distance) ** 2 + across ** 2) / width ** 2)
    # The hump is taken off at the start, so that the terrain passes through it.
    first = height * np.exp(-0.5 * distance ** 2 / width ** 2)
    d_along = -steep - bump * (along - distance) / width ** 2
    d_across = -bump * across / width ** 2
    return (-steep * along + bump - first, de * d_along - dn * d_across,
            dn * d_along + de * d_across)


@njit
def _frame(terrain, position):
    """Height (m) above the terrain along its normal, and the slope frame there as columns: down
    the slope, along the contour line, normal."""
    z, de, dn = _elevation(terrain, position[0], position[1])
    length = np.sqrt(1.0 + de * de + dn * dn)
    normal = np.array([-de, -dn, 1.0]) / length
    lateral = np.array([-terrain[1], terrain[0], 0.0])
    down = np.cross(lateral, normal)
    down /= np.sqrt(np.sum(down * down))
    axes = np.empty((3, 3))
    axes[:, 0], axes[:, 1], axes[:, 2] = down, np.cross(normal, down), normal
    return (position[2] - z) / length, axes


@njit
def _scheduled(schedule, t, out):
    """Interpolate the schedule's columns 1 to 4 at t into out (4,)."""
    k = 0
    while k < len(schedule) - 2 and t >= schedule[k + 1, 0]:
        k += 1
    a, b = schedule[k], schedule[k + 1]
    share = min(max((t - a[0]) / (b[0] - a[0]), 0.0), 1.0)
    for i in range(4):
        out[i] = a[1 + i] + share * (b[1 + i] - a[1 + i])


@njit
def _loads(t, position, vel, spin, quat, scene, first, out):
    """Specific force (out[0]), change of the spin (out[1]) and angular velocity (out[2]), (3,) in
    world axes: the spin, and the turning of a rolling ball's axle into the horizontal. Whether
    anything but gravity acts. first: index of the earliest pulse that can still act."""
    height, axes = _frame(scene.terrain, position)
    down, lateral, normal = axes[:, 0], axes[:, 1], axes[:, 2]
    flow = np.empty(4)
    _scheduled(scene.schedule, t, flow)
    gravity = gravity_world(position, scene.gravity)
    load = -np.sum(gravity * normal)
    deep = scene.radius - height
    contact = 0.0
    if deep > 0.0:
        rate = -np.sum(vel * normal)
        # Damping grows with the depth: an impact begins without a step.
        damping = 2.0 * _DAMPING * scene.frequency * deep / (
            deep + load / scene.frequency ** 2)
        contact = max(scene.frequency ** 2 * deep + damping * rate, 0.0)
    along = gravity + load * normal
    slip = vel - np.sum(vel * normal) * normal
    # What rubs is proportional to what presses: at rest it holds the ball on the slope.
    out[0] = contact * normal + contact / load * (flow[1] * (flow[0] * down - slip) - along)
    speed = np.sum(slip * down)
    wanted = ((1.0 - flow[3]) * flow[2] + flow[3] * speed / scene.rolling_radius) * lateral
    out[1] = (wanted - spin) / _SPIN_TIME
    axle = np.array(quat_rotate(quat, (0.0, 1.0, 0.0)))
    tilting = flow[3] * min(max(speed, 0.0), 1.0) * _AXLE_RATE
    out[2] = spin + tilting * np.cross(axle, lateral)
    acting = deep > 0.0
    for k in range(first, len(scene.pulses)):
        pulse = scene.pulses[k]
        if pulse[0] > t:
            break
        share = (t - pulse[0]) / pulse[1]
        if share < 1.0:
            acting = True
            rise = 2.0 / pulse[1] * np.sin(np.pi * share) ** 2
            for i in range(3):
                out[0] += rise * pulse[2 + i] * axes[:, i]
                out[1] += rise * pulse[5 + i] * axes[:, i]
    return acting


@njit
def _integrate(h, steps, state, scene, out):
    """Explicit midpoint rule from t = 0; a row every ``steps`` steps of h s.

    state: position, velocity, spin (9,) in world axes, quaternion (4,). Row: position, velocity,
    angular velocity, quaternion, specific force, whether anything but gravity acted.
    """
    position, vel, spin = state[0:3].copy(), state[3:6].copy(), state[6:9].copy()
    quat = state[9:13].copy()
    load, middle = np.empty((3, 3)), np.empty((3, 3))
    first = 0
    for n in range((len(out) - 1) * steps + 1):
        t = n * h
        while first < len(scene.pulses) and t > scene.pulses[first, 0] + 1.0:
            first += 1
        acting = _loads(t, position, vel, spin, quat, scene, first, load)
        if n % steps == 0:
            row = out[n // steps]
            row[0:3], row[3:6], row[6:9], row[9:13] = position, vel, load[2], quat
            row[13:16] = load[0]
            row[16] = 1.0 if acting else 0.0
        half = 0.5 * h
        acc = load[0] + gravity_world(position, scene.gravity) - 2.0 * np.cross(scene.spin, vel)
        p_mid, v_mid, s_mid = position + half * vel, vel + half * acc, spin + half * load[1]
        q_mid = np.array(quat_multiply(quat_exp(load[2], half), quat))
        _loads(t + half, p_mid, v_mid, s_mid, q_mid, scene, first, middle)
        acc = middle[0] + gravity_world(p_mid, scene.gravity) - 2.0 * np.cross(scene.spin, v_mid)
        position = position + h * v_mid
        vel = vel + h * acc
        spin = spin + h * middle[1]
        quat = np.array(quat_normalize(quat_multiply(quat_exp(middle[2], h), quat)))


def _draw_pulses(params, rng):
    """The entrainment and the jerks of the flow, sorted by start; few while the ball rolls."""
    rows = [_ENTRAINMENT]
    for begin, end, per_second, size in ((2.2, _ROLL - 0.3, 5.0, 1.0),
                                         (_ROLL + 3.0, 60.0, 0.4, 0.6)):
        count = int(per_second * (end - begin))
        jerk = np.empty((count, 8))
        jerk[:, 0] = np.sort(rng.uniform(begin, end, count))
        jerk[:, 1] = rng.uniform(0.05, 0.12, count)
        jerk[:, 2:5] = size * params.jerk * rng.standard_normal((count, 3)) * [1.0, 0.7, 1.2]
        jerk[:, 4] = np.abs(jerk[:, 4])     # snow below pushes up
        jerk[:, 5:8] = size * params.spin_jerk * rng.standard_normal((count, 3))
        rows.append(jerk)
    pulses = np.concatenate(rows)
    return pulses[np.argsort(pulses[:, 0], kind="stable")]


class Avalanche:
    """One avalanche, drawn by ``rng``; :attr:`motion` is the truth.

    Args:
        params: AvalancheParams.
        rng: numpy Generator: first attitude, jerks.
        origin: LocalFrame at the start, where the terrain's height is zero.

    Raises:
        EstimationError: the ball does not stay on the slope.
    """

    def __init__(self, params: AvalancheParams = AvalancheParams(),
                 rng: np.random.Generator | None = None, origin: LocalFrame = FLUELA) -> None:
        rng = np.random.default_rng(0) if rng is None else rng
        self.params, self.origin = params, origin
        aspect = np.radians(params.aspect_deg)
        self.gravity = normal_gravity(origin.latitude_deg, origin.height)
        self.earth_rate = earth_rate_world(origin.latitude_deg)
        frequency = np.pi / params.impact_time
        terrain = np.array([np.sin(aspect), np.cos(aspect), np.tan(np.radians(params.slope_deg)),
                            params.hump_height, params.hump_distance, params.hump_width])
        self._scene = _Scene(terrain, self.gravity, self.earth_rate, params.radius,
                             params.rolling_radius, frequency, _SCHEDULE,
                             _draw_pulses(params, rng))
        axes = _frame(terrain, np.zeros(3))[1]
        # Its weight presses the ball into the snow; the sensor's y lies about along the contour.
        deep = self.gravity * axes[2, 2] / frequency ** 2
        first = (Rotation.from_matrix(axes) * Rotation.from_euler("y", rng.uniform(-np.pi, np.pi))
                 * Rotation.from_rotvec(0.15 * rng.standard_normal(3)))
        state = np.concatenate([(params.radius - deep) * axes[:, 2], np.zeros(6),
                                first.as_quat()])
        moving = np.empty((int((_END + 2.0) * ROWS_PER_SECOND) + 1, 17))
        _integrate(1.0 / (ROWS_PER_SECOND * _STEPS), _STEPS, state, self._scene, moving)
        if not np.isfinite(moving).all() or np.linalg.norm(moving[-1, 3:6]) > 1e-3:
            raise EstimationError("the simulated ball does not come to rest: a flatter slope, a "
                                  "lower hump or softer snow")
        self.motion = self._motion(moving)

    def _motion(self, moving):
        """BallMotion of the integrated rows, with the rest before and after."""
        still = int(self.params.rest * ROWS_PER_SECOND)
        rows = np.concatenate([np.repeat(moving[:1], still, axis=0), moving,
                               np.repeat(moving[-1:], still, axis=0)])
        time = (np.arange(len(rows)) - still) / ROWS_PER_SECOND
        to_ball = Rotation.from_quat(rows[:, 9:13]).inv()
        omega = to_ball.apply(rows[:, 6:9])
        return BallMotion(time, rows[:, 0:3], rows[:, 3:6], rows[:, 9:13], omega,
                          np.gradient(omega, time, axis=0), to_ball.apply(rows[:, 13:16]),
                          self._phases(moving))

    def _phases(self, moving):
        """From what acted on the ball."""
        acting, at = moving[:, 16] > 0.0, np.arange(len(moving)) / ROWS_PER_SECOND
        flight = int(np.argmin(acting))
        impact = flight + int(np.argmax(acting[flight:]))
        # It is over when the snow no longer pushes more than at rest.
        force = np.linalg.norm(moving[impact:, 13:16], axis=1)
        peak = int(np.argmax(force[:ROWS_PER_SECOND // 4]))
        over = impact + peak + int(np.argmax(force[peak:] < self.gravity))
        still = (np.linalg.norm(moving[:, 3:6], axis=1) < 0.01) & (
            np.linalg.norm(moving[:, 6:9], axis=1) < 0.02)
        stop = len(still) - int(np.argmin(still[::-1]))
        return (Phase(0, -np.inf), Phase(1, 0.0), Phase(2, float(at[flight])),
                Phase(3, float(at[impact])), Phase(4, float(at[over])),
                Phase(5, _ROLL + 0.5 * _LETTING_GO),
                Phase(6, float(at[stop])))

    def elevation(self, east: ArrayLike, north: ArrayLike) -> np.ndarray:
        """Height (...) m of the terrain at places (...) m east and north of the start."""
        return np.asarray(_elevation(self._scene.terrain, np.asarray(east), np.asarray(north))[0])

    def slope_axes(self, position: ArrayLike = (0.0, 0.0, 0.0)) -> np.ndarray:
        """Slope frame (3, 3) at a position (3,): columns down the slope, along the contour line,
        normal to it, in world axes."""
        return _frame(self._scene.terrain, np.asarray(position, dtype=float))[1]
