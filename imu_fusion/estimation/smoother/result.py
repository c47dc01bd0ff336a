"""What the smoother returns."""

from dataclasses import dataclass

import numpy as np

from imu_fusion.geometry.geodesy import LocalFrame

SAMPLE = np.dtype([
    ("stamp", "i8"), ("position_world", "f8", 3), ("vel_world", "f8", 3),
    ("quat_world_imu", "f8", 4), ("acc", "f8", 3), ("gyr", "f8", 3), ("gyr_bias", "f8", 3),
    ("acc_bias", "f8", 3), ("cov_position", "f8", (3, 3)), ("cov_velocity", "f8", (3, 3)),
    ("cov_attitude", "f8", (3, 3)), ("gyr_bias_sd", "f8", 3), ("acc_bias_sd", "f8", 3)])


@dataclass(frozen=True)
class SmootherResult:
    """What the smoother found.

    ``samples``: structured array (:data:`SAMPLE`), one per usable Imu sample; ``acc`` and
    ``gyr`` are corrected of the estimated errors, in the imu frame; ``cov_attitude`` is that
    of the rotation vector in imu axes. ``states``: name -> (values (n, k), sd (n, k)) of the
    optional states, in SI units. ``innovations``: name -> (stamp (m,), normalised
    innovations (m, 3)), white with unit variance where the model is right.
    ``cost``: of the trajectory before each step; ``iterations`` counts the steps.
    """

    samples: np.ndarray
    frame: LocalFrame
    states: dict
    innovations: dict
    cost: tuple
    iterations: int
    converged: bool
    events: object = None
    jump: object = None

    def summary(self):
        """One line."""
        jump = f", jump length {self.jump.length:.1f} m" if self.jump else ""
        state = "converged" if self.converged else "did not converge"
        return (f"{len(self.samples)} samples, {self.iterations} iterations ({state}), "
                f"cost {self.cost[-1]:.6g}{jump}")
