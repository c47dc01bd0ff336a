"""A rigid ellipsoid falls on an elastic half-space: Rahaman 2019, section 4.1 and appendix B.

The simulation gives the motion of a rigid body with violent, smooth impacts, exact to the
integration step, and the readings of virtual accelerometers at any of its points. Quantities
are per unit mass. Body coordinates are the reference coordinates of the paper: the origin lies
``height`` below the centre of the ellipsoid.

The paper does not print the mass, the step, or the height of the half-space. The defaults of
:class:`ImpactScene` reproduce its Table 1 (see benchmarks/acceleration_field_table1).
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from imu_fusion.errors import EstimationError
from imu_fusion.geometry.rotation import (
    quat_exp,
    quat_multiply,
    quat_normalize,
    quat_rotate,
    quat_rotate_inverse,
)
from imu_fusion.kernels import njit

# Ratio of curvatures below which an ellipsoid is a blade: outside the table of the contact law.
_SMALLEST_RATIO = 1e-3


@dataclass(frozen=True)
class ImpactScene:
    """The body, the half-space and the start (Rahaman 2019, fig. 4 and 5).

    Lengths m, mass kg, modulus Pa, velocities m/s and rad/s (body axes).
    """

    semi_axes: tuple = (0.15, 0.10, 0.08)
    height: float = 0.75
    mass: float = 6.5
    modulus: float = 1e4
    poisson: float = 0.3
    ground: float = -0.57
    gravity: float = 9.8
    position: tuple = (0.0, 0.0, 0.75)
    velocity: tuple = (0.75, 0.0, 0.0)
    quat: tuple = (0.0, 0.0, 0.0, 1.0)
    omega: tuple = (5.0, 5.0, 5.0)


# Fig. 4: four accelerometers and the particle whose acceleration Table 1 compares.
PAPER_POSITIONS = np.array([[0, 0, 0.83], [0, 0.10, 0.75], [0.15, 0, 0.75], [-0.15, 0, 0.75]])
PAPER_PARTICLE = np.array([0.0, 0.0, 0.67])
# Signs of the sensor axes along the body axes: which the paper has is not printed.
PAPER_AXES = np.array([np.diag(s) for s in
                       ([1, -1, 1], [1, 1, -1], [1, 1, 1], [1, -1, -1])], dtype=float)


@dataclass(frozen=True)
class RigidMotion:
    """Truth of a simulated motion, n rows.

    ``t`` s; ``quat`` (n, 4) world from body; ``omega``, ``alpha`` (n, 3) rad/s, rad/s^2 in body
    axes; ``acc_origin`` (n, 3) kinematic acceleration of the body origin in body axes, m/s^2;
    ``position`` (n, 3) m and ``velocity`` (n, 3) m/s of the centre of mass in the world;
    ``gravity`` m/s^2.
    """

    t: np.ndarray
    quat: np.ndarray
    omega: np.ndarray
    alpha: np.ndarray
    acc_origin: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    gravity: float

    @property
    def stamp(self) -> np.ndarray:
        """Stamps, int64 ns."""
        return np.round(self.t * 1e9).astype(np.int64)

    def acceleration_body(self, point: ArrayLike) -> np.ndarray:
        """Kinematic acceleration (n, 3) of a body point (3,), body axes (eq. B.13)."""
        point = np.asarray(point, dtype=float)
        return (self.acc_origin + np.cross(self.alpha, point)
                + np.cross(self.omega, np.cross(self.omega, point)))

    def acceleration_world(self, point: ArrayLike) -> np.ndarray:
        """The same in world axes."""
        return _to_world(self.quat, self.acceleration_body(point))

    def specific_force_body(self, point: ArrayLike) -> np.ndarray:
        """What a real accelerometer at the point feels: kinematic acceleration minus gravity."""
        up = np.array([0.0, 0.0, self.gravity])
        return self.acceleration_body(point) + _to_body(self.quat, up)

    def readings(self, positions: np.ndarray, axes: np.ndarray,
                 reports: str = "specific_force") -> np.ndarray:
        """Noise-free readings (n, N, 3) of accelerometers (eq. B.14).

        Args:
            positions: (N, 3) m.
            axes: (N, 3, 3), rows are the sensor axes in body coordinates.
            reports: ``specific_force`` or ``acceleration``.
        """
        field = self.specific_force_body if reports == "specific_force" else self.acceleration_body
        return np.stack([field(p) @ a.T for p, a in zip(positions, axes)], axis=1)


@njit
def _to_world(quat, v):
    out = np.empty_like(v)
    for i in range(len(v)):
        out[i] = quat_rotate(quat[i], v[i])
    return out


@njit
def _to_body(quat, v):
    out = np.empty((len(quat), 3))
    for i in range(len(quat)):
        out[i] = quat_rotate_inverse(quat[i], v)
    return out


def contact_shape_factor(ratio: float) -> float:
    """``sqrt(D(k') / K(k')^3)`` of eq. (B.9) for the ratio of principal curvatures.

    Solves eq. (B.10) for the modulus. ``ratio`` is the smaller curvature over the larger one,
    in (0, 1]; a sphere (1) gives ``sqrt(2) / pi``.
    """
    def shape(k2):
        # scipy's elliptic integrals take the parameter m = k'^2 = 1 - k^2.
        m = 1.0 - k2
        big_k, big_e = ellipk(m), ellipe(m)
        d = np.pi / 4 if m < 1e-12 else (big_k - big_e) / m
        return k2 * d / (big_k - d), d, big_k

    if ratio >= 1.0:
        k2 = 1.0
    else:
        k2 = brentq(lambda s: shape(s)[0] - ratio, 1e-12, 1.0, xtol=1e-15, rtol=1e-14)
    _, d, big_k = shape(k2)
    return float(np.sqrt(d / big_k ** 3))


_TABLE: dict[str, Any] = {}


def _shape_table():
    """Knots and coefficients of a spline of the shape factor over log(ratio), made once."""
    if not _TABLE:
        knots = np.linspace(np.log(_SMALLEST_RATIO), 0.0, 400)
        spline = CubicSpline(knots, [contact_shape_factor(r) for r in np.exp(knots)])
        _TABLE["table"] = knots[0], knots[1] - knots[0], np.ascontiguousarray(spline.c.T)
    return _TABLE["table"]


class _Body(NamedTuple):
    """What does not change during the motion, in SI units."""

    inertia: np.ndarray        # (3,) per unit mass, about the centre
    r_ref: np.ndarray          # (3,) the centre in body coordinates
    axes2: np.ndarray          # (3,) semi axes squared
    ground: float
    gravity: float
    stiffness: float           # of the contact, per unit mass, without its shape factor
    knot0: float               # of the spline of the shape factor, see _shape_table
    knot_step: float
    coefficients: np.ndarray


@njit
def _specific_load(r, q, body):
    """Force (world) and torque about the centre (body) per unit mass, eq. (B.8)-(B.10)."""
    axes2 = body.axes2
    up = np.array(quat_rotate_inverse(q, (0.0, 0.0, 1.0)))
    scaled = axes2 * up
    support = np.sqrt(np.sum(scaled * up))
    force = np.array([0.0, 0.0, -body.gravity])
    torque = np.zeros(3)
    gap = r[2] - support - body.ground
    if gap < 0.0:
        # Principal radii at the lowest point: eigenvalues of the Hessian of the support function.
        half_sum = 0.5 * (np.sum(axes2) - np.sum(scaled * scaled) / support ** 2) / support
        product = axes2[0] * axes2[1] * axes2[2] / support ** 4
        root = np.sqrt(max(half_sum ** 2 - product, 0.0))
        ratio = (half_sum - root) / (half_sum + root)
        u = min(max((np.log(ratio) - body.knot0) / body.knot_step, 0.0),
                len(body.coefficients) - 1e-9)
        i = int(u)
        s = (u - i) * body.knot_step
        c = body.coefficients[i]
        factor = ((c[0] * s + c[1]) * s + c[2]) * s + c[3]
        load = body.stiffness * factor * np.sqrt(half_sum + root) * (-gap) ** 1.5
        force[2] += load
        torque = np.cross(-scaled / support, load * up)
    return force, torque


@njit
def _integrate(n, every, h, r, v, q, w, body, out):
    """Explicit Lie-Stoermer-Verlet, eq. (B.2)-(B.7); one row of ``out`` every ``every`` of n
    steps of h s. r, v: (3,) position and velocity, world; q: (4,) is changed; w: (3,) body."""
    inertia = body.inertia
    force, torque = _specific_load(r, q, body)
    for step in range(n):
        if step % every == 0:
            row = out[step // every]
            alpha = (torque - np.cross(w, inertia * w)) / inertia
            origin = (np.array(quat_rotate_inverse(q, force)) - np.cross(alpha, body.r_ref)
                      - np.cross(w, np.cross(w, body.r_ref)))
            row[0:4] = q
            row[4:7] = w
            row[7:10] = alpha
            row[10:13] = origin
            row[13:16] = r
            row[16:19] = v
        v_half = v + 0.5 * h * force
        momentum = inertia * w + 0.5 * h * torque
        w_half = np.array(quat_rotate(quat_exp(w, -0.5 * h), momentum)) / inertia
        turn = h * w_half
        r = r + h * v_half
        q[:] = quat_normalize(quat_multiply(q, quat_exp(turn)))
        force, torque = _specific_load(r, q, body)
        v = v_half + 0.5 * h * force
        w = (np.array(quat_rotate(quat_exp(turn, -1.0), momentum)) + 0.5 * h * torque) / inertia


def simulate(scene: ImpactScene = ImpactScene(), duration: float = 1.0, step: float = 1e-5,
             every: int = 100) -> RigidMotion:
    """Simulate the fall and its impacts.

    Args:
        scene: an ImpactScene.
        duration: s.
        step: integration step, s. The scheme is of second order.
        every: a row of the result each so many steps.

    Returns:
        RigidMotion with rows at multiples of ``step * every`` up to ``duration`` inclusive.

    Raises:
        EstimationError: the body became so thin at the contact that Hertz' law has no meaning.
    """
    axes2 = np.square(np.array(scene.semi_axes, dtype=float))
    smallest, middle, largest = np.sort(axes2)
    if smallest / largest * np.sqrt(smallest / middle) < _SMALLEST_RATIO:
        raise EstimationError(f"impact simulation: semi axes {scene.semi_axes} are too unequal for "
                              "the Hertz contact; make them less so")
    inertia = (np.sum(axes2) - axes2) / 5.0
    stiffness = (2 ** 1.5 * np.pi / (3 * scene.mass) * scene.modulus / (1 - scene.poisson ** 2))
    rows = int(round(duration / (step * every))) + 1
    out = np.empty((rows, 19))
    body = _Body(inertia, np.array([0.0, 0.0, scene.height]), axes2, float(scene.ground),
                 float(scene.gravity), float(stiffness), *_shape_table())
    _integrate((rows - 1) * every + 1, every, step, *(np.array(v, dtype=float) for v in (
        scene.position, scene.velocity, scene.quat, scene.omega)), body, out)
    return RigidMotion(t=np.arange(rows) * (step * every), quat=out[:, 0:4], omega=out[:, 4:7],
                       alpha=out[:, 7:10], acc_origin=out[:, 10:13], position=out[:, 13:16],
                       velocity=out[:, 16:19], gravity=scene.gravity)
