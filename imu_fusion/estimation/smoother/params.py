"""Parameters of the smoother."""

from dataclasses import dataclass

from imu_fusion.errors import ParameterError
from imu_fusion.parameters.declare import Parameters, param


@dataclass(frozen=True)
class SmootherParams(Parameters):
    """Noise, priors, optional states and the iteration. A prior of zero leaves an optional
    state out. Defaults: tables 3 to 5 of Fang et al. 2020 (a phone and a GNSS logger)."""

    method: str = param("iterated", doc="Estimator: the iterated smoother or the paper's",
                        choices=("iterated", "extended_rts"))

    gyro_noise_density: float = param(1.75e-3, doc="Gyroscope white noise", unit="rad/s/sqrt(Hz)",
                                     low=1e-7, high=1.0)
    acc_noise_density: float = param(1e-2, doc="Accelerometer white noise, with the motion that "
                                     "the sampling cannot follow", unit="m/s^2/sqrt(Hz)",
                                     low=1e-6, high=10.0)
    gyro_bias_sd: float = param(0.0873, doc="Initial gyroscope bias", unit="rad/s", low=1e-6)
    acc_bias_sd: float = param(0.2, doc="Initial accelerometer bias", unit="m/s^2", low=1e-6)
    gyro_bias_walk: float = param(0.0, doc="Random walk of the gyroscope bias",
                                 unit="rad/s/sqrt(s)", low=0.0)
    acc_bias_walk: float = param(0.0, doc="Random walk of the accelerometer bias",
                                 unit="m/s^2/sqrt(s)", low=0.0)
    gyro_scale_sd: float = param(0.0, doc="Gyroscope scale errors as states", low=0.0, high=0.5)
    acc_matrix_sd: float = param(0.0, doc="Accelerometer scale errors and misalignments (nine, "
                                 "Winkler's C) as states", low=0.0, high=0.5)
    gyro_range: float = param(0.0, doc="Range of the gyroscope, beyond which it is clipped; 0: "
                             "unlimited", unit="rad/s", low=0.0)
    acc_range: float = param(0.0, doc="Range of the accelerometer; 0: unlimited", unit="m/s^2",
                             low=0.0)
    max_gap: float = param(0.1, doc="Longest step between Imu samples that counts as sampled; "
                           "longer ones are bridged with unknown motion", unit="s", low=1e-3)
    unknown_gyro_density: float = param(0.1, doc="Noise of the rate where it was clipped or not "
                                       "recorded", unit="rad/s/sqrt(Hz)", low=1e-3)
    unknown_acc_density: float = param(2.0, doc="Noise of the force where it was clipped or not "
                                       "recorded", unit="m/s^2/sqrt(Hz)", low=1e-3)

    fix_sd: tuple[float, ...] = param((3.0, 3.0, 5.0), doc="Position noise east, north, up, "
                                      "where a fix carries no covariance", unit="m", low=1e-4,
                                      length=3)
    gnss_covariances: bool = param(True, doc="Take the covariances that fixes and velocities carry; "
                                   "false: fix_sd and velocity_sd for all of them")
    velocity_sd: tuple[float, ...] = param((0.1, 0.1, 0.3), doc="Velocity noise east, north, up, "
                                           "where a velocity carries no covariance", unit="m/s",
                                           low=1e-4, length=3)
    fix_loss_scale: float = param(6.0, doc="Scale of the Cauchy loss on fixes and velocities, in "
                                  "standard deviations; 0: squared loss", low=0.0)
    gnss_position_error_sd: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), doc="Wandering (Gauss-Markov) GNSS position error east, north, up, as "
        "states", unit="m", low=0.0, length=3)
    gnss_position_error_tau: float = param(30.0, doc="Its correlation time", unit="s", low=0.1)
    gnss_velocity_error_sd: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), doc="Wandering (Gauss-Markov) GNSS velocity error east, north, up, as "
        "states; receivers filter their velocities", unit="m/s", low=0.0, length=3)
    gnss_velocity_error_tau: float = param(1.0, doc="Its correlation time", unit="s", low=0.01)
    gnss_even_stamps: bool = param(False, doc="Fixes are taken at an even rate and their stamps, "
                                   "times of arrival, jitter: put them back on a straight line")
    gnss_min_interval: float = param(0.0, doc="Fixes and velocities that follow the last one used "
                                     "by less are left out: the filter of a receiver makes "
                                     "neighbours repeat each other's errors", unit="s", low=0.0)
    gnss_time_offset_sd: float = param(0.0, doc="Delay of the GNSS stamps as a state", unit="s",
                                       low=0.0, high=2.0)
    velocity_time_offset_sd: float = param(0.0, doc="Further delay of velocities alone as a state; "
                                           "receivers that difference positions report late",
                                           unit="s", low=0.0, high=2.0)
    gnss_lever_arm: tuple[float, ...] = param((0.0, 0.0, 0.0), doc="Antenna in the imu frame",
                                              unit="m", length=3)
    gnss_lever_arm_sd: float = param(0.0, doc="Its uncertainty, as states", unit="m", low=0.0)

    mag_sd: float = param(5e-6, doc="Magnetometer noise of one sample", unit="T", low=1e-9)
    mag_bias_sd: float = param(5e-6, doc="Magnetometer bias", unit="T", low=1e-9)
    mag_scale_sd: float = param(0.1, doc="Magnetometer scale errors", low=1e-6)
    mag_loss_scale: float = param(6.0, doc="Scale of the Cauchy loss on the magnetometer, in "
                                  "standard deviations; 0: squared loss", low=0.0)

    body_height: float = param(0.0, doc="Height of the sensor above the surface, or of "
                               "the point at surface_lever_arm", unit="m")
    body_height_sd: float = param(0.0, doc="Its uncertainty, as a state", unit="m", low=0.0)
    surface_lever_arm: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), doc="Point that is held on the surface (skis, wheels), in the imu frame",
        unit="m", length=3)
    surface_lever_arm_sd: float = param(0.0, doc="Its uncertainty, as states", unit="m", low=0.0)
    surface_interval: float = param(
        0.01, doc="Time after which a deviation from the surface counts as a new one: sigma is that "
        "of rows so far apart, and what they say per second does not depend on the rate of the "
        "Imu. Longer: slower deviations, a weaker surface", unit="s", low=1e-4, high=100.0)
    surface_windows: tuple[float, ...] = param(
        (), doc="Times since the first Imu sample in which the surface holds, start and stop of "
        "each window in turn; empty: always (hills: before take-off and after touch-down)",
        unit="s", low=0.0)
    takeoff: float | None = param(None, doc="Take-off from a hill, since the first Imu sample; "
                                  "detected when unset, and refined in either case", unit="s",
                                  low=0.0)
    touchdown: float | None = param(None, doc="Touch-down on a hill, in the same way", unit="s",
                                    low=0.0)
    event_margin: float = param(0.3, doc="Time around take-off and touch-down in which the body "
                                "may leave the surface", unit="s", low=0.0)

    attitude_sd: float = param(0.5, doc="Initial attitude", unit="rad", low=1e-3, high=3.2)
    position_sd: float = param(100.0, doc="Initial position, about the first fix", unit="m",
                               low=1e-2)
    speed_sd: float = param(30.0, doc="Initial velocity", unit="m/s", low=1e-3)
    gravity: float | None = param(None, doc="Gravity; WGS84 at the first fix when unset",
                                  unit="m/s^2", low=9.5, high=10.0)
    magnetic_field: tuple[float, ...] | None = param(
        None, doc="Magnetic field east, north, up; the World Magnetic Model at the first fix and "
        "stamp when unset", unit="T", length=3)

    max_iterations: int = param(25, doc="Most Gauss-Newton steps", low=1, high=200)
    tolerance: float = param(1e-3, doc="Converged when no position (m), velocity (m/s) and "
                             "attitude (rad) moves by more", low=1e-9)
    cost_tolerance: float = param(0.05, doc="Converged as well when the cost (half a sum of squared "
                                  "standard deviations) changes by less", low=0.0)

    def __post_init__(self):
        super().__post_init__()
        windows = self.surface_windows
        if len(windows) % 2 or any(b <= a for a, b in zip(windows, windows[1:])):
            raise ParameterError(f"parameter 'surface_windows': {list(windows)} s are not pairs of "
                                 "start and stop that ascend")
        if None not in (self.takeoff, self.touchdown) and self.touchdown <= self.takeoff:
            raise ParameterError(f"parameter 'touchdown': {self.touchdown:g} s is not after the "
                                 f"take-off at {self.takeoff:g} s")
