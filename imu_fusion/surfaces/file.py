"""Surfaces from YAML files: the format that users write (docs/surfaces.md).

    type: fis_hill | hill_table | plane | elevation_grid
    origin: {latitude: .., longitude: .., height: ..}   # WGS84, ellipsoidal
    sigma: 0.1                                          # metres, or one per part
    azimuth_deg: ..                                     # hills: x from north, clockwise
"""

import reprlib
import sys
from pathlib import Path
from typing import Any

from imu_fusion.errors import ImuFusionError, LayoutError, ParameterError
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.parameters.bounded_yaml import read_yaml
from imu_fusion.surfaces.constraint import DEFAULT_SIGMA, Surface
from imu_fusion.surfaces.elevation_grid import ElevationGrid
from imu_fusion.surfaces.fis_hill import FisHill
from imu_fusion.surfaces.hill import Hill
from imu_fusion.surfaces.hill_table import table_hill
from imu_fusion.surfaces.plane import Plane
from imu_fusion.surfaces.values import number

_FOLDERS = (Path(__file__).parents[2] / "config" / "surfaces",
            Path(sys.prefix) / "share" / "imu_fusion" / "config" / "surfaces")


def _fis_hill(values, origin, sigma, folder):
    azimuth = _take_number(values, "azimuth_deg", "deg")
    for info in FisHill.infos():
        unset = info.optional and values.get(info.name) is None
        if info.name in values and info.element in (int, float) and not unset:
            values[info.name] = number(values[info.name], info.name, info.unit)
    # A nested mapping would be flattened, an empty one vanish.
    nested = [str(key) for key, value in values.items() if isinstance(value, dict)]
    if nested:
        raise LayoutError(f"key '{nested[0]}': a hill has no mapping of this name")
    hill = FisHill.from_mapping(values)
    return Hill(origin, azimuth, hill.in_run()[0], hill.landing()[0], (hill.n, hill.w), sigma)


def _hill_table(values, origin, sigma, folder):
    azimuth = _take_number(values, "azimuth_deg", "deg")
    in_run, landing = _take(values, "in_run"), _take(values, "landing")
    n, w = values.pop("n", None), values.pop("w", None)
    _refuse_rest(values)
    in_run, landing, k_point = table_hill(in_run, landing, n, w)
    return Hill(origin, azimuth, in_run, landing, k_point, sigma)


def _plane(values, origin, sigma, folder):
    slope = _take_number(values, "slope_deg", "deg")
    aspect = _take_number(values, "aspect_deg", "deg")
    _refuse_rest(values)
    return Plane(origin, slope, aspect, sigma)


def _elevation_grid(values, origin, sigma, folder):
    name, crs = _take(values, "file"), _take(values, "crs")
    offset = number(values.pop("height_offset", 0.0), "height_offset", "m")
    _refuse_rest(values)
    if not isinstance(name, str) or not name:
        raise LayoutError(f"key 'file': {reprlib.repr(name)} is not the name of a file")
    file = folder / name
    try:
        is_file, is_folder = file.is_file(), file.is_dir()
    except (OSError, ValueError):  # no name that a file can have
        is_file = is_folder = False
    if not is_file:
        raise LayoutError(f"key 'file': elevation grid {file} "
                          + ("is a folder" if is_folder else "does not exist"))
    return ElevationGrid(origin, str(file), crs, offset, sigma)


_TYPES = {"fis_hill": _fis_hill, "hill_table": _hill_table, "plane": _plane,
          "elevation_grid": _elevation_grid}


def _take(values, key):
    try:
        return values.pop(key)
    except KeyError:
        raise LayoutError(f"key '{key}' is missing") from None


def _take_number(values, key, unit):
    return number(_take(values, key), key, unit)


def _refuse_rest(values, inside=""):
    if values:
        names = ", ".join(f"'{inside}{key}'" for key in values)
        raise LayoutError(f"unknown key {names}: misspelt, or of another type of surface; "
                          "docs/surfaces.md lists the keys")


def _origin(place):
    if not isinstance(place, dict):
        raise LayoutError("key 'origin': expected {latitude: .., longitude: .., height: ..}, is "
                          + reprlib.repr(place))
    place = dict(place)
    missing = [key for key in ("latitude", "longitude", "height") if key not in place]
    if missing:
        raise LayoutError(f"key 'origin.{missing[0]}' is missing")
    latitude = number(place.pop("latitude"), "origin.latitude", "degrees, south negative", -90, 90)
    longitude = number(place.pop("longitude"), "origin.longitude", "degrees, west negative",
                       -360, 360)
    height = number(place.pop("height"), "origin.height", "m above the ellipsoid", -1000, 10000)
    _refuse_rest(place, "origin.")
    return LocalFrame(latitude, longitude, height)


def surface_from_mapping(mapping: Any, folder: str | Path = ".") -> Surface:
    """The surface that a mapping describes (docs/surfaces.md).

    Args:
        mapping: keys as in a YAML file.
        folder: where relative file names start.

    Raises:
        LayoutError: a key that is missing, unknown or out of bounds, keys that contradict
            each other, an elevation grid that cannot be used.
    """
    values = dict(mapping)
    kind = values.pop("type", None)
    if not isinstance(kind, str) or kind not in _TYPES:
        what = "is missing" if kind is None else f"is {reprlib.repr(kind)}"
        raise LayoutError(f"key 'type' {what}; known: {', '.join(_TYPES)}")
    try:
        origin = _origin(_take(values, "origin"))
        return _TYPES[kind](values, origin, values.pop("sigma", DEFAULT_SIGMA), Path(folder))
    except ImuFusionError as error:  # also a ParameterError of the hill
        raise LayoutError(f"{kind}: {error}") from error


def load_surface(name: str | Path) -> Surface:
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
        mapping = read_yaml(path)
    except ParameterError as error:
        why = str(error).removeprefix(f"{path}: ")
        raise LayoutError(f"surface file {path} cannot be read as YAML: {why}") from error
    if not isinstance(mapping, dict):
        raise LayoutError(f"surface file {path} holds no mapping of keys to values")
    try:
        return surface_from_mapping(mapping, path.parent)
    except LayoutError as error:
        raise LayoutError(f"{path}: {error}") from error
