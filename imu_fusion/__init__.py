"""imu_fusion: orientation, acceleration fields and trajectories from inertial sensors.

Conventions, used everywhere in this package
============================================

Time
    Stamps are ``int64`` nanoseconds from message headers. A time step is an
    integer difference first and float seconds after that. Estimators never ask
    a clock.

Frames
    Frames are words. ``world`` is east-north-up (ENU, REP 103/105), ``imu`` is
    the frame in which an Imu message reports (its ``frame_id``). A rotation is
    named target first: ``v_world = R_world_imu @ v_imu``, so that adjacent names
    cancel. A vector's name ends in its frame: ``gravity_world``, ``omega_imu``.
    North-east-down and hill frames exist only where a paper or a report needs
    them.

Rotations
    Quaternions are Hamilton, active, stored ``x, y, z, w``, shape ``(..., 4)``.
    The attitude error is local: ``q_true = q_est * Exp(dtheta_imu)``, and an
    attitude covariance is that of ``dtheta_imu`` in rad^2.

Units
    ``gyr`` rad/s, ``acc`` specific force in m/s^2 (+g upwards at rest, REP 145),
    ``mag`` tesla, positions metres, latitude and longitude degrees (WGS84).
    Angles are radians unless the name ends in ``_deg``.

Uncertainty
    ``_sd`` is a standard deviation, ``_density`` a noise density per sqrt(Hz),
    ``_walk`` the density of a random walk, ``cov_*`` a covariance. In messages,
    an Imu covariance whose first element is -1 says that the quantity is
    absent; all zeros mean that the covariance is unknown.
"""

__version__ = "0.1.0"
