"""Parameters of the orientation estimator."""

from dataclasses import dataclass

from imu_fusion.errors import ParameterError
from imu_fusion.parameters.declare import Parameters, param


@dataclass(frozen=True)
class OrientationParams(Parameters):
    """What the orientation estimator can be told."""

    method: str = param("fusion", choices=("fusion", "gyro_mag"),
                        doc="fusion: error-state filter over all three sensors; gyro_mag: gyroscope and "
                            "magnetometer alone after the start, with estimate_bias false "
                            "Winkler 2025 as printed.")
    mode: str = param("causal", choices=("causal", "smoothed"),
                      doc="smoothed: run() on a whole recording also looks ahead (fusion only).")
    lag: float = param(0.0, unit="s", low=0, high=10,
                       doc="fusion, causal: rows come once more, corrected by what is seen one to two "
                           "times this later; 0: they do not.")
    world_frame: str = param("enu", choices=("enu", "ned", "nwu"),
                             doc="World axes of the published orientation.")
    declination_deg: float | None = param(
        None, unit="deg", low=-180, high=180,
        doc="Magnetic declination, positive east; unset: 0, north is magnetic north.")
    yaw_offset_deg: float = param(0.0, unit="deg", low=-360, high=360,
                                  doc="Turns the orientation about the vertical.")
    heading_anchor: str = param(
        "rest", choices=("rest", "field"),
        doc="rest: heading is what the magnetometer shows in the first interval; field: it "
            "follows the magnetometer's calibration as that becomes known.")
    heading_sd_deg: float = param(1.0, unit="deg", low=0, high=180,
                                  doc="Uncertainty of the heading that the first interval shows.")
    alignment_duration: float = param(1.0, unit="s", low=0.05, high=60,
                                      doc="First interval, from which the orientation starts.")
    gyro_noise_density: float = param(3e-4, unit="rad/s/sqrt(Hz)", low=1e-9, high=1,
                                     doc="Gyroscope noise.")
    gyro_bias_sd: float = param(0.01, unit="rad/s", low=0, high=1,
                               doc="Standard deviation of a bias that no rest has shown.")
    gyro_bias_walk: float = param(2e-5, unit="rad/s/sqrt(s)", low=0, high=1,
                                 doc="Random walk of the gyroscope bias.")
    gyro_range: tuple[float, ...] | None = param(
        None, unit="rad/s", low=1e-3, length=(1, 3),
        doc="Largest rate the gyroscope reports, one value or one per axis; unset: found "
            "from flat tops.")
    acc_noise_density: float = param(2e-3, unit="m/s^2/sqrt(Hz)", low=1e-9, high=10,
                                     doc="Accelerometer noise.")
    acc_bias_sd: float = param(0.05, unit="m/s^2", low=0, high=10,
                               doc="Standard deviation of the accelerometer bias.")
    axes_sd: float = param(0.005, unit="rad", low=0, high=1,
                           doc="Uncertainty of the sensor's axes in its case, part of the "
                               "attitude's covariance.")
    mag_range: tuple[float, ...] | None = param(
        None, unit="T", low=1e-6, length=(1, 3),
        doc="Largest field the magnetometer reports, one value or one per axis, before mag_offset "
            "and mag_matrix; unset: found from flat tops.")
    mag_noise_sd: float = param(1e-6, unit="T", low=1e-12, high=1e-4,
                                doc="Noise of one magnetometer sample.")
    mag_offset: tuple[float, ...] = param((0.0, 0.0, 0.0), unit="T", length=3,
                                          doc="Hard iron, subtracted from every sample.")
    mag_matrix: tuple[float, ...] = param(
        (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), length=9,
        doc="Soft iron, row by row; multiplies the sample after the offset.")
    mag_reliability: float = param(5.0, low=0, doc="p of the weight (10) of Winkler 2025.")
    field_sd: float = param(0.05, low=0, high=1,
                            doc="gyro_mag as printed: wander of the local field, relative "
                                "to its norm.")
    field_time: float = param(20.0, unit="s", low=1e-3,
                              doc="gyro_mag as printed: time constant of that wander.")
    gyro_delay: float | None = param(
        None, unit="s", low=-0.1, high=0.1,
        doc="How late rates and specific forces are stamped; these sensors alone cannot tell. "
            "Unset: 0, give or take gyro_delay_sd.")
    gyro_delay_sd: float = param(
        0.004, unit="s", low=0, high=0.1,
        doc="Standard deviation of a gyroscope delay that is not given, part of the attitude's "
            "covariance while turning.")
    mag_delay: float | None = param(
        None, unit="s", low=-0.1, high=0.1,
        doc="How late a magnetometer sample is stamped; unset: estimated, except "
            "by gyro_mag as printed, which takes that of the gyroscope.")
    mag_delay_sd: float = param(0.01, unit="s", low=0, high=0.1,
                                doc="Standard deviation of a magnetometer delay that is not given.")
    block: float = param(0.02, unit="s", low=1e-3, high=1, doc="Time between corrections.")
    gyro_scale_sd: float = param(0.005, low=0, high=0.2,
                                doc="Standard deviation of gyroscope scale and misalignment.")
    estimate_bias: bool = param(True, doc="Whether gyroscope bias and scale are estimated.",
                                read_only=False)
    use_acc: bool = param(
        True, doc="fusion: whether the accelerometer is used after the start.")
    velocity_walk: float = param(0.1, unit="m/s^2/sqrt(Hz)", low=0,
                                 doc="What the specific force does not tell of the motion.")
    velocity_sd: float = param(0.6, unit="m/s", low=1e-3,
                               doc="Velocity of the motion, per axis, about its mean.")
    velocity_time: float = param(0.3, unit="s", low=1e-3, doc="Its correlation time.")
    position_sd: float = param(0.6, unit="m", low=1e-3,
                               doc="Extent of the motion, per axis, about its mean.")
    position_time: float = param(0.3, unit="s", low=1e-3, doc="Its correlation time.")
    local_field_sd: float = param(0.01, low=0, high=1,
                                  doc="Local deviation of the field, relative to its norm.")
    local_field_time: float = param(0.3, unit="s", low=1e-3,
                                    doc="Time in which a moving sensor leaves it behind.")
    field_walk: float = param(1e-4, unit="1/sqrt(s)", low=0, high=1,
                              doc="Drift of the field, relative to its norm.")
    mag_sd: float = param(0.03, low=1e-4, high=1,
                          doc="Disturbance of the field in motion, relative to its norm.")
    norm_deviation_factor: float = param(
        3.0, low=0, doc="That disturbance grows by this times the deviation of the norm.")
    mag_offset_sd: float = param(0.03, low=0, high=1,
                                 doc="Hard iron left over by calibration, relative to the norm.")
    mag_matrix_sd: float = param(0.02, low=0, high=1,
                                 doc="Soft iron and misalignment left over by calibration.")
    rest_rate: float = param(0.04, unit="rad/s", low=0,
                             doc="Largest deviation of the rate from its mean at rest.")
    rest_force: float = param(0.5, unit="m/s^2", low=0,
                              doc="Largest deviation of the specific force from its mean at rest.")
    rest_time: float = param(0.5, unit="s", low=0, doc="Time after which rest counts.")
    rest_rate_sd: float = param(0.006, unit="rad/s", low=1e-6,
                                doc="Rate of a hand or table at rest.")
    surge_sd: float = param(200.0, unit="rad/s^2", low=0,
                            doc="Change of the angular acceleration (surge) of an axis beyond its "
                                "gyroscope's limit.")
    surge_time: float = param(0.04, unit="s", low=1e-3,
                              doc="Time after which the slope at the limit is forgotten.")
    max_mag_lag: float = param(0.1, unit="s", low=0, high=10,
                               doc="Magnetometer samples that arrive later are dropped.")
    max_gap: float = param(0.1, unit="s", low=1e-3,
                           doc="A longer step between Imu samples counts as a gap.")
    restart_gap: float = param(1.0, unit="s", low=1e-2,
                               doc="After a longer one the attitude is anybody's guess: the estimator "
                                   "aligns anew.")
    gap_rate_sd: float = param(1.0, unit="rad/s", low=0,
                               doc="Rate that may have gone unseen in a gap.")

    def __post_init__(self):
        super().__post_init__()
        if self.mode == "smoothed" and self.method != "fusion":
            raise ParameterError("parameter 'mode': 'smoothed' needs method 'fusion', "
                                 f"not '{self.method}'")
        if self.lag and (self.method, self.mode) != ("fusion", "causal"):
            raise ParameterError("parameter 'lag': needs method 'fusion' and mode 'causal', not "
                                 f"'{self.method}' and '{self.mode}'")
