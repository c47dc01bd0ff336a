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
from imu_fusion.parameters.declare import Parameters, param
from imu_fusion.surfaces.profile import (
    Arc,
    Curve,
    Line,
    Polynomial,
    Profile,
    TiltedCubic,
    TiltedParabola,
)

#: The norm's w by the chord from the table edge to K, and what certificates may miss it by:
#: known ones do by up to 0.6 %, and w is rounded to whole metres.
W_BY_CHORD = 1.005
W_TOLERANCE, W_ROUNDING = 0.01, 0.5  # of w; m
#: What the knoll's slope may leave beta_0 to beta_P by: built hills do by up to 0.4 deg.
KNOLL_TOLERANCE_DEG = 2.0


@dataclass(frozen=True)
class FisHill(Parameters):
    """Certificate of a hill; profiles in the hill frame (x forward, z down, m), whose
    origin is the edge of the take-off table.

    Raises:
        ParameterError: a figure out of bounds.
        LayoutError: figures that contradict each other, or joints that do not fit.
    """

    w: float = param(doc="Distance of the K point", unit="m", low=10, high=300)
    h: float = param(doc="Drop from the table edge to K", unit="m", low=1, high=200)
    n: float = param(doc="Horizontal distance of K", unit="m", low=1, high=300)
    gamma_deg: float = param(doc="Slope of the straight in-run", unit="deg", low=1, high=60)
    alpha_deg: float = param(doc="Slope of the table", unit="deg", low=0, high=20)
    e: float = param(doc="In-run length from the highest gate to the table", unit="m",
                     low=5, high=200)
    t: float = param(doc="Length of the table", unit="m", low=1, high=20)
    r1: float = param(doc="Radius at the end of the in-run transition", unit="m", low=10,
                      high=500)
    s: float = param(doc="Height of the table", unit="m", low=0, high=10)
    betaP_deg: float = param(doc="Slope at P", unit="deg", low=10, high=60)
    beta_deg: float = param(doc="Slope at K", unit="deg", low=10, high=60)
    betaL_deg: float = param(doc="Slope at L", unit="deg", low=10, high=60)
    rL: float = param(doc="Radius of the landing area, P to L", unit="m", low=10, high=2000)
    r2: float = param(doc="Radius of the transition to the out-run at its end, U",
                      unit="m", low=10, high=500)
    r2L: float | None = param(None, doc="Radius of the transition to the out-run at L; needed "
                              "for a parabola, r2 for a circle", unit="m", low=10, high=500)
    beta0_deg: float | None = param(None, doc="Slope at the foot of the table; a sixth of "
                                    "beta_P when unset", unit="deg", low=-10, high=30)
    es: float | None = param(None, doc="Distance from the highest to the lowest gate; no "
                             "part of the profile", unit="m", low=0, high=100)
    gates: int | None = param(None, doc="Number of gates; no part of the profile", low=1,
                              high=200)
    in_run_curve: str = param("cubic", doc="Curve between slope and table",
                              choices=("cubic", "circle"))
    out_run_curve: str = param("parabola", doc="Curve between L and the out-run",
                               choices=("parabola", "circle"))

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_figures()
        self._check_profiles()

    def _check_figures(self):
        """Refuse figures of the certificate that contradict each other."""
        if self.gamma_deg <= self.alpha_deg:
            raise LayoutError(f"hill: the slope gamma {self.gamma_deg} deg must exceed the "
                              f"table's {self.alpha_deg} deg")
        if not self.betaP_deg >= self.beta_deg >= self.betaL_deg:
            raise LayoutError("hill: slopes must fall from P over K to L, are "
                              f"{self.betaP_deg}, {self.beta_deg}, {self.betaL_deg} deg")
        chord_w = W_BY_CHORD * np.hypot(self.h, self.n)
        if abs(chord_w - self.w) > max(W_TOLERANCE * self.w, W_ROUNDING):
            raise LayoutError(f"hill: h {self.h} m and n {self.n} m give w = {chord_w:.2f} m "
                              f"({W_BY_CHORD} of the chord), stated is {self.w} m")
        length = self._transition_length()
        if self.e <= length:
            raise LayoutError(f"hill: the in-run e {self.e} m is shorter than its transition to "
                              f"the table, {length:.1f} m by r1, gamma and alpha")
        if self.es is not None and self.es >= self.e:
            raise LayoutError(f"hill: the gates' range es {self.es} m must be less than the "
                              f"in-run e {self.e} m")
        if self.out_run_curve == "parabola":
            if self.r2L is None:
                raise LayoutError("hill: r2L is missing; only out_run_curve: circle needs none")
            if self.r2L > self.rL:
                raise LayoutError(f"hill: at joint L the transition must bend more than the "
                                  f"landing area, r2L {self.r2L} m exceeds rL {self.rL} m")
        elif self.r2L not in (None, self.r2):
            raise LayoutError(f"hill: a circle from L to U has one radius, r2L {self.r2L} m and "
                              f"r2 {self.r2} m are stated")

    def _check_profiles(self):
        """Refuse joints with a gap, a kink or another radius, and a knoll that is none."""
        curve, end = (np.inf, self.r1) if self.in_run_curve == "cubic" else (self.r1, self.r1)
        self.in_run()[0].check_joints(["E1", "E2"], {"E1": (np.inf, curve),
                                                     "E2": (end, np.inf)})
        landing, points = self.landing()
        after = self.r2L if self.out_run_curve == "parabola" else self.r2
        landing.check_joints(["foot", "P", "L", "U"], {
            "foot": (np.inf, None), "P": (None, self.rL), "L": (self.rL, after),
            "U": (self.r2, np.inf)})
        # The other pieces turn one way by construction.
        x = np.linspace(0.0, points["P"][0], 201)[1:-1]
        slope = np.degrees(np.arctan(landing(x)[1]))
        low, high = self._beta0_deg() - KNOLL_TOLERANCE_DEG, self.betaP_deg + KNOLL_TOLERANCE_DEG
        if slope.min() < low or slope.max() > high:
            raise LayoutError(
                f"hill: between the foot (s {self.s} m, {self._beta0_deg():.2f} deg) and P "
                f"({self.betaP_deg} deg) the knoll must steepen steadily, but its slope runs "
                f"from {slope.min():.1f} to {slope.max():.1f} deg: s, h, n or slopes are wrong")

    def _beta0_deg(self):
        return self.betaP_deg / 6.0 if self.beta0_deg is None else self.beta0_deg

    def _transition_length(self):
        """Length of the in-run's transition, E1 to E2, m."""
        delta = np.radians(self.gamma_deg - self.alpha_deg)
        if self.in_run_curve == "circle":
            return self.r1 * delta
        d = 2.0 * self.r1 * np.sin(delta) * np.cos(delta) ** 2
        return d * (1.0 + 0.1 * np.tan(delta) ** 2)

    def in_run(self) -> tuple[Profile, dict[str, np.ndarray]]:
        """Profile of the in-run (straight, transition, table), and its points E1, E2, A and,
        where es is given, B."""
        gamma, alpha = np.radians([self.gamma_deg, self.alpha_deg])
        delta = gamma - alpha
        e2 = -self.t * np.array([np.cos(alpha), np.sin(alpha)])
        down = np.array([np.cos(gamma), np.sin(gamma)])
        if self.in_run_curve == "cubic":
            # Curvature zero at E1 and 1/r1 at E2, where the slope has turned by delta.
            d = 2.0 * self.r1 * np.sin(delta) * np.cos(delta) ** 2
            c = np.tan(delta) / (3.0 * d * d)
            e1 = e2 - d * down - c * d ** 3 * np.array([np.sin(gamma), -np.cos(gamma)])
            curve: Curve = TiltedCubic(e1[0], e1[1], gamma, c)
        else:
            arc = Arc(e2[0], e2[1], alpha, self.r1)
            e1, curve = np.array(arc.at_angle(gamma)), arc
        profile = Profile([e1[0], e2[0]], [Line(e1[0], e1[1], np.tan(gamma)), curve,
                                           Line(0.0, 0.0, np.tan(alpha))])
        a = e1 - (self.e - self._transition_length()) * down
        points = {"E1": e1, "E2": e2, "A": a}
        if self.es is not None:
            points["B"] = a + self.es * down
        return profile, points

    def gate(self, number: int) -> np.ndarray:
        """Point (2,) of a start gate; gate 1 is the lowest, B, gate ``gates`` the highest, A."""
        if self.es is None or self.gates is None:
            raise LayoutError("hill: start gates need es and gates of the certificate")
        if not 1 <= number <= self.gates:
            raise LayoutError(f"gate {number}: this hill has gates 1 to {self.gates}")
        points = self.in_run()[1]
        share = (number - 1) / max(self.gates - 1, 1)
        return points["B"] + share * (points["A"] - points["B"])

    def landing(self) -> tuple[Profile, dict[str, np.ndarray]]:
        """Profile of the landing side (knoll, landing area, transition, out-run), and its
        points P, K, L, U."""
        beta_p, beta_k, beta_l = np.radians([self.betaP_deg, self.beta_deg, self.betaL_deg])
        beta_0 = np.radians(self._beta0_deg())
        arc = Arc(self.n, self.h, beta_k, self.rL)
        xp, zp = arc.at_angle(beta_p)
        xl, zl = arc.at_angle(beta_l)
        if not 0.0 < xp < xl:
            raise LayoutError(f"hill: P (x = {xp:.2f} m) must lie between the table and L "
                              f"(x = {xl:.2f} m): rL or the slopes at P, K and L are wrong")
        u = zp - self.s - xp * np.tan(beta_0)
        v = xp * (np.tan(beta_p) - np.tan(beta_0))
        knoll = Polynomial(0.0, (self.s, np.tan(beta_0), (3.0 * u - v) / xp ** 2,
                                 (v - 2.0 * u) / xp ** 3))
        if self.out_run_curve == "parabola" and self.r2L is not None:
            ratio = np.cbrt(self.r2 / self.r2L)
            tilt = np.arctan((np.cos(beta_l) - ratio) / np.sin(beta_l))
            c = 1.0 / (2.0 * self.r2 * np.cos(tilt) ** 3)
            xi_l, xi_u = -np.tan(beta_l + tilt) / (2.0 * c), -np.tan(tilt) / (2.0 * c)
            parabola = TiltedParabola(xl, zl, tilt, c, xi_l)
            (right_l, up_l), (right_u, up_u) = parabola.offset(xi_l), parabola.offset(xi_u)
            curve: Curve = parabola
            xu, zu = xl + right_u - right_l, zl - (up_u - up_l)
        else:
            circle = Arc(xl, zl, beta_l, self.r2)
            (xu, zu), curve = circle.at_angle(0.0), circle
        profile = Profile([0.0, xp, xl, xu], [Line(0.0, self.s, np.tan(beta_0)), knoll, arc,
                                              curve, Line(xu, zu, 0.0)])
        return profile, {"P": np.array([xp, zp]), "K": np.array([self.n, self.h]),
                         "L": np.array([xl, zl]), "U": np.array([xu, zu])}
