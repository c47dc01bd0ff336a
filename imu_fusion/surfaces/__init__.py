"""Where the body can be: surfaces that turn into soft constraints of the smoother."""

from imu_fusion.surfaces.constraint import Constraint, Surface  # noqa: F401
from imu_fusion.surfaces.load import load_surface, surface_from_mapping  # noqa: F401
