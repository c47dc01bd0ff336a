"""Gravity, rotation and magnetic field of the Earth where a recording was made."""

from dataclasses import dataclass

import numpy as np

from imu_fusion.estimation.smoother.measurements.magnetometer import MICRO
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.geometry.geodesy import LocalFrame
from imu_fusion.geometry.gravity import earth_rate_world, normal_gravity
from imu_fusion.geometry.magnetic_field import decimal_year, magnetic_field_world


@dataclass(frozen=True)
class Surroundings:
    """``gravity`` at the origin (m/s^2), rate of the Earth ``earth_rate`` (3,) rad/s and
    ``magnetic_field`` (3,) microtesla in the world."""

    gravity: float
    earth_rate: np.ndarray
    magnetic_field: np.ndarray


def surroundings_of(params: SmootherParams, frame: LocalFrame, stamp: int, magnetic: bool
                    ) -> Surroundings:
    """Gravity and, with a magnetometer, the magnetic field: as given, or those at the origin of the
    frame and at a stamp (ns)."""
    gravity = params.gravity
    if gravity is None:
        gravity = float(normal_gravity(frame.latitude_deg, frame.height))
    field = np.zeros(3)
    if magnetic and params.magnetic_field is not None:
        field = np.array(params.magnetic_field)
    elif magnetic:
        field = magnetic_field_world(frame.latitude_deg, frame.longitude_deg, frame.height,
                                     decimal_year(stamp))
    return Surroundings(gravity, earth_rate_world(frame.latitude_deg), field * MICRO)
