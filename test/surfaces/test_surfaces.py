"""Surfaces: joints of the hills, gradients, the YAML format and its refusals."""

import numpy as np
import pytest

from imu_fusion.errors import ImuFusionError, LayoutError
from imu_fusion.surfaces.file import load_surface, surface_from_mapping
from imu_fusion.surfaces.fis_hill import FisHill
from imu_fusion.surfaces.profile import Arc, Line, Profile

ORIGIN = {"latitude": 47.4, "longitude": 10.3, "height": 900.0}
HS106 = dict(w=95, h=44.93, n=83.07, gamma_deg=35, alpha_deg=11, e=89, es=20.7, gates=42, t=6.5,
             r1=95, s=2.2, betaP_deg=37, beta_deg=34.5, betaL_deg=32, rL=220, r2L=106.5, r2=106.5)
HILLS = {
    "hs106": FisHill(**HS106),
    "hs137": FisHill(w=120, h=59.52, n=103.51, gamma_deg=35, alpha_deg=11, e=99.5, t=6.5, r1=115,
                     s=3.38, betaP_deg=37.43, beta_deg=35.5, betaL_deg=33.56, rL=321, r2L=100,
                     r2=100),
    "circles": FisHill(**HS106, in_run_curve="circle", out_run_curve="circle"),
}


@pytest.mark.parametrize("name", HILLS)
def test_joints_are_continuous_in_height_and_slope(name):
    hill = HILLS[name]
    for profile, _ in (hill.in_run(), hill.landing()):
        for knot in profile.knots[profile.knots != 0.0]:
            # Half a micrometre to either side: heights differ by the slope times 1e-6.
            (z0, z1), (s0, s1), _ = profile([knot - 5e-7, knot + 5e-7])
            assert abs(z1 - z0) < 2e-6
            assert abs(np.degrees(np.arctan(s1) - np.arctan(s0))) < 1e-4


@pytest.mark.parametrize("after, radii, words", [
    (Line(10.0, 5.0001, 0.5), {},
     r"joint Q \(x = 10.000 m\): height z is 5.000000 m before and 5.000100 m after"),
    (Line(10.0, 5.0, 0.6), {}, "joint Q .* slope is 26.56505 deg before and 30.96376 deg after"),
    (Line(10.0, 5.0, np.nan), {}, "joint Q .* 5.000000 m before and nan m after"),
    (Arc(10.0, 5.0, np.arctan(0.5), 90.0), {"Q": (np.inf, 95.0)},
     "joint Q .* curvature after it is 0.01111111 1/m, the stated radius is 95 m"),
    (Line(10.0, 5.0, 0.5), {"Q": (95.0, None)}, "joint Q .* curvature before it is -?0.0000"),
])
def test_a_joint_that_does_not_fit_is_named_with_its_figures(after, radii, words):
    profile = Profile([10.0], [Line(0.0, 0.0, 0.5), after])
    with pytest.raises(LayoutError, match=words):
        profile.check_joints(["Q"], radii)


def test_a_joint_that_fits_is_accepted():
    arc = Arc(10.0, 5.0, np.arctan(0.5), 90.0)
    Profile([10.0], [Line(0.0, 0.0, 0.5), arc]).check_joints(["Q"], {"Q": (np.inf, 90.0)})


def test_radii_of_the_certificate_are_reproduced():
    hill = FisHill(**HS106)
    in_run, points = hill.in_run()
    landing, ends = hill.landing()

    def radius(profile, x):
        _, slope, curvature = profile(x)
        return -(1 + slope ** 2) ** 1.5 / curvature

    inside = 1e-6
    assert abs(radius(in_run, points["E2"][0] - inside) - hill.r1) < 1e-3
    assert 1 / radius(in_run, points["E1"][0] + 1e-3) < 1e-5  # curvature starts from zero
    assert abs(radius(landing, hill.n) - hill.rL) < 1e-6
    assert abs(radius(landing, ends["L"][0] + inside) - hill.r2L) < 1e-3
    assert abs(radius(landing, ends["U"][0] - inside) - hill.r2) < 1e-3
    assert abs(landing(ends["U"][0] - inside)[1]) < 1e-6


def test_points_of_oberstdorf_hs106():
    # Points evaluated independently from the transcribed certificate (rounded to mm).
    hill = FisHill(**HS106)
    points = {**hill.in_run()[1], **hill.landing()[1]}
    expected = {"E2": (-6.381, -1.240), "E1": (-64.702, -30.392), "B": (-66.771, -31.842),
                "A": (-83.728, -43.715), "P": (75.280, 39.322), "L": (91.097, 50.193),
                "U": (143.246, 65.146)}
    for name, point in expected.items():
        assert np.allclose(points[name], point, atol=1.5e-3), name
    assert abs(hill.landing()[0].arc_length(0.0, hill.n) - 94.52) < 0.005
    assert np.allclose(hill.gate(42), points["A"]) and np.allclose(hill.gate(1), points["B"])


def test_second_derivative_matches_differences_of_the_slope():
    hill = FisHill(**HS106)
    for profile, low, high in ((hill.in_run()[0], -80, 5), (hill.landing()[0], -5, 160)):
        x = np.linspace(low, high, 87) + 1e-3
        step = 1e-5
        slope = (profile(x + step)[1] - profile(x - step)[1]) / (2 * step)
        assert np.allclose(profile(x)[2], slope, atol=1e-7)


def test_certificate_contradictions_are_refused():
    with pytest.raises(LayoutError, match="gamma"):
        FisHill(**{**HS106, "gamma_deg": 10})
    with pytest.raises(LayoutError, match="fall from P"):
        FisHill(**{**HS106, "betaL_deg": 36})
    with pytest.raises(LayoutError, match="gates 1 to 42"):
        FisHill(**HS106).gate(43)


def _check_gradients(surface, positions):
    for constraint in surface.constraints():
        _, gradient = constraint.evaluate(positions)
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = 1e-4
            numeric = (constraint.evaluate(positions + step)[0]
                       - constraint.evaluate(positions - step)[0]) / 2e-4
            # 1e-3: an elevation grid uses one Jacobian of its projection for all places.
            assert np.allclose(gradient[:, axis], numeric, atol=1e-3), constraint.name


def test_hill_constraints_in_the_world():
    hill = load_surface("oberstdorf_hs106")
    rng = np.random.default_rng(1)
    points_hill = np.column_stack([rng.uniform(-60, 150, 40), rng.uniform(-5, 5, 40),
                                   rng.uniform(-30, 60, 40)])
    world = hill.to_world(points_hill)
    assert np.allclose(hill.to_hill(world), points_hill)
    _check_gradients(hill, world)
    in_run, lateral, landing = hill.constraints()
    assert np.allclose(lateral.evaluate(world)[0], points_hill[:, 1])
    # A point two metres above the K point, and its length.
    k = hill.to_world([[83.07, 0.0, 44.93 - 2.0]])
    assert np.allclose(landing.evaluate(k)[0], 2.0)
    assert np.allclose(landing.evaluate(k)[1] @ [0, 0, 1], 1.0)
    assert hill.jump_length(83.07) == pytest.approx(95.0)
    assert hill.jump_length(84.07) - 95.0 == pytest.approx(1 / np.cos(np.radians(34.4)), abs=0.01)
    # North-west of the edge is forward on this hill (azimuth 312.6 deg).
    assert hill.to_hill([-1.0, 1.0, 0.0])[0] > 1.39


def test_surveyed_table_reproduces_the_norm_profile():
    hill = FisHill(**HS106)
    xi, xl = np.linspace(-85, 0, 86), np.linspace(0, 160, 161)
    table = {"type": "hill_table", "origin": ORIGIN, "azimuth_deg": 90.0, "w": 95, "n": 83.07,
             "in_run": np.column_stack([xi, hill.in_run()[0](xi)[0]]).tolist(),
             "landing": np.column_stack([xl, hill.landing()[0](xl)[0]]).tolist(),
             "sigma": {"in_run": 0.05, "landing": 0.2}}
    surface = surface_from_mapping(table)
    x = np.linspace(1, 159, 500)
    # Cubics through points 1 m apart on curves of radius >= 95 m: sagitta 1.3 mm at most.
    assert np.abs(surface.landing(x)[0] - hill.landing()[0](x)[0]).max() < 1.4e-3
    assert [c.sigma for c in surface.constraints()] == [0.05, 0.1, 0.2]
    assert surface.jump_length(83.07) == pytest.approx(95.0)
    table["landing"][3][0] = 0.0
    with pytest.raises(LayoutError, match="'landing': x must increase, point 4"):
        surface_from_mapping(table)


def test_plane_falls_towards_its_aspect():
    plane = surface_from_mapping({"type": "plane", "slope_deg": 30, "aspect_deg": 90,
                                  "origin": ORIGIN})
    (constraint,) = plane.constraints()
    residual, _ = constraint.evaluate(np.array([[10.0, 5.0, -10 * np.tan(np.radians(30))]]))
    assert abs(residual[0]) < 1e-12
    _check_gradients(plane, np.random.default_rng(0).normal(size=(5, 3)))


@pytest.mark.parametrize("suffix", ["asc", "tif"])
def test_elevation_grid(tmp_path, suffix):
    rasterio = pytest.importorskip("rasterio")
    pyproj = pytest.importorskip("pyproj")
    lon, lat = ORIGIN["longitude"], ORIGIN["latitude"]
    x0, y0 = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:31254", always_xy=True).transform(
        lon, lat)
    columns, rows, cell = 60, 50, 5.0
    left, top = x0 - 150.0, y0 + 125.0
    x = left + cell * (np.arange(columns) + 0.5)
    y = top - cell * (np.arange(rows) + 0.5)
    heights = 880.0 + 0.3 * (x[None, :] - x0) - 0.2 * (y[:, None] - y0)
    heights[10, 10] = -9999.0
    path = tmp_path / f"dem.{suffix}"
    if suffix == "asc":
        head = (f"ncols {columns}\nnrows {rows}\nxllcorner {left:.6f}\n"
                f"yllcorner {top - rows * cell:.6f}\ncellsize {cell}\nNODATA_value -9999\n")
        path.write_text(head + "\n".join(" ".join(f"{v:.9f}" for v in r) for r in heights))
    else:
        with rasterio.open(path, "w", driver="GTiff", height=rows, width=columns, count=1,
                           dtype="float64", nodata=-9999.0, crs="EPSG:31254",
                           transform=rasterio.transform.from_origin(left, top, cell, cell)) as f:
            f.write(heights, 1)
    (tmp_path / "s.yaml").write_text(
        f"type: elevation_grid\nfile: {path.name}\ncrs: EPSG:31254\nheight_offset: 20.0\n"
        f"origin: {{latitude: {lat}, longitude: {lon}, height: 900.0}}\n")
    surface = load_surface(str(tmp_path / "s.yaml"))
    (constraint,) = surface.constraints()
    # The origin (900 m ellipsoidal) lies on the grid (880 m + 20 m of undulation);
    # float32 of an ASCII grid resolves 6e-5 m here.
    assert abs(constraint.evaluate(np.zeros((1, 3)))[0][0]) < 1e-3
    _check_gradients(surface, np.random.default_rng(0).uniform(-80, 80, (8, 3)))
    residual, _ = constraint.evaluate(np.array([[500.0, 0, 0], [x[10] - x0, y[10] - y0, 0.0]]))
    assert np.isnan(residual).all()


@pytest.mark.parametrize("text, message", [
    ("type: cone\norigin: {latitude: 0, longitude: 0, height: 0}", "known: fis_hill"),
    ("type: plane\nslope_deg: 3\naspect_deg: 1", "'origin' is missing"),
    ("type: plane\nslope_deg: 3\norigin: {latitude: 0, longitude: 0, height: 0}",
     "'aspect_deg' is missing"),
    ("type: fis_hill\nazimuth_deg: 1\nwidth: 3\norigin: {latitude: 0, longitude: 0, height: 0}",
     "unknown parameter 'width'"),
    ("- 1", "no mapping"),
])
def test_bad_files_are_refused_with_their_reason(tmp_path, text, message):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ImuFusionError, match=message):
        load_surface(str(path))


@pytest.mark.parametrize("name", ["oberstdorf_hs106", "oberstdorf_hs137", "zakopane_hs140",
                                  "engelberg_hs140"])
def test_shipped_hills_load(name):
    assert len(load_surface(name).constraints()) == 3


def test_a_missing_surface_says_where_it_was_looked_for():
    with pytest.raises(LayoutError, match="no.yaml does not exist in /.* or beside the parameter"):
        load_surface("folder/no.yaml")
    with pytest.raises(LayoutError, match="known: .*oberstdorf_hs106"):
        load_surface("nowhere")
