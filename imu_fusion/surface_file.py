"""Surfaces from YAML files: the format that users write.

    type: fis_hill | hill_table | plane | elevation_grid
    origin: {latitude: .., longitude: .., height: ..}   # WGS84, ellipsoidal
    sigma: 0.1                                          # metres, or one per part
    azimuth_deg: ..                                     # hills: x from north, clockwise
"""

import sys
from pathlib import Path

import yaml

from imu_fusion.errors import LayoutError
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.surfaces.elevation_grid import ElevationGrid
from imu_fusion.surfaces.fis_hill import FisHill
from imu_fusion.surfaces.hill import Hill
from imu_fusion.surfaces.plane import Plane
from imu_fusion.surfaces.profile import table_profile

_FOLDERS = (Path(__file__).parents[1] / "config" / "surfaces",
            Path(sys.prefix) / "share" / "imu_fusion" / "config" / "surfaces")


def _fis_hill(values, origin, sigma, folder):
    azimuth = float(_take(values, "azimuth_deg"))
    hill = FisHill.from_mapping(values)
    return Hill(origin, azimuth, hill.in_run()[0], hill.landing()[0], (hill.n, hill.w), sigma)


def _hill_table(values, origin, sigma, folder):
    azimuth = float(_take(values, "azimuth_deg"))
    in_run = table_profile(_take(values, "in_run"), "hill_table.in_run")
    landing = table_profile(_take(values, "landing"), "hill_table.landing")
    # Without a K point, lengths are counted from the foot of the table.
    k_point = (float(values.pop("n", 0.0)), float(values.pop("w", 0.0)))
    _refuse_rest(values)
    return Hill(origin, azimuth, in_run, landing, k_point, sigma)


def _plane(values, origin, sigma, folder):
    slope, aspect = float(_take(values, "slope_deg")), float(_take(values, "aspect_deg"))
    _refuse_rest(values)
    return Plane(origin, slope, aspect, sigma)


def _elevation_grid(values, origin, sigma, folder):
    file, crs = folder / _take(values, "file"), str(_take(values, "crs"))
    offset = float(values.pop("height_offset", 0.0))
    _refuse_rest(values)
    if not file.exists():
        raise LayoutError(f"elevation grid {file} does not exist")
    return ElevationGrid(origin, str(file), crs, offset, sigma)


_TYPES = {"fis_hill": _fis_hill, "hill_table": _hill_table, "plane": _plane,
          "elevation_grid": _elevation_grid}


def _take(values, key):
    try:
        return values.pop(key)
    except KeyError:
        raise LayoutError(f"surface: key '{key}' is missing") from None


def _refuse_rest(values):
    if values:
        raise LayoutError(f"surface: unknown keys {sorted(values)}")


def surface_from_mapping(mapping, folder="."):
    """The surface that a mapping describes (see the module's docstring).

    Args:
        mapping: keys as in a YAML file.
        folder: where relative file names start.

    Raises:
        LayoutError, ParameterError: a key that is missing, unknown or out of bounds.
    """
    values = dict(mapping)
    kind = _take(values, "type")
    if kind not in _TYPES:
        raise LayoutError(f"surface: type {kind!r}; known: {', '.join(_TYPES)}")
    place = dict(_take(values, "origin"))
    origin = LocalFrame(*(float(_take(place, key)) for key in ("latitude", "longitude", "height")))
    return _TYPES[kind](values, origin, values.pop("sigma", 0.1), Path(folder))


def load_surface(name):
    """The surface of a YAML file: a path, or the name of one in config/surfaces.

    Raises:
        LayoutError: no such file, or its content is not a surface.
    """
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        found = [f / f"{name}.yaml" for f in _FOLDERS if (f / f"{name}.yaml").exists()]
        if not found:
            known = sorted({p.stem for f in _FOLDERS for p in f.glob("*.yaml")})
            raise LayoutError(f"no surface named {name!r}; known: {', '.join(known)}; "
                              "or give the path of a YAML file")
        path = found[0]
    if not path.exists():
        where = "" if path.is_absolute() else f" in {Path.cwd()} or beside the parameter file"
        raise LayoutError(f"surface file {path} does not exist{where}")
    try:
        mapping = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise LayoutError(f"surface file {path}: {error}") from error
    if not isinstance(mapping, dict):
        raise LayoutError(f"surface file {path} holds no mapping")
    try:
        return surface_from_mapping(mapping, path.parent)
    except (LayoutError, TypeError) as error:
        raise LayoutError(f"{path}: {error}") from error
