"""The surface format: what a file may hold, and that everything else is refused by one kind of
error that names the file and the key."""

import datetime
import math
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from imu_fusion.errors import LayoutError
from imu_fusion.surfaces.file import load_surface, surface_from_mapping
from imu_fusion.surfaces.fis_hill import FisHill

ORIGIN = {"latitude": 47.4, "longitude": 10.3, "height": 900.0}
PLANE = {"type": "plane", "origin": ORIGIN, "slope_deg": 30.0, "aspect_deg": 90.0}
HILL = {"type": "fis_hill", "origin": ORIGIN, "azimuth_deg": 312.6, "w": 95, "h": 44.93,
        "n": 83.07, "gamma_deg": 35, "alpha_deg": 11, "e": 89, "es": 20.7, "gates": 42, "t": 6.5,
        "r1": 95, "s": 2.2, "betaP_deg": 37, "beta_deg": 34.5, "betaL_deg": 32, "rL": 220,
        "r2L": 106.5, "r2": 106.5}
TABLE = {"type": "hill_table", "origin": ORIGIN, "azimuth_deg": 312.6, "w": 95, "n": 83,
         "in_run": [[-84, -44], [-64, -30], [-6, -1.2], [0, 0]],
         "landing": [[0, 2.2], [40, 13], [75, 39], [83, 44.9], [91, 50.2], [143, 65], [200, 63]]}
GRID = {"type": "elevation_grid", "origin": ORIGIN, "file": "dem.asc", "crs": "EPSG:25832"}
CORNER = (598000.0, 5250340.0)  # of EPSG:25832, 90 m west and south of 47.4 N 10.3 E


def write_dem(path, corner=CORNER, cell=10.0, height=850.0, nodata=-9999):
    path.write_text(f"ncols 20\nnrows 20\nxllcorner {corner[0]}\nyllcorner {corner[1]}\n"
                    f"cellsize {cell}\nNODATA_value {nodata}\n"
                    + "\n".join(" ".join([f"{height + row:.1f}"] * 20) for row in range(20)))


@pytest.fixture
def load(tmp_path):
    """Load a mapping or a text as a file s.yaml, beside a dem.asc."""
    def load(content):
        write_dem(tmp_path / "dem.asc")
        text = content if isinstance(content, str) else yaml.safe_dump(content)
        (tmp_path / "s.yaml").write_text(text)
        return load_surface(str(tmp_path / "s.yaml"))
    return load


@pytest.fixture
def refusal(load):
    """The message with which a file is refused; it names the file."""
    def refusal(content):
        with pytest.raises(LayoutError) as caught:
            load(content)
        assert "s.yaml" in str(caught.value)
        return str(caught.value)
    return refusal


NASTY = [None, math.nan, math.inf, -math.inf, True, "steep", "47N", "nan", "", [], {}, [1.0, 2.0],
         {"a": 1}, 1e12, -1e12, 10**400, datetime.date(2020, 1, 1)]
OPTIONAL_NUMBERS = {"es", "gates", "beta0_deg"}


@pytest.mark.parametrize("mapping", [PLANE, HILL, TABLE, GRID], ids=lambda m: m["type"])
def test_no_value_of_any_key_escapes_the_reader(mapping, refusal, load):
    """Everything is refused for every key, with the file and the key in the message; null unsets
    what is optional."""
    if mapping is GRID:
        pytest.importorskip("rasterio")
        pytest.importorskip("pyproj")
        mapping = {**GRID, "height_offset": 45.0}
    mapping = {**mapping, "sigma": 0.1}
    load(mapping)
    for key in mapping:
        for value in NASTY:
            unset = {"n": "w", "w": "n"}.get(key) if mapping is TABLE else None
            if value is None and key in OPTIONAL_NUMBERS or key == "sigma" and value in ({}, 1e12):
                load({**mapping, key: value})
            elif not (value is None and unset):
                assert f"{key}" in refusal({**mapping, key: value}), (key, value)
    for key in ORIGIN:
        for value in NASTY:
            message = refusal({**mapping, "origin": {**ORIGIN, key: value}})
            assert f"'origin.{key}'" in message, (key, value)
    for key in set(mapping) - {"sigma", "height_offset", "n", "w", *OPTIONAL_NUMBERS} | (
            {"n", "w"} & set(mapping)):
        assert key in refusal({k: v for k, v in mapping.items() if k != key})


@pytest.mark.parametrize("content, words", [
    ({**PLANE, "aspect": 3}, "unknown key 'aspect'"),
    ({**PLANE, 7: 3}, "unknown key '7'"),
    ({**PLANE, "azimuth_deg": 3}, "unknown key 'azimuth_deg'"),
    ({**PLANE, "origin": {**ORIGIN, "datum": "MGI"}}, "unknown key 'origin.datum'"),
    ({**PLANE, "origin": "here"}, "'origin': expected {latitude"),
    ({**PLANE, "origin": {**ORIGIN, "latitude": 474.0}}, "'origin.latitude': 474 is out of bounds"),
    ({**PLANE, "origin": {**ORIGIN, "height": 95000}}, "'origin.height': 95000 is out of bounds"),
    ({**PLANE, "slope_deg": 90}, "'slope_deg': a plane of 90 deg"),
    ({**PLANE, "slope_deg": "steep"}, "'slope_deg': 'steep' is not a finite number"),
    ({**PLANE, "sigma": 0}, "'sigma': 0 m is not positive"),
    ({**PLANE, "sigma": {"plain": 0.1}}, "'sigma' names 'plain'; this surface has the parts plane"),
    ({**TABLE, "sigma": {"in_run": -0.1}}, "'sigma.in_run': -0.1 m is not positive"),
    ({**TABLE, "sigma": {"landing": math.nan}}, "'sigma.landing': nan is not a finite"),
    ({**TABLE, "sigma": {"landing": None}}, "'sigma.landing': None is not a finite"),
    ({**TABLE, "azimuth_deg": "NW"}, "'azimuth_deg': 'NW' is not a finite number"),
    ({**HILL, "width": 3}, "unknown parameter 'width'"),
    ({**HILL, "extra": {}}, "'extra'"),
    ({**HILL, "gates": 42.5}, "'gates'.*not an integer"),
    ({**HILL, "in_run_curve": "clothoid"}, "'in_run_curve'.*cubic, circle"),
    ("type: plane\nslope_deg: 2001-13-45", "cannot be read as YAML"),
    ("type: [plane", "cannot be read as YAML"),
    ("? [1, 2]\n: 3", "cannot be read as YAML"),
    ("[" * 5000, "cannot be read as YAML"),
    ("type: [plane]", r"'type' is \['plane'\]; known: fis_hill"),
    ("slope_deg: 3", "'type' is missing"),
    ("type: plane\norigin: &o {latitude: *o, longitude: 1, height: 1}", "contains itself"),
    ("just text", "no mapping"),
    ("", "no mapping"),
])
def test_refusals_say_what_is_wrong(content, words, refusal):
    assert re.search(words, refusal(content))


def test_files_that_are_no_text(tmp_path):
    (tmp_path / "b.yaml").write_bytes(bytes(range(256)))
    with pytest.raises(LayoutError, match="b.yaml cannot be read as YAML"):
        load_surface(str(tmp_path / "b.yaml"))
    (tmp_path / "folder.yaml").mkdir()
    with pytest.raises(LayoutError, match="folder.yaml cannot be read"):
        load_surface(str(tmp_path / "folder.yaml"))


def test_numbers_that_yaml_takes_for_text_count(load):
    # YAML 1.1 wants a point in 1e-1.
    (constraint,) = load(yaml.safe_dump(PLANE) + "sigma: 1e-1\n").constraints()
    assert constraint.sigma == 0.1


def test_every_figure_of_a_certificate_is_its_own(refusal, load):
    """A hill without a figure must not get that of another hill."""
    for key in set(HILL) - {"es", "gates"}:
        assert key in refusal({k: v for k, v in HILL.items() if k != key}), key
    partial = {k: v for k, v in HILL.items() if k not in ("es", "gates")}
    assert load(partial).landing(np.array(50.0))[0] == load(HILL).landing(np.array(50.0))[0]
    certificate = {k: v for k, v in partial.items() if k not in ("type", "origin", "azimuth_deg")}
    with pytest.raises(LayoutError, match="need es and gates"):
        FisHill(**certificate).gate(1)
    with pytest.raises(TypeError, match="r1"):
        FisHill(**{k: v for k, v in certificate.items() if k != "r1"})


@pytest.mark.parametrize("changes, words", [
    ({"h": 84.93}, "h 84.93 m and n 83.07 m give w = 119.40 m"),
    ({"w": 130}, "give w = 94.91 m .* stated is 130.0 m"),
    ({"w": 97}, "stated is 97.0 m"),
    ({"n": 20}, "n 20.0 m give w = 49.43 m"),
    ({"e": 20}, "in-run e 20.0 m is shorter than its transition to the table, 65.8 m"),
    ({"r1": 195}, "in-run e 89.0 m is shorter than its transition"),
    ({"es": 95}, "es 95.0 m must be less than the in-run e 89.0 m"),
    ({"r2L": 500}, "joint L .* r2L 500.0 m exceeds rL 220.0 m"),
    ({"out_run_curve": "circle", "r2L": 100}, "one radius, r2L 100.0 m and r2 106.5 m"),
    ({"rL": 1900}, "the knoll must steepen steadily, but its slope runs from -37.9"),
    ({"betaP_deg": 45}, "the knoll must steepen steadily"),
    ({"gamma_deg": 10}, "gamma 10.0 deg must exceed"),
    ({"betaL_deg": 36}, "fall from P over K to L"),
    ({"betaP_deg": 32, "beta_deg": 32}, r"P \(x = 83.07 m\) must lie between the table and L"),
])
def test_contradictory_certificates_are_refused(changes, words, refusal):
    assert re.search(words, refusal({**HILL, **changes}))


@pytest.mark.parametrize("figures", [
    # Public transcriptions; the second misses the norm's w by 0.6 %, the last knoll overshoots
    # beta_P by 0.4 deg.
    dict(w=64, h=29.13, n=56.14, gamma_deg=34, alpha_deg=9.5, e=76.31, es=19, t=5.86, r1=70, s=1.59,
         betaP_deg=34.5, beta_deg=33.7, betaL_deg=32.6, rL=120, r2L=120, r2=90),
    dict(w=95, h=44.64, n=82.7, gamma_deg=35, alpha_deg=10.5, e=91.57, es=17.94, t=6.45, r1=94,
         s=2.36, betaP_deg=35, beta_deg=32.5, betaL_deg=29.75, rL=210, r2L=120, r2=90),
    dict(w=14, h=5.7, n=12.8, gamma_deg=30, alpha_deg=8, e=20, es=5, t=3, r1=26, s=0.6,
         betaP_deg=32.5, beta_deg=32.5, betaL_deg=30.2, rL=40, r2L=40, r2=31),
    dict(w=200, h=103.1, n=170.3, gamma_deg=38.7, alpha_deg=11.2, e=109.5, es=24, t=8.5, r1=130,
         s=3.4, betaP_deg=36.9, beta_deg=33.9, betaL_deg=31.4, rL=500, r2L=150, r2=100),
], ids=["hs70", "hs105", "hs15", "hs235"])
def test_hills_of_all_sizes_pass(figures):
    FisHill(**figures)


@pytest.mark.parametrize("changes, words", [
    ({"landing": [[x, -z] for x, z in TABLE["landing"]]}, "'landing': z points down, so below"),
    ({"in_run": [[x, -z] for x, z in TABLE["in_run"]]}, "'in_run': z points down, so above"),
    ({"in_run": [[-84, -44], [-3, 0]]}, r"last point must be the table edge.* is \[-3, 0\]"),
    ({"in_run": [[-84, 0], [-40, 0], [0, 0]]}, "'in_run': it must fall"),
    ({"landing": [[0, 2.2], [40, 13], [45, 11], [83, 44.9], [143, 65]]},
     r"'landing': it rises by 2.00 m on its way down, at point 3, \[45, 11\]"),
    ({"landing": [[0, 2.2], [40, 13], [83, 449], [143, 650]]},
     "'landing': 84 deg between the points 2 and 3"),
    ({"landing": [[-60, 2.2], [-10, 30]]}, "must reach beyond the table edge"),
    ({"landing": [[0, 2.2], [40, "13 m"]]}, "'landing, point 2, z': '13 m' is not a finite number"),
    ({"landing": [[0, 2.2, 0], [40, 13, 0]]}, r"'landing', point 1: expected \[x, z\]"),
    ({"landing": [0, 2.2]}, r"'landing', point 1: expected \[x, z\], is 0"),
    ({"landing": [[0, 2.2]]}, "at least two"),
    ({"in_run": [[-84, -44], [-64, -30], [-70, -35], [0, 0]]},
     "'in_run': x must increase, point 3 has -70 m after -64 m"),
    ({"w": None}, "'n' is given without 'w'"),
    ({"n": None}, "'w' is given without 'n'"),
    ({"n": "x"}, "'n': 'x' is not a finite number"),
    ({"n": 250}, "'n': 250 m lies beyond the landing table"),
    ({"n": 95, "w": 83}, r"at n = 95 m .* but 83 m are stated"),
])
def test_tables_that_are_no_hill_are_refused(changes, words, refusal):
    assert re.search(words, refusal({**TABLE, **changes}))


def test_a_table_may_end_in_a_counter_slope_and_have_no_k_point(load):
    hill = load({k: v for k, v in TABLE.items() if k not in ("n", "w")})
    assert hill.k_point == (0.0, 0.0)
    assert hill.landing(np.array(180.0))[1] < 0  # rises again
    # A survey misses the edge by centimetres and the snow by decimetres.
    load({**TABLE, "in_run": [[-84, -44], [-84.0 + 1e-3, -43.999], [-0.05, -0.03]]})
    load({**TABLE, "landing": [[0, 2.2], [40, 13], [41, 12.8], [83, 44.9], [143, 65]]})


# Elevation grids.

@pytest.fixture
def libraries():
    pytest.importorskip("rasterio")
    return pytest.importorskip("pyproj")


@pytest.mark.parametrize("changes, words", [
    ({"crs": "EPSG:99999"}, "'crs': pyproj knows no reference system 'EPSG:99999'.*EPSG:31254"),
    ({"crs": "somewhere"}, "'crs': pyproj knows no reference system 'somewhere'"),
    ({"crs": "EPSG:4326"}, "'crs': EPSG:4326 is in degrees, but the grid .* x from 598005"),
    ({"crs": "EPSG:4978"}, "'crs': EPSG:4978 .* is a Geocentric"),
    ({"crs": "EPSG:5778"}, "'crs': EPSG:5778 .* is a Vertical"),
    ({"crs": "IAU_2015:49910"}, "'crs': pyproj knows no reference system .* on Earth"),
    ({"crs": "EPSG:25833"}, "'origin': 47.4, 10.3 lies 4.. km beside the elevation grid"),
    ({"crs": "EPSG:31254"}, "'origin': .* km beside the elevation grid"),
    ({"origin": {"latitude": 10.3, "longitude": 47.4, "height": 900}}, "km beside the elevation"),
    ({"origin": {"latitude": 48.4, "longitude": 10.3, "height": 900}}, "lies 111 km beside"),
    ({"file": "no.asc"}, "'file': elevation grid .*no.asc does not exist"),
    ({"file": "."}, "'file': elevation grid .* is a folder"),
    ({"file": "s.yaml"}, "elevation grid .*s.yaml: .*not recognized"),
    ({"file": 5}, "'file': 5 is not the name of a file"),
    ({"file": "x" * 5000}, "does not exist"),
    ({"height_offset": "geoid"}, "'height_offset': 'geoid' is not a finite number"),
])
def test_grids_that_do_not_fit_are_refused_when_loaded(changes, words, refusal, libraries):
    assert re.search(words, refusal({**GRID, **changes}), re.DOTALL)


@pytest.mark.parametrize("crs", ["EPSG:25832", 25832, "25832", "ETRS89 / UTM zone 32N"])
def test_names_and_codes_of_a_reference_system(crs, load, libraries):
    (constraint,) = load({**GRID, "crs": crs}).constraints()
    assert np.isfinite(constraint.evaluate(np.zeros((1, 3)))[0]).all()


def test_the_origin_need_not_lie_on_the_grid(load, libraries):
    """It is the origin of coordinates; a base station in the valley serves as well."""
    surface = load({**GRID, "origin": {**ORIGIN, "latitude": 47.5}})
    (constraint,) = surface.constraints()
    down = surface.origin.to_enu(47.4, 10.3, 900.0)
    residual, _ = constraint.evaluate(np.array([[0.0, 0, 0], down]))
    assert np.isnan(residual[0]) and 30 < residual[1] < 50


def test_missing_data_must_be_declared(load, tmp_path, libraries):
    write_dem(tmp_path / "holes.asc", height=-32768.0)
    with pytest.raises(LayoutError, match="holes.asc holds heights from -32768.*nodata"):
        load({**GRID, "file": "holes.asc"})


def test_what_a_geotiff_says_of_itself(tmp_path, load, libraries):
    import rasterio

    def write(name, crs, transform):
        with rasterio.open(tmp_path / name, "w", driver="GTiff", height=20, width=20, count=1,
                           dtype="float32", crs=crs, transform=transform) as f:
            f.write(np.arange(400, dtype="float32").reshape(20, 20), 1)

    north_up = rasterio.Affine(10.0, 0, CORNER[0], 0, -10.0, CORNER[1] + 200)
    write("ed50.tif", "EPSG:23032", north_up)
    with pytest.raises(LayoutError, match="ED50 / UTM zone 32N, 0.2 km from where EPSG:25832 puts"):
        load({**GRID, "file": "ed50.tif"})
    write("utm.tif", "EPSG:25832", north_up)
    load({**GRID, "file": "utm.tif"})
    # Rows from south to north are legitimate.
    write("south.tif", "EPSG:25832", rasterio.Affine(10.0, 0, CORNER[0], 0, 10.0, CORNER[1]))
    heights = [load({**GRID, "file": name}).constraints()[0].evaluate(np.zeros((1, 3)))
               for name in ("utm.tif", "south.tif")]
    assert heights[0][1][0, 1] == pytest.approx(-heights[1][1][0, 1], rel=3e-3)
    write("degrees.tif", "EPSG:4326", rasterio.Affine(1e-4, 0, 10.299, 0, -1e-4, 47.401))
    (constraint,) = load({**GRID, "file": "degrees.tif", "crs": "EPSG:4326"}).constraints()
    assert np.isfinite(constraint.evaluate(np.zeros((1, 3)))[0]).all()


def test_a_mapping_is_refused_as_a_file_is():
    with pytest.raises(LayoutError, match="^plane: key 'origin.latitude': 474 is out of bounds"):
        surface_from_mapping({**PLANE, "origin": {**ORIGIN, "latitude": 474}})
    with pytest.raises(LayoutError, match="^fis_hill: .*'w'.*out of bounds"):
        surface_from_mapping({**HILL, "w": 1000})


# The documentation.

DOCUMENT = Path(__file__).parents[2] / "docs" / "surfaces.md"
BLOCKS = re.findall(r"```yaml\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)


def test_the_documentation_shows_every_type_and_every_key():
    shown = {}
    for block in map(yaml.safe_load, BLOCKS):
        shown.setdefault(block["type"], set()).update(block)
    assert set(shown) == {"plane", "elevation_grid", "fis_hill", "hill_table"}
    hill = {info.name for info in FisHill.infos()}
    assert hill <= shown["fis_hill"]
    text = DOCUMENT.read_text()
    for key in hill | set().union(*shown.values()):
        assert f"`{key}`" in text, key
    section = text[text.index("## fis_hill"):text.index("## hill_table")]
    rows = [line for line in section.splitlines() if line.startswith("| `")]
    for info in FisHill.infos():
        (row,) = [row for row in rows if f"`{info.name}`" in row.split("|")[1]]
        optional = info.optional or info.choices
        assert ("default" in row or "optional" in row or info.name == "r2L") == bool(optional), row
        if info.low is not None:
            assert f"{info.low:g} to {info.high:g}" in row, info.name


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.split()[1])
def test_every_block_of_the_documentation_loads(block, tmp_path):
    mapping = yaml.safe_load(block)
    if mapping["type"] == "elevation_grid":
        pytest.importorskip("rasterio")
        pyproj = pytest.importorskip("pyproj")
        x, y = pyproj.Transformer.from_crs("EPSG:4979", mapping["crs"], always_xy=True).transform(
            mapping["origin"]["longitude"], mapping["origin"]["latitude"])
        write_dem(tmp_path / mapping["file"], (x - 100.0, y - 100.0), height=2050.0)
    (tmp_path / "s.yaml").write_text(block)
    surface = load_surface(str(tmp_path / "s.yaml"))
    if isinstance(mapping["sigma"], dict):
        assert {c.name for c in surface.constraints()} == set(mapping["sigma"])
    # At the origin every surface is at hand.
    for constraint in surface.constraints():
        residual, _ = constraint.evaluate(np.zeros((1, 3)))
        assert abs(residual[0]) < 10.0
