"""The geomagnetic main field: the World Magnetic Model through pygeomag."""

import datetime
import functools

import numpy as np
from pygeomag import GeoMag

from imu_fusion.errors import ParameterError

# First year of each model's five-year span that pygeomag carries.
_MODELS = {2010: "wmm/WMM_2010.COF", 2015: "wmm/WMM_2015v2.COF",
           2020: "wmm/WMM_2020.COF", 2025: "wmm/WMM_2025.COF"}


@functools.cache
def _model(epoch):
    return GeoMag(coefficients_file=_MODELS[epoch])


def decimal_year(stamp: int) -> float:
    """Decimal year of a stamp in nanoseconds since 1970 (UTC)."""
    seconds = int(stamp) // 10**9
    year = datetime.datetime.fromtimestamp(seconds, datetime.UTC).year
    start, stop = (datetime.datetime(y, 1, 1, tzinfo=datetime.UTC).timestamp()
                   for y in (year, year + 1))
    return year + (seconds - start) / (stop - start)


def magnetic_field_world(latitude_deg: float, longitude_deg: float, height: float,
                         year: float) -> np.ndarray:
    """Field vector (3,) in tesla, east-north-up, of the World Magnetic Model.

    Args:
        latitude_deg, longitude_deg: geodetic, degrees.
        height: ellipsoidal height, m.
        year: decimal year; the model of its five-year span is used.

    Raises:
        ParameterError: no model for that year.
    """
    epoch = int(year // 5) * 5
    if epoch not in _MODELS:
        raise ParameterError(
            f"no World Magnetic Model for the year {year:.1f} (2010 to 2030): are the stamps "
            "Unix time? Otherwise give the field by the parameter magnetic_field")
    r = _model(epoch).calculate(glat=float(latitude_deg), glon=float(longitude_deg),
                                alt=float(height) * 1e-3, time=float(year))
    return np.array([r.y, r.x, -r.z]) * 1e-9


def declination(latitude_deg: float, longitude_deg: float, height: float, year: float) -> float:
    """Declination in rad, positive when magnetic north is east of true north."""
    field = magnetic_field_world(latitude_deg, longitude_deg, height, year)
    return np.arctan2(field[0], field[1])
