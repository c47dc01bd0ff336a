"""A ski jump with exact truth: in-run, flight, landing and run-out on a given hill.

On the ground the skis follow the profile; their acceleration contains the profile's
curvature, so the motion is consistent to the tolerance of the integrator (1e-10).
The jumper pushes off above the table and sinks on landing: the sensor leaves the
profile by a known height near take-off and touch-down, and moves at random by some
centimetres against the skis on the ground.
"""

import copy
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from imu_fusion.errors import EstimationError
from imu_fusion.geometry.gravity import earth_rate_world, gravity_world, normal_gravity
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.surfaces.hill import Hill

_FADE = 0.8     # s, over which the wobble begins and ends
FASTEST_WOBBLE = 1.0  # Hz, of the sensor's random motion against the skis


def _sway(rng, sd):
    """A random band-limited motion of standard deviation ``sd``: a function from times (n,) to
    value, first and second derivative (3, n)."""
    count = 20
    w = 2.0 * np.pi * rng.uniform(0.0, FASTEST_WOBBLE, (count, 1))
    phase = rng.uniform(0.0, 2.0 * np.pi, (count, 1))
    amplitude = sd * np.sqrt(2.0 / count)

    def at(t):
        sine, cosine = np.sin(w * t + phase), np.cos(w * t + phase)
        return amplitude * np.stack([s.sum(axis=0) for s in (sine, w * cosine, -w * w * sine)])
    return at


def _fade(since):
    """0 at 0, 1 from ``_FADE`` on, twice differentiable; value and derivatives (3, n)."""
    s = np.clip(since / _FADE, 0.0, 1.0)
    return np.stack([s ** 3 * (10.0 - 15.0 * s + 6.0 * s * s),
                     30.0 * (s * (1.0 - s)) ** 2 / _FADE,
                     60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / _FADE ** 2])


def _step(t, at, width):
    """From 0 to 1 around ``at``, and its derivative."""
    s = np.tanh((t - at) / width)
    return 0.5 * (1.0 + s), 0.5 * (1.0 - s * s) / width


def _turned(joints):
    """Rotation and angular velocity (n, 3) in turned axes after (axis, angle, rate), each about
    an axis that the ones before have turned."""
    rotation, omega = Rotation.identity(), 0.0
    for axis, angle, rate in joints:
        unit = np.eye(3)[axis]
        joint = Rotation.from_rotvec(angle[:, None] * unit)
        rotation = rotation * joint
        omega = joint.inv().apply(omega * np.ones((len(angle), 3))) + rate[:, None] * unit
    return rotation, omega


def _product(f, g):
    """Value, first and second derivative (3, n) of a product."""
    return np.stack([f[0] * g[0], f[1] * g[0] + f[0] * g[1],
                     f[2] * g[0] + 2.0 * f[1] * g[1] + f[0] * g[2]])


@dataclass(frozen=True)
class JumpParams(Parameters):
    """How somebody jumps."""

    start_x: float = param(-78.0, doc="Start, hill frame", unit="m", high=-10)
    rest: float = param(5.0, doc="Time on the bar before the start", unit="s", low=0.5)
    friction: float = param(0.02, doc="Friction coefficient of the skis", low=0, high=0.2)
    drag_in_run: float = param(0.0011, doc="Drag over mass in the in-run", unit="1/m", low=0)
    drag: float = param(0.0038, doc="Drag over mass in flight", unit="1/m", low=0)
    lift: float = param(0.0056, doc="Lift over mass in flight", unit="1/m", low=0)
    push_speed: float = param(1.4, doc="Speed of the push-off, vertical", unit="m/s", low=0)
    push_duration: float = param(0.15, doc="Duration of the push-off", unit="s", low=0.05)
    sink_time: float = param(0.05, doc="Time constant of the knees on landing", unit="s",
                             low=0.01)
    braking: float = param(6.0, doc="Deceleration in the out-run", unit="m/s^2", low=1)
    # As much as a surface with sigma = 0.1 m allows for at 100 Hz, 0.1 m * sqrt(2 * 1 Hz / 100 Hz):
    # with equal densities of white rows and of a motion below FASTEST_WOBBLE.
    wobble: float = param(0.014, doc="Standard deviation of the sensor's random motion against "
                                     "the skis, up and sideways, while these are on the ground: "
                                     "knees, arms, snow", unit="m", low=0, high=0.2)
    drift: float = param(0.6, doc="Amplitude of the sideways motion after take-off", unit="m",
                         low=0)
    duration: float = param(27.0, doc="Length of the recording", unit="s", low=10)
    mount: tuple[float, ...] = param((0.0, 0.0, 0.0), doc="Rotation vector of the sensor on the "
                                     "arm; 0 as an armband holds it, x along the right upper arm "
                                     "to the elbow", unit="rad", length=3)


@dataclass(frozen=True)
class Motion:
    """Exact motion at ``time`` (n,) s; vectors (n, 3), quaternions (n, 4)."""

    time: np.ndarray
    position_world: np.ndarray
    vel_world: np.ndarray
    acc_world: np.ndarray
    quat_world_imu: np.ndarray
    omega_imu: np.ndarray


class SkiJump:
    """One jump on ``hill``; :meth:`at` evaluates it at any times.

    Attributes: ``t_start``, ``t_takeoff``, ``t_touchdown`` (s), ``x_touchdown`` (m) and
    ``length`` (m) of the jump.
    """

    def __init__(self, hill: Hill, params: JumpParams = JumpParams()):
        self.hill, self.params = hill, params
        self._sways = self._draw_sways(np.random.default_rng(0))
        self.gravity = normal_gravity(hill.origin.latitude_deg, hill.origin.height)
        self.t_start = params.rest
        options = dict(method="DOP853", rtol=1e-11, atol=1e-11, max_step=0.02, dense_output=True)

        def edge(t, y):
            return y[0]
        edge.terminal = True  # type: ignore[attr-defined]
        run = solve_ivp(self._ground(hill.in_run, params.drag_in_run, None),
                        (self.t_start, self.t_start + 60.0), [params.start_x, 0.0],
                        events=edge, **options)
        if run.status != 1:
            raise EstimationError(f"simulated jumper starting at {params.start_x} m never "
                                  "reaches the table: less friction or a higher start")
        self._run, self.t_takeoff = run.sol, run.t[-1]

        x, u = run.y[:, -1]
        z, slope, _ = hill.in_run(x)
        vx = u / np.hypot(1.0, slope)
        rise, rise_speed, _ = self._push(self.t_takeoff)

        def ground(t, y):
            return y[1] - hill.landing(y[0])[0] if t > self.t_takeoff + 0.3 else -1.0
        ground.terminal, ground.direction = True, 1  # type: ignore[attr-defined]
        flight = solve_ivp(self._flight, (self.t_takeoff, self.t_takeoff + 20.0),
                           [x, z - rise, vx, slope * vx - rise_speed], events=ground, **options)
        if flight.status != 1:
            raise EstimationError("simulated jumper does not come down: less lift")
        self._air, self.t_touchdown = flight.sol, flight.t[-1]
        x, z, vx, vz = flight.y[:, -1]
        slope = hill.landing(x)[1]
        self._sink_speed = vz - slope * vx
        self.x_touchdown, self.length = x, hill.jump_length(x)
        # Braking begins where the transition has become flat.
        self._brake_x = brentq(lambda x: hill.landing(x)[1] - 0.1, x, x + 200.0)
        end = max(params.duration, self.t_touchdown) + 1.0
        self._out = solve_ivp(self._ground(hill.landing, params.drag, self._brake_x),
                              (self.t_touchdown, end), [x, vx * np.hypot(1.0, slope)],
                              **options).sol

    def _ground(self, profile, drag, brake_x):
        """Right side for (x, speed along the profile)."""
        def derivative(t, y):
            x, u = y
            slope = profile(x)[1]
            cosine = 1.0 / np.hypot(1.0, slope)
            rate = (self.gravity * cosine * (slope - self.params.friction * np.tanh(u / 0.1))
                    - drag * u * u)
            if brake_x is not None:
                rate -= (self.params.braking * np.tanh(u) * 0.5
                         * (1.0 + np.tanh((x - brake_x) / 5.0)))
            return np.array([u * cosine, rate])
        return derivative

    def _flight(self, t, y):
        speed = np.hypot(y[2], y[3])
        drag, lift = self.params.drag * speed, self.params.lift * speed
        return np.array([y[2], y[3], -drag * y[2] + lift * y[3],
                         self.gravity - drag * y[3] - lift * y[2]])

    def _push(self, t):
        """Height above the table while pushing off, and its derivatives."""
        p = self.params
        s = np.clip((t - self.t_takeoff) / p.push_duration + 1.0, 0.0, 1.0)
        return np.stack([p.push_speed * p.push_duration * (s ** 3 - 0.5 * s ** 4),
                         p.push_speed * (3.0 * s ** 2 - 2.0 * s ** 3),
                         p.push_speed / p.push_duration * 6.0 * (s - s * s)])

    def _sink(self, t):
        """Height above the landing profile after touch-down (negative), and its derivatives."""
        tau = self.params.sink_time
        s = (t - self.t_touchdown) / tau
        decay = -self._sink_speed * np.exp(-s)
        return np.stack([decay * tau * (s + s * s), decay * (1.0 + s - s * s),
                         decay / tau * (s * s - 3.0 * s)])

    def _on_profile(self, t, state, derivative, profile, height):
        """x, z and derivatives on a profile, at a height above it."""
        x, u = state
        du = derivative(t, state)[1]
        z, slope, curvature = profile(x)
        cosine = 1.0 / np.hypot(1.0, slope)
        vx = u * cosine
        turn = curvature * cosine ** 2 * vx
        ax = du * cosine - u * slope * cosine * turn
        h, dh, ddh = height
        return (np.stack([x, z - h]), np.stack([vx, slope * vx - dh]),
                np.stack([ax, curvature * vx ** 2 + slope * ax - ddh]))

    def _section(self, t, wobble):
        """Position, velocity, acceleration (2, n) in the hill's long section, x and z, with the
        sensor's height (3, n) against the skis."""
        hill, p = self.hill, self.params
        pos, vel, acc = np.zeros((3, 2, len(t)))
        masks = [t < self.t_start, (t >= self.t_start) & (t < self.t_takeoff),
                 (t >= self.t_takeoff) & (t < self.t_touchdown), t >= self.t_touchdown]
        pos[:, masks[0]] = np.array([[p.start_x], [float(hill.in_run(p.start_x)[0])]])
        m = masks[1]
        if m.any():
            pos[:, m], vel[:, m], acc[:, m] = self._on_profile(
                t[m], self._run(t[m]), self._ground(hill.in_run, p.drag_in_run, None),
                hill.in_run, self._push(t[m]) + wobble[:, m])
        m = masks[2]
        if m.any():
            y = self._air(t[m])
            pos[:, m], vel[:, m] = y[:2], y[2:]
            acc[:, m] = self._flight(t[m], y)[2:]
        m = masks[3]
        if m.any():
            pos[:, m], vel[:, m], acc[:, m] = self._on_profile(
                t[m], self._out(t[m]), self._ground(hill.landing, p.drag, self._brake_x),
                hill.landing, self._sink(t[m]) + wobble[:, m])
        return pos, vel, acc

    def _wobble(self, t):
        """Motion of the sensor against the skis, up and sideways, with derivatives (2, 3, n):
        from the start to take-off and from touch-down on."""
        ground = np.zeros((3, len(t)))
        if self.params.wobble > 0.0:
            end = _fade(self.t_takeoff - t) * np.array([[1.0], [-1.0], [1.0]])
            ground = _product(_fade(t - self.t_start), end) + _fade(t - self.t_touchdown)
        return np.stack([_product(ground, sway(t)) for sway in self._sways])

    def shaken(self, rng: np.random.Generator) -> Self:
        """The same jump with another random motion of the sensor against the skis."""
        other = copy.copy(self)
        other._sways = self._draw_sways(rng)
        return other

    def _draw_sways(self, rng):
        return [_sway(rng, self.params.wobble) for _ in range(2)]

    def _slope(self, t, x, vx):
        """Inclination (downwards positive) of what the jumper is beside, and its rate: of the
        in-run, from there over the flight to that of the landing slope, as the path has it."""
        def inclination(profile, x, moving):
            _, slope, curvature = profile(x)
            return np.arctan(slope), np.where(moving, curvature * vx / (1.0 + slope ** 2), 0.0)

        middle = 0.5 * (self.t_takeoff + self.t_touchdown)
        share, change = _step(t, middle, (self.t_touchdown - self.t_takeoff) / 3.0)
        above, above_rate = inclination(self.hill.in_run, np.minimum(x, 0.0), x < 0.0)
        below, below_rate = inclination(self.hill.landing, np.maximum(x, self.x_touchdown),
                                        x > self.x_touchdown)
        return ((1.0 - share) * above + share * below,
                (1.0 - share) * above_rate + share * below_rate + change * (below - above))

    def _joints(self, t, x, vx):
        """Angles (rad) of the right upper arm and their rates, from the world to the arm, by
        the axis they turn about: 0 forward, 1 left, 2 up.

        The trunk's inclination is told from the normal of the slope. On the bar it is upright
        and the hands are beside the hips; in the in-run it lies along the skis with the arms
        beside it; in flight some 40 deg to the air; for landing it rises, the arms go sideways;
        in the out-run the arms sink and the jumper stands.
        """
        start, off, down = self.t_start, self.t_takeoff, self.t_touchdown

        def posture(first, *changes):
            """An angle that begins with ``first`` and changes by (change, at, width)."""
            steps = [change * np.stack(_step(t, at, width)) for change, at, width in changes]
            return first + sum(s[0] for s in steps), sum(s[1] for s in steps)

        def swing(amplitude, rate, phase):
            return np.stack([amplitude * np.sin(rate * t + phase),
                             amplitude * rate * np.cos(rate * t + phase)])

        stand = down + 2.5
        turn = posture(0.0, (0.5, stand, 0.6)) + swing(0.05, 2.3, 1.0)
        lean = (posture(-0.4, (1.83, start + 0.4, 0.3), (-0.73, off - 0.05, 0.12),
                        (0.25, off + 0.5, 0.3), (-0.7, down - 0.15, 0.2), (-0.3, stand, 0.6))
                + swing(0.05, 5.0, 0.3) + self._slope(t, x, vx))
        roll = swing(0.06, 3.1, 0.0)
        spread = posture(0.2, (-0.1, start + 0.4, 0.3), (1.3, down - 0.15, 0.15),
                         (-1.1, stand, 0.6))
        back = posture(0.25, (-0.1, start + 0.4, 0.3), (-0.15, down - 0.15, 0.15),
                       (0.1, stand, 0.6))
        heading = np.pi / 2 - np.radians(self.hill.azimuth_deg)
        return [(2, heading + turn[0], turn[1]), (1, *lean), (0, *roll),
                (0, -spread[0], -spread[1]), (1, back[0] + np.pi / 2, back[1])]

    def at(self, t: np.ndarray) -> Motion:
        """The :class:`Motion` at times t (n,) s since the beginning of the recording."""
        t = np.atleast_1d(np.asarray(t, dtype=float))
        wobble, sideways = self._wobble(t)
        pos, vel, acc = self._section(t, wobble)
        w, air = 0.5, np.maximum(t - self.t_takeoff, 0.0)
        side = self.params.drift * np.stack([1.0 - np.cos(w * air), w * np.sin(w * air),
                                             w * w * np.cos(w * air) * (air > 0)]) + sideways
        place, speed, push = (self.hill.to_world(np.stack([a[0], s, a[1]], axis=1))
                              for a, s in zip((pos, vel, acc), side))
        mount = Rotation.from_rotvec(self.params.mount)
        arm, omega_arm = _turned(self._joints(t, pos[0], vel[0]))
        return Motion(t, place, speed, push, (arm * mount).as_quat(),
                      mount.inv().apply(omega_arm))

    def specific_force(self, motion: Motion) -> np.ndarray:
        """Specific force (n, 3) in sensor axes, m/s^2, on the turning Earth."""
        g = np.array([gravity_world(p, self.gravity) for p in motion.position_world])
        spin = earth_rate_world(self.hill.origin.latitude_deg)
        force = motion.acc_world - g + 2.0 * np.cross(spin, motion.vel_world)
        return Rotation.from_quat(motion.quat_world_imu).inv().apply(force)

    def rate(self, motion: Motion) -> np.ndarray:
        """What an ideal gyroscope reads (n, 3), rad/s: the Earth's rotation included."""
        spin = earth_rate_world(self.hill.origin.latitude_deg)
        return motion.omega_imu + Rotation.from_quat(motion.quat_world_imu).inv().apply(spin)


class Fall(SkiJump):
    """A jump that ends in a fall: beginning 0.2 s after touch-down, the sensor comes down by 0.8 m
    within 0.5 s, for good."""

    def _sink(self, t):
        s = np.clip((t - self.t_touchdown - 0.2) / 0.5, 0.0, 1.0)
        return super()._sink(t) - 0.8 * np.stack([
            s ** 3 * (10 - 15 * s + 6 * s * s), 30 * (s * (1 - s)) ** 2 / 0.5,
            60 * s * (1 - s) * (1 - 2 * s) / 0.25])
