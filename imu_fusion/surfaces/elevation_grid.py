"""A digital elevation model as a surface (ESRI ASCII or GeoTIFF, read by rasterio)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import RectBivariateSpline

from imu_fusion.errors import LayoutError
from imu_fusion.surfaces.constraint import Constraint, Surface, split_sigma


def _libraries():
    try:
        import pyproj
        import rasterio
    except ImportError as error:
        raise LayoutError("surface of type elevation_grid needs rasterio and pyproj: "
                          "pip install 'imu_fusion[terrain]'") from error
    return pyproj, rasterio


@dataclass(frozen=True)
class ElevationGrid(Surface):
    """Heights on a regular grid of the reference system ``crs``.

    Grids carry heights above the geoid as a rule; ``height_offset`` (the undulation, m)
    is added to make them ellipsoidal. Between the nodes a bicubic spline interpolates,
    so the gradient is continuous; cells without data and places outside give NaN.
    """

    file: str
    crs: str
    height_offset: float = 0.0
    sigma: float | dict = 0.1

    @cached_property
    def _grid(self):
        pyproj, rasterio = _libraries()
        try:
            with rasterio.open(self.file) as source:
                heights = source.read(1, masked=True).astype(float).filled(np.nan)
                transform = source.transform
        except rasterio.errors.RasterioError as error:
            raise LayoutError(f"elevation grid {self.file}: {error}") from error
        if transform.b or transform.d:
            raise LayoutError(f"elevation grid {self.file} is rotated; resample it to axes "
                              "of its reference system")
        rows, columns = heights.shape
        if min(rows, columns) < 4:
            raise LayoutError(f"elevation grid {self.file}: {rows} x {columns} nodes, "
                              "a bicubic spline needs 4 x 4")
        x = transform.c + transform.a * (np.arange(columns) + 0.5)
        y = (transform.f + transform.e * (np.arange(rows) + 0.5))[::-1]
        heights = heights[::-1]
        missing = np.isnan(heights)
        if missing.all():
            raise LayoutError(f"elevation grid {self.file} holds no data")
        spline = RectBivariateSpline(y, x, np.where(missing, np.nanmean(heights), heights))
        # The cubic patch of a cell reaches two nodes out: any hole there spoils it.
        holes = RectBivariateSpline(y, x, missing.astype(float), kx=1, ky=1)
        transformer = pyproj.Transformer.from_crs("EPSG:4979", self.crs, always_xy=True)
        return x, y, spline, holes, transformer

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

    def constraints(self):
        sigma = split_sigma(self.sigma, ["elevation_grid"])["elevation_grid"]
        return (Constraint("elevation_grid", "always", sigma, True, self._evaluate),)
