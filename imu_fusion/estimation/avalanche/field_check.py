"""Whether attitudes leave the Earth's field where it is: Winkler 2025, eqs. (25)-(27).

A necessary check and not a sufficient one: a rotation about the field changes nothing in it. With
the field 63 deg below the horizon, that is most of the heading.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # its parts are loaded where they are first used


@dataclass(frozen=True)
class FieldCheck:
    """``field_world`` (n, 3) T of each sample, eq. (26); mean and standard deviation of its norm
    (T), inclination (down positive) and declination (degrees), eqs. (25) and (27)."""

    field_world: np.ndarray
    norm: float
    norm_sd: float
    inclination_deg: float
    inclination_sd_deg: float
    declination_deg: float
    declination_sd_deg: float


def angles_deg(field_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inclination and declination (...) deg of fields (..., 3), eq. (27)."""
    norm = np.linalg.norm(field_world, axis=-1)
    return (np.degrees(np.arcsin(-field_world[..., 2] / norm)),
            np.degrees(np.arctan2(field_world[..., 0], field_world[..., 1])))


def check_field(quat: np.ndarray, mag: np.ndarray) -> FieldCheck:
    """The field in world axes of attitudes (n, 4) and calibrated samples (n, 3) T beside them."""
    field = scipy.spatial.transform.Rotation.from_quat(quat).apply(mag)
    norm = np.linalg.norm(field, axis=1)
    inclination, declination = angles_deg(field)
    return FieldCheck(field, float(norm.mean()), float(norm.std()), float(inclination.mean()),
                      float(inclination.std()), float(declination.mean()),
                      float(declination.std()))
