"""When the sensor is at rest."""

import math

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation.state import MOST_REFUTING
from imu_fusion.kernels import njit

REST_MEMORY = 0.25        # s, of the means that the rest detector compares with
_REST_TURN = 1.5e-3       # rad/s per axis: slower turning than 0.5 deg/s passes as rest
_SDS2 = 9.0               # squared standard deviations of the bias within which a mean rate is bias
_FORCE_OFF = 0.05         # of gravity: by how much a force at rest can differ from it
_SURE_TURN = 0.2           # rad, that the force would have turned by where a bias is refuted
_STEADY = 0.3             # of the rate, by which its mean may change where it is bias
_STEEP = 2.0              # tan of the angle to the vertical within which a rate can be a turn


@njit
def is_still(s, p):
    """Rest: rate and force have kept to their short-term means, and the mean rate is bias.

    Slow turning is told from rest by the bias' own uncertainty.
    """
    rest, step = s.rest, s.step
    part = min(step.dt / REST_MEMORY, 1.0)
    rate2 = 0.0
    force2 = 0.0
    mean2 = 0.0
    limit2 = 0.0
    for i in range(3):
        rest.mean_rate[i] += part * (step.gyr[i] - rest.mean_rate[i])
        rest.mean_force[i] += part * (step.force[i] - rest.mean_force[i])
        rate2 += (step.gyr[i] - rest.mean_rate[i]) ** 2
        force2 += (step.force[i] - rest.mean_force[i]) ** 2
        mean2 += (rest.mean_rate[i] - s.gyro_bias[i]) ** 2
        limit2 += s.cov[es.GYRO_BIAS + i, es.GYRO_BIAS + i] + _REST_TURN ** 2
    enough = p.fusion.rest_time * 1e9
    if rate2 > p.fusion.rest_rate ** 2 or force2 > p.rest_force ** 2:
        rest.since = rest.changed = s.stamp
        rest.settled = 0
    elif mean2 <= _SDS2 * limit2:
        rest.settled = 0
    else:
        rest.since = s.stamp
        if rest.settled == 0 and (s.stamp - rest.changed > enough or _is_known_to_refute(rest)):
            rest.settled = s.stamp
            for i in range(3):
                rest.settled_force[i] = rest.mean_force[i]
                rest.settled_rate[i] = rest.mean_rate[i]
                rest.turn[i] = 0.0
    return s.stamp - rest.since > enough


@njit
def refuted_turn(s, p):
    """Angle (rad) by which the sensor would have turned so far in a rest that the bias as known so
    far takes for motion; 0 where there is none.

    A force of gravity's size that stands still in imu axes points up. A body turns about it
    unseen, as a vehicle in a circle does; any other turn would have moved it. So a steady rate that
    points elsewhere is bias.
    """
    rest = s.rest
    if not p.use_acc or rest.settled == 0:
        return 0.0
    if _is_known_to_refute(rest):
        return _SURE_TURN
    force = rest.mean_force
    size = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    if abs(size - s.gravity) >= _FORCE_OFF * s.gravity:    # or there is none at all
        rest.settled = 0
        return 0.0
    along = across2 = moved2 = rate2 = changed2 = 0.0
    for i in range(3):
        rest.turn[i] += (s.step.gyr[i] - s.gyro_bias[i]) * s.step.dt
        along += rest.turn[i] * force[i] / size
        across2 += rest.turn[i] ** 2
        moved2 += ((force[i] - rest.settled_force[i]) / size) ** 2
        rate2 += (rest.settled_rate[i] - s.gyro_bias[i]) ** 2
        changed2 += (rest.mean_rate[i] - rest.settled_rate[i]) ** 2
    across2 -= along ** 2
    if moved2 > _SURE_TURN ** 2 or changed2 > _STEADY ** 2 * rate2:
        rest.settled = 0    # it does move: stand still anew
        rest.changed = s.stamp
        return 0.0
    turned = math.sqrt(max(across2, 0.0))
    if along ** 2 > _STEEP ** 2 * across2 or turned < _SURE_TURN + 3.0 * math.sqrt(moved2):
        return 0.0
    return turned


@njit
def _is_known_to_refute(rest):
    """Whether the smoother knows what this rest, at its beginning, is to show."""
    known = False
    for n in range(MOST_REFUTING):
        known |= rest.refuting[n] == rest.changed != 0
    return known
