"""A digital elevation model as a surface (ESRI ASCII or GeoTIFF, read by rasterio)."""

import reprlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.errors import LayoutError
from imu_fusion.surfaces.constraint import DEFAULT_SIGMA, Constraint, Surface, split_sigma
from imu_fusion.surfaces.values import number


def _libraries():
    try:
        import pyproj
        import rasterio
    except ImportError as error:
        raise LayoutError("surface of type elevation_grid needs rasterio and pyproj: "
                          "pip install 'imu_fusion[terrain]'") from error
    return pyproj, rasterio


#: How far the origin may lie beside the grid, m. It need not lie on it: it is the origin of
#: coordinates only, a base station in the valley, say. But a degree of latitude or longitude
#: too many, swapped axes or another reference system put it farther off than this.
ORIGIN_REACH = 50e3
#: What the reference systems named in the file and by ``crs`` may differ by at the grid's
#: middle, m: less than other zones, ellipsoids or datums do, more than realisations of one.
CRS_TOLERANCE = 50.0
#: Heights of the ground, m; others are missing data not declared as such.
LOWEST, HIGHEST = -1000.0, 10000.0

PARTS = ("elevation_grid",)


def _reference_system(pyproj, crs):
    """The pyproj CRS of a name, or of a number: its EPSG code; and its transformer from
    WGS84."""
    name = f"EPSG:{crs}" if str(crs).isdigit() else crs
    hint = "give the horizontal reference system of the file, such as EPSG:31254"
    if not isinstance(name, str):
        raise LayoutError(f"key 'crs': {reprlib.repr(crs)} is no name of a reference system; "
                          + hint)
    try:
        system = pyproj.CRS.from_user_input(name)
        if not (system.is_projected or system.is_geographic):
            raise LayoutError(f"key 'crs': {crs} ({system.name}) is a {system.type_name}; {hint}")
        return system, pyproj.Transformer.from_crs("EPSG:4979", system, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise LayoutError(f"key 'crs': pyproj knows no reference system {crs!r} on Earth; {hint} "
                          f"({error})") from error


def _distance(pyproj, here, there):
    """Metres between two (longitude, latitude, ...), inf where one is none."""
    if not np.isfinite([*here[:2], *there[:2]]).all():
        return np.inf
    return pyproj.Geod(ellps="WGS84").inv(*here[:2], *there[:2])[2]


def _read(rasterio, file):
    """x (columns,), y (rows,), both increasing, heights (rows, columns), NaN where missing, and
    the well-known text of the file's own reference system or None."""
    where = f"key 'file': elevation grid {file}"
    try:
        with rasterio.open(file) as source:
            if not source.count:
                raise LayoutError(f"{where} has no band; extract one grid of the container")
            heights = source.read(1, masked=True).astype(float).filled(np.nan)
            transform, own = source.transform, source.crs and source.crs.to_wkt()
    except (rasterio.errors.RasterioError, rasterio.errors.CRSError) as error:
        raise LayoutError(f"{where}: {error}") from error
    if transform.is_identity:
        raise LayoutError(f"{where} does not say where it lies")
    if transform.b or transform.d:
        raise LayoutError(f"{where} is rotated; resample it to axes of its reference system")
    rows, columns = heights.shape
    if min(rows, columns) < 4:
        raise LayoutError(f"{where}: {rows} x {columns} nodes, a bicubic spline needs 4 x 4")
    x = transform.c + transform.a * (np.arange(columns) + 0.5)
    y = transform.f + transform.e * (np.arange(rows) + 0.5)
    # As a rule the rows come from north to south.
    heights = heights[np.argsort(y)][:, np.argsort(x)]
    known = heights[np.isfinite(heights)]
    if not len(known):
        raise LayoutError(f"{where} holds no data")
    if known.min() < LOWEST or known.max() > HIGHEST:
        raise LayoutError(f"{where} holds heights from {known.min():g} to {known.max():g} m: if "
                          "that marks missing data, declare it as the nodata value")
    return np.sort(x), np.sort(y), heights, own


@dataclass(frozen=True)
class ElevationGrid(Surface):
    """Heights on a regular grid of the reference system ``crs``.

    Grids carry heights above the geoid as a rule; ``height_offset`` (the undulation, m)
    is added to make them ellipsoidal. Between the nodes a bicubic spline interpolates,
    so the gradient is continuous; cells without data and places outside give NaN.

    The file is read when the surface is made.

    Raises:
        LayoutError: a file that is no grid or not one of ``crs``, an unknown ``crs``, an
            origin more than :data:`ORIGIN_REACH` beside the grid, a bad sigma or offset.
    """

    file: str
    crs: str | int
    height_offset: float = 0.0
    sigma: float | dict = DEFAULT_SIGMA

    def __post_init__(self) -> None:
        number(self.height_offset, "height_offset", "m", -1000.0, 1000.0)
        split_sigma(self.sigma, PARTS)
        self._check_origin()

    @cached_property
    def _grid(self):
        pyproj, rasterio = _libraries()
        system, transformer = _reference_system(pyproj, self.crs)
        x, y, heights, own = _read(rasterio, self.file)
        if system.is_geographic and (np.abs(x).max() > 360.0 or np.abs(y).max() > 90.0):
            raise LayoutError(f"key 'crs': {self.crs} is in degrees, but {self._extent(x, y)}: "
                              "give the projected system of the file")
        self._check_own_system(pyproj, own, system, x.mean(), y.mean())
        missing = ~np.isfinite(heights)
        spline = scipy.interpolate.RectBivariateSpline(
            y, x, np.where(missing, heights[~missing].mean(), heights))
        # The cubic patch of a cell reaches two nodes out: any hole there spoils it.
        holes = scipy.interpolate.RectBivariateSpline(y, x, missing.astype(float), kx=1, ky=1)
        return x, y, spline, holes, transformer

    def _extent(self, x, y):
        return (f"the grid {self.file} has x from {x[0]:.6g} to {x[-1]:.6g} and y from "
                f"{y[0]:.6g} to {y[-1]:.6g}")

    def _check_own_system(self, pyproj, own, system, x, y):
        """Refuse a file whose own reference system puts its middle (x, y) elsewhere."""
        if not own:
            return
        try:
            own = pyproj.CRS.from_wkt(own)
            places = [pyproj.Transformer.from_crs(crs, "EPSG:4979", always_xy=True).transform(x, y)
                      for crs in (own, system)]
        except pyproj.exceptions.ProjError:
            return  # a local system that pyproj cannot compare
        distance = _distance(pyproj, *places)
        if distance > CRS_TOLERANCE:
            raise LayoutError(f"key 'crs': the grid {self.file} says of itself that it is in "
                              f"{own.name}, {distance / 1e3:.1f} km from where {self.crs} puts it")

    def _check_origin(self):
        pyproj, _ = _libraries()
        grid_x, grid_y, _, _, transformer = self._grid
        origin = self.origin.longitude_deg, self.origin.latitude_deg
        x, y = transformer.transform(*origin)
        nearest = transformer.transform(np.clip(x, grid_x[0], grid_x[-1]),
                                        np.clip(y, grid_y[0], grid_y[-1]), direction="INVERSE")
        # Where crs does not reach the origin, x and y are inf.
        distance = _distance(pyproj, origin, nearest) if np.isfinite([x, y]).all() else np.inf
        if distance > ORIGIN_REACH:
            raise LayoutError(
                f"key 'origin': {origin[1]:g}, {origin[0]:g} lies {distance / 1e3:.0f} km beside "
                f"the elevation grid, more than {ORIGIN_REACH / 1e3:g} km: in {self.crs} it is x "
                f"{x:.6g}, y {y:.6g}, but {self._extent(grid_x, grid_y)}; check origin and crs")

    def _to_grid(self, position_world):
        """x, y of the grid's reference system and ellipsoidal height of (n, 3) positions."""
        origin = self.origin
        latitude, longitude, height = origin.to_geodetic(position_world)
        x, y = self._grid[4].transform(longitude, latitude)
        return np.asarray(x), np.asarray(y), height

    def _evaluate(self, position_world):
        grid_x, grid_y, spline, holes, _ = self._grid
        x, y, height = self._to_grid(position_world)
        step_x, step_y = grid_x[1] - grid_x[0], grid_y[1] - grid_y[0]
        bad = ((x < grid_x[0]) | (x > grid_x[-1]) | (y < grid_y[0]) | (y > grid_y[-1]))
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                bad |= holes.ev(np.clip(y + i * step_y, grid_y[0], grid_y[-1]),
                                np.clip(x + j * step_x, grid_x[0], grid_x[-1])) > 0
        z = spline.ev(y, x) + self.height_offset
        # The turn and scale between grid and east-north vary by less than 1e-3 within
        # 10 km, so one Jacobian at the middle serves the gradient.
        middle = position_world.mean(axis=0)
        probe = middle + np.array([[0, 0, 0], [10.0, 0, 0], [0, 10.0, 0]])
        px, py, _ = self._to_grid(probe)
        jacobian = np.array([[px[1] - px[0], px[2] - px[0]],
                             [py[1] - py[0], py[2] - py[0]]]) / 10.0
        slope = np.stack([spline.ev(y, x, dy=1), spline.ev(y, x, dx=1)], axis=1) @ jacobian
        gradient = np.column_stack([-slope, np.ones(len(z))])
        return np.where(bad, np.nan, height - z), gradient

    def constraints(self) -> tuple[Constraint, ...]:
        sigma = split_sigma(self.sigma, PARTS)["elevation_grid"]
        return (Constraint("elevation_grid", "always", sigma, True, self._evaluate, rough=True),)
