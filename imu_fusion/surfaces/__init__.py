"""Where the body can be: surfaces that turn into soft constraints of the smoother."""

from imu_fusion.surfaces.constraint import Constraint, Surface  # noqa: F401
