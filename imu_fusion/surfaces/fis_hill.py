"""The long section of a ski-jumping hill by the FIS norm (certificates since 2008).

Symbols are those of the certificate: in-run length e to the highest gate without the
table t, slopes gamma and alpha, transition radius r1; table height s; K point at (n, h)
and distance w; slopes beta_0 (foot of the table), beta_P, beta (at K), beta_L; radii
rL (P to L), r2L and r2 (L to U). The construction is that of the *Jumping Hills
Construction Norm* (Gasser; the reference of Fang et al. 2020, section 3.3.3), whose
constants were re-derived from the conditions of tangency and curvature.
"""

from dataclasses import dataclass

import numpy as np

from imu_fusion.errors import LayoutError
from imu_fusion.parameters import Parameters, param
from imu_fusion.surfaces.profile import (Arc, Line, Polynomial, Profile, TiltedCubic,
                                         TiltedParabola)


@dataclass(frozen=True)
class FisHill(Parameters):
    """Certificate of a hill; profiles in the hill frame (x forward, z down, m), whose
    origin is the edge of the take-off table."""

    w: float = param(95.0, doc="Distance of the K point", unit="m", low=10, high=300)
    h: float = param(44.93, doc="Drop from the table edge to K", unit="m", low=1, high=200)
    n: float = param(83.07, doc="Horizontal distance of K", unit="m", low=1, high=300)
    gamma_deg: float = param(35.0, doc="Slope of the straight in-run", unit="deg", low=1, high=60)
    alpha_deg: float = param(11.0, doc="Slope of the table", unit="deg", low=0, high=20)
    e: float = param(89.0, doc="In-run length from the highest gate to the table", unit="m",
                     low=5, high=200)
    es: float = param(20.7, doc="Distance from the highest to the lowest gate", unit="m",
                      low=0, high=100)
    gates: int = param(42, doc="Number of gates", low=1, high=200)
    t: float = param(6.5, doc="Length of the table", unit="m", low=1, high=20)
    r1: float = param(95.0, doc="Radius at the end of the in-run transition", unit="m", low=10,
                      high=500)
    s: float = param(2.2, doc="Height of the table", unit="m", low=0, high=10)
    beta0_deg: float | None = param(None, doc="Slope at the foot of the table; a sixth of "
                                    "beta_P when unset", unit="deg", low=-10, high=30)
    betaP_deg: float = param(37.0, doc="Slope at P", unit="deg", low=10, high=60)
    beta_deg: float = param(34.5, doc="Slope at K", unit="deg", low=10, high=60)
    betaL_deg: float = param(32.0, doc="Slope at L", unit="deg", low=10, high=60)
    rL: float = param(220.0, doc="Radius of the landing area, P to L", unit="m", low=10, high=2000)
    r2L: float = param(106.5, doc="Radius of the transition to the out-run at L", unit="m",
                       low=10, high=500)
    r2: float = param(106.5, doc="Radius of the transition to the out-run at its end, U",
                      unit="m", low=10, high=500)
    in_run_curve: str = param("cubic", doc="Curve between slope and table",
                              choices=("cubic", "circle"))
    out_run_curve: str = param("parabola", doc="Curve between L and the out-run",
                               choices=("parabola", "circle"))

    def __post_init__(self):
        super().__post_init__()
        if self.gamma_deg <= self.alpha_deg:
            raise LayoutError(f"hill: the slope gamma {self.gamma_deg} deg must exceed the "
                              f"table's {self.alpha_deg} deg")
        if not self.betaP_deg >= self.beta_deg >= self.betaL_deg:
            raise LayoutError("hill: slopes must fall from P over K to L, are "
                              f"{self.betaP_deg}, {self.beta_deg}, {self.betaL_deg} deg")

    def in_run(self):
        """Profile of the in-run (straight, transition, table), and its points E1, E2, A, B."""
        gamma, alpha = np.radians([self.gamma_deg, self.alpha_deg])
        delta = gamma - alpha
        e2 = -self.t * np.array([np.cos(alpha), np.sin(alpha)])
        down = np.array([np.cos(gamma), np.sin(gamma)])
        if self.in_run_curve == "cubic":
            # Curvature zero at E1 and 1/r1 at E2, where the slope has turned by delta.
            d = 2.0 * self.r1 * np.sin(delta) * np.cos(delta) ** 2
            c = np.tan(delta) / (3.0 * d * d)
            e1 = e2 - d * down - c * d ** 3 * np.array([np.sin(gamma), -np.cos(gamma)])
            curve = TiltedCubic(e1[0], e1[1], gamma, c)
            length = d * (1.0 + 0.1 * np.tan(delta) ** 2)
        else:
            curve = Arc(e2[0], e2[1], alpha, self.r1)
            e1 = np.array(curve.at_angle(gamma))
            length = self.r1 * delta
        profile = Profile([e1[0], e2[0]], [Line(e1[0], e1[1], np.tan(gamma)), curve,
                                           Line(0.0, 0.0, np.tan(alpha))])
        a = e1 - (self.e - length) * down
        return profile, {"E1": e1, "E2": e2, "A": a, "B": a + self.es * down}

    def gate(self, number):
        """Point (2,) of a start gate; gate 1 is the lowest, B, gate ``gates`` the highest, A."""
        if not 1 <= number <= self.gates:
            raise LayoutError(f"gate {number}: this hill has gates 1 to {self.gates}")
        points = self.in_run()[1]
        share = (number - 1) / max(self.gates - 1, 1)
        return points["B"] + share * (points["A"] - points["B"])

    def landing(self):
        """Profile of the landing side (knoll, landing area, transition, out-run), and its
        points P, K, L, U."""
        beta_p, beta_k, beta_l = np.radians([self.betaP_deg, self.beta_deg, self.betaL_deg])
        beta_0 = beta_p / 6.0 if self.beta0_deg is None else np.radians(self.beta0_deg)
        arc = Arc(self.n, self.h, beta_k, self.rL)
        xp, zp = arc.at_angle(beta_p)
        xl, zl = arc.at_angle(beta_l)
        u = zp - self.s - xp * np.tan(beta_0)
        v = xp * (np.tan(beta_p) - np.tan(beta_0))
        knoll = Polynomial(0.0, (self.s, np.tan(beta_0), (3.0 * u - v) / xp ** 2,
                                 (v - 2.0 * u) / xp ** 3))
        if self.out_run_curve == "parabola":
            ratio = np.cbrt(self.r2 / self.r2L)
            tilt = np.arctan((np.cos(beta_l) - ratio) / np.sin(beta_l))
            c = 1.0 / (2.0 * self.r2 * np.cos(tilt) ** 3)
            xi_l, xi_u = -np.tan(beta_l + tilt) / (2.0 * c), -np.tan(tilt) / (2.0 * c)
            curve = TiltedParabola(xl, zl, tilt, c, xi_l)
            (right_l, up_l), (right_u, up_u) = curve.offset(xi_l), curve.offset(xi_u)
            xu, zu = xl + right_u - right_l, zl - (up_u - up_l)
        else:
            curve = Arc(xl, zl, beta_l, self.r2)
            xu, zu = curve.at_angle(0.0)
        profile = Profile([0.0, xp, xl, xu], [Line(0.0, self.s, np.tan(beta_0)), knoll, arc,
                                              curve, Line(xu, zu, 0.0)])
        return profile, {"P": np.array([xp, zp]), "K": np.array([self.n, self.h]),
                         "L": np.array([xl, zl]), "U": np.array([xu, zu])}
