"""Initial orientation from a first interval at rest: Winkler 2025, eqs. (12)-(14).

The interval's samples are first carried into the axes of its first sample by
the gyroscope, so that slow turning does not blur the means, and a start in
motion still gives an initial orientation, with the uncertainty that it has.
"""

import math
from dataclasses import dataclass

import numpy as np

from imu_fusion.estimation.orientation.error_state import UNIFORM_VARIANCE
from imu_fusion.estimation.orientation.mag_rejection import (
    are_saturated,
    is_mag_sample,
    new_limit,
)
from imu_fusion.estimation.orientation.mag_repeats import REPEATS, is_stale
from imu_fusion.estimation.orientation.params import OrientationParams
from imu_fusion.geometry.rotation import quat_exp, quat_from_matrix, quat_multiply, quat_rotate
from imu_fusion.kernels import njit
from imu_fusion.sensors.saturation import saturated_axes

# Largest rate that can be a gyroscope's bias, and largest scatter of rate and specific
# force that passes as rest on a table or in a quiet hand (consumer MEMS, Nyquist-band noise).
_BIAS_LIMIT = 0.2          # rad/s
_REST_RATE_SCATTER = 0.05  # rad/s
_REST_ACC_SCATTER = 0.4    # m/s^2
_STANDARD_GRAVITY = 9.80665
# Field norms that differ by more than this factor from their median are outliers: hard iron
# and motion change them by less.
_NORM_FACTOR = 3.0
_GRAVITY_SPREAD = 0.04     # m/s^2, of gravity on the ground about the standard one
_NO_FORCE = 1e-3           # m/s^2
# Below this share of the field horizontal, heading is noise: the magnetic poles.
_HORIZONTAL_SHARE = 0.02


@dataclass(frozen=True)
class Alignment:
    """What the first interval says.

    quat_world_imu (4,) at its first sample; cov_attitude_world (3, 3) rad^2;
    field_world (3,) tesla or None; gyr_bias (3,), gyr_bias_sd rad/s; at_rest;
    has_heading: whether a magnetometer fixed the heading; inclination (rad, down
    positive) and field_norm (tesla) of the mean field, nan without one; gravity
    (m/s^2): norm of the mean specific force at rest, else the standard one; acc_bias_sd
    (m/s^2): as stated, or as large as that norm is off.
    """

    quat_world_imu: np.ndarray
    cov_attitude_world: np.ndarray
    field_world: np.ndarray | None
    gyr_bias: np.ndarray
    gyr_bias_sd: float
    at_rest: bool
    has_heading: bool
    inclination: float
    field_norm: float
    gravity: float
    acc_bias_sd: float


def triad(acc: np.ndarray, mag: np.ndarray, declination: float) -> np.ndarray:
    """Initial orientation, eqs. (12)-(14).

    Args:
        acc: (3,) specific force at rest, imu axes.
        mag: (3,) magnetic field, imu axes.
        declination: rad, positive where magnetic north lies east of true north.

    Returns:
        (3, 3) R_world_imu: rows are the world's east, north and up in imu axes.
    """
    up = acc / np.linalg.norm(acc)
    east_mag = np.cross(mag, up)
    east_mag /= np.linalg.norm(east_mag)
    north_mag = np.cross(up, east_mag)
    # Magnetic north lies D east of north: n_mag = cos D north + sin D east.
    east = math.cos(declination) * east_mag + math.sin(declination) * north_mag
    north = -math.sin(declination) * east_mag + math.cos(declination) * north_mag
    return np.array([east, north, up])


def within_range(mag: np.ndarray, par: np.ndarray) -> np.ndarray:
    """Mask (m,) of samples (m, 3) tesla with no axis at its limit, also of those before the limit
    was recognised."""
    found = new_limit(par)
    are_saturated(found, par, mag)
    return ~are_saturated(found, par, mag)


def calibrated(mag: np.ndarray, par: np.ndarray) -> np.ndarray:
    """Samples (m, 3) tesla less what is known of the magnetometer. par: of kernel_parameters."""
    sensor = par["sensor"][0]
    return np.ascontiguousarray((mag - sensor["mag_offset"])
                                @ np.reshape(sensor["mag_matrix"], (3, 3)).T)


def fields_of(stamps: np.ndarray, mag: np.ndarray,
              par: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of a magnetometer's samples (m,), (m, 3) tesla those that measure a field, calibrated."""
    usable = np.array([is_mag_sample(each) for each in mag], dtype=bool)
    usable[usable] = within_range(mag[usable], par)
    return stamps[usable], calibrated(mag[usable], par)


def usable_mags(mag: np.ndarray, par: np.ndarray) -> np.ndarray:
    """Mask (m,) of the samples of the first interval that measure the field.

    Left out are samples with an axis at its limit, also those before the limit was
    recognised, and outliers.

    Args:
        mag: (m, 3) tesla, finite, as the sensor reports it. par: of kernel_parameters.
    """
    if len(mag) == 0:
        return np.zeros(0, dtype=bool)
    usable = within_range(mag, par)
    norm = np.linalg.norm(mag, axis=1)
    if usable.any():
        median = np.median(norm[usable])
        usable &= (norm < _NORM_FACTOR * median) & (norm > median / _NORM_FACTOR)
    return usable


@njit
def _chain(stamps, gyr):
    """(n, 4) rotations from each sample's axes into the first's, by trapezoidal rates."""
    chain = np.empty((len(stamps), 4))
    quat = (0.0, 0.0, 0.0, 1.0)
    chain[0] = quat
    for i in range(1, len(stamps)):
        dt = (stamps[i] - stamps[i - 1]) * 1e-9
        twice = (gyr[i - 1, 0] + gyr[i, 0], gyr[i - 1, 1] + gyr[i, 1], gyr[i - 1, 2] + gyr[i, 2])
        quat = quat_multiply(quat, quat_exp(twice, 0.5 * dt))
        chain[i] = quat
    return chain


@njit
def _rotate_all(chain, vectors):
    out = np.empty_like(vectors)
    for i in range(len(vectors)):
        out[i] = quat_rotate(chain[i], vectors[i])
    return out


@njit
def _fresh(kept, chain, mag, noise_sd):
    """Mask (m,) of samples (m, 3) at attitudes (m, 4) that do not repeat an old one; ``kept``
    (1,) REPEATS, zero."""
    fresh = np.empty(len(mag), dtype=np.bool_)
    for i in range(len(mag)):
        fresh[i] = not is_stale(kept[0], 0, mag[i], chain[i], noise_sd)
    return fresh


def _first_samples(imu_stamps, mag_stamps, mag, chain, noise_sd):
    """Fresh samples (k, 3) of the magnetometer while there are attitudes (n, 4) of the Imu, and
    those of the attitudes at their time."""
    nearest = np.searchsorted(imu_stamps, mag_stamps)
    mag = np.ascontiguousarray(mag[:max(int(np.sum(nearest < len(chain))), 1)])
    at_mag = chain[np.clip(nearest[:len(mag)], 0, len(chain) - 1)]
    fresh = _fresh(np.zeros(1, REPEATS), at_mag, mag, noise_sd)
    return mag[fresh], at_mag[fresh]


def align(imu_stamps: np.ndarray, gyr: np.ndarray, acc: np.ndarray, mag_stamps: np.ndarray,
          mag: np.ndarray, params: OrientationParams,
          gyr_limits: float | np.ndarray = math.inf) -> Alignment:
    """Initial orientation, gyroscope bias and field from the first samples.

    Args:
        imu_stamps: (n,) int64 ns, n >= 1.
        gyr, acc: (n, 3) rad/s, m/s^2.
        mag_stamps, mag: (m,), (m, 3) tesla, calibrated; m may be 0.
        params: noise of the sensors, declination, and the yaw that turns the result about up.
        gyr_limits: rad/s, scalar or (3,). From a rate at its limit on nobody knows how the
            sensor turned: only samples before it are used.

    Returns:
        Alignment. Never raises for poor data: the covariance says how poor.
    """
    p = params.sensor
    at_rest, bias, bias_sd = _rest(imu_stamps, gyr, acc, p)
    lost = np.flatnonzero(saturated_axes(gyr, gyr_limits).any(axis=1))
    used = max(int(lost[0]), 1) if len(lost) else len(gyr)
    chain = _chain(imu_stamps[:used], gyr[:used] - bias)
    acc_bias_sd = p.acc_bias_sd
    if at_rest:
        # What the norm is off by is one component of the bias, and tells how large it is.
        off = abs(float(np.linalg.norm(acc.mean(axis=0))) - _STANDARD_GRAVITY) - _GRAVITY_SPREAD
        acc_bias_sd = math.hypot(acc_bias_sd, max(off, 0.0))
    up, gravity, tilt_variance = _tilt(chain, acc, at_rest, acc_bias_sd)

    nan = float("nan")
    field_first, inclination, field_norm, has_heading = None, nan, nan, False
    if len(mag):
        mag, at_mag = _first_samples(imu_stamps, mag_stamps, mag, chain, p.mag_noise_sd)
        field_first = _rotate_all(at_mag, mag).mean(axis=0)
        field_norm = float(np.linalg.norm(field_first))
        inclination = math.asin(np.clip(-(field_first @ up) / max(field_norm, 1e-30), -1, 1))
        has_heading = math.cos(inclination) > _HORIZONTAL_SHARE
    if has_heading and field_first is not None:
        r = triad(up, field_first, math.radians(params.declination_deg or 0.0))
        horizontal = field_norm * math.cos(inclination)
        heading_variance = ((p.mag_noise_sd / horizontal) ** 2 / len(mag)
                            + math.tan(inclination) ** 2 * tilt_variance)
    else:
        # Yaw zero, x towards east; where x is near the vertical, y towards north.
        north = np.cross(up, [1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
        r = triad(up, north, 0.0)
        heading_variance = UNIFORM_VARIANCE
    yaw_offset = math.radians(params.alignment.yaw_offset_deg)
    c, s = math.cos(yaw_offset), math.sin(yaw_offset)
    r = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ r
    return Alignment(
        quat_world_imu=np.array(quat_from_matrix(r)),
        cov_attitude_world=np.diag([tilt_variance, tilt_variance, heading_variance]),
        field_world=None if field_first is None else r @ field_first,
        gyr_bias=bias, gyr_bias_sd=float(bias_sd), at_rest=at_rest, has_heading=has_heading,
        inclination=inclination, field_norm=field_norm, gravity=gravity,
        acc_bias_sd=acc_bias_sd)


def _rest(stamps, gyr, acc, p):
    """Whether the first interval is at rest, and the bias (3,) with its standard deviation."""
    n = len(stamps)
    duration = max((stamps[-1] - stamps[0]) * 1e-9, 1e-2)
    mean = gyr.mean(axis=0)
    at_rest = bool(n > 2 and np.linalg.norm(mean) < _BIAS_LIMIT
                   and gyr.std(axis=0).max() < _REST_RATE_SCATTER
                   and acc.std(axis=0).max() < _REST_ACC_SCATTER)
    if not at_rest:
        return at_rest, np.zeros(3), p.gyro_bias_sd
    # Hands are never quite still: what the halves disagree by is not known as bias.
    drift = np.abs(gyr[:n // 2].mean(axis=0) - gyr[n // 2:].mean(axis=0)).max()
    return at_rest, mean, math.hypot(p.gyro_noise_density / math.sqrt(duration), 0.5 * drift)


def _tilt(chain, acc, at_rest, acc_bias_sd):
    """Up (3,) in the axes of the first sample, gravity (m/s^2), and the tilt's variance (rad^2).

    chain: (k, 4) of :func:`_chain`, of the first samples alone where later ones are not to be used.
    """
    used = len(chain)
    acc_first = _rotate_all(chain, np.ascontiguousarray(acc[:used]))
    up_force = acc_first.mean(axis=0)
    gravity = float(np.linalg.norm(up_force))
    if gravity < _NO_FORCE:
        # Free fall or no accelerometer: any tilt is as good as any other.
        return np.array([0.0, 0.0, 1.0]), gravity, 1.0
    # A quarter of the interval per independent mean: motion is correlated.
    wander = acc_first.std(axis=0).max() / 2.0 if not at_rest else 0.0
    surplus = abs(gravity - _STANDARD_GRAVITY) if not at_rest else 0.0
    if used < len(acc):
        # Too short to show how the force wanders: its norm does, whatever the attitude.
        norm = np.linalg.norm(acc, axis=1)
        wander = max(wander, math.sqrt(np.mean((norm - _STANDARD_GRAVITY) ** 2)))
    variance = min((acc_bias_sd ** 2 + wander ** 2 + surplus ** 2) / gravity ** 2, 1.0)
    # In motion what is seen is motion, too.
    return (up_force / np.linalg.norm(up_force), gravity if at_rest else _STANDARD_GRAVITY,
            variance)
