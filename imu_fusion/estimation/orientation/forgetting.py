"""What is known no longer: after a gap, and where a rest refutes what was thought to be known."""

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation.rows import FLAG_GAP
from imu_fusion.estimation.orientation.state import MOST_REFUTING
from imu_fusion.geometry.rotation import quat_rotate
from imu_fusion.kernels import njit

_LASTING = 1.0    # s, in which a body that nobody sees turns goes on to turn as it did


@njit
def allow_for_gap(s, p):
    """Nothing is known of the motion in a gap."""
    s.step.flags |= FLAG_GAP
    s.counts.gaps += 1
    s.rest.since = s.rest.changed = s.stamp
    s.rest.settled = 0
    unseen = min((p.gap.rate_sd * s.step.dt) ** 2, es.UNIFORM_VARIANCE)
    for i in range(3):
        s.block.noise[es.ATTITUDE + i] += unseen
    _forget_motion(s, p)


@njit
def allow_for_stuck(s, p, lasted, is_new):
    """The gyroscope is stuck since ``lasted`` s: nothing is known of how the body turns.

    is_new: whether it was not known before."""
    s.step.flags |= FLAG_GAP
    s.rest.since = s.rest.changed = s.stamp
    s.rest.settled = 0
    if is_new:
        _forget_motion(s, p)
    time = lasted if is_new else s.step.dt
    for i in range(3):
        if s.cov[es.ATTITUDE + i, es.ATTITUDE + i] < es.UNIFORM_VARIANCE:
            s.block.noise[es.ATTITUDE + i] += p.gap.rate_sd ** 2 * time * min(lasted, _LASTING)


@njit
def realign(s, p, turned):
    """A rest has refuted bias and attitude: what is known of them, and of what they were thought to
    show, begins anew. turned: rad, what the bias has turned the attitude by in this rest alone."""
    s.counts.realigned += 1
    rest, noise = s.rest, s.block.noise
    for n in range(MOST_REFUTING):
        if rest.refuting[n] == 0 or rest.refuting[n] == rest.changed:
            rest.refuting[n] = rest.changed
            break
    force = rest.mean_force
    up = quat_rotate(s.quat_world_imu, (force[0], force[1], force[2]))
    unsure = (up[0] ** 2 + up[1] ** 2) / (up[0] ** 2 + up[1] ** 2 + up[2] ** 2) + turned ** 2
    for i in range(3):
        noise[es.ATTITUDE + i] += unsure
        noise[es.GYRO_BIAS + i] += (rest.mean_rate[i] - s.gyro_bias[i]) ** 2
        noise[es.ACC_BIAS + i] += p.sensor.acc_bias_sd ** 2
        for j in range(3):
            noise[es.GYRO_SCALE + 3 * i + j] += p.sensor.gyro_scale_sd ** 2
    _forget_motion(s, p)
    rest.changed = s.stamp
    rest.settled = 0


@njit
def _forget_motion(s, p):
    """Start velocity and position anew."""
    noise = s.block.noise
    for i in range(3):
        noise[es.VELOCITY + i] += p.fusion.velocity_sd ** 2
        noise[es.POSITION + i] += p.fusion.position_sd ** 2
        s.velocity[i] = 0.0
        s.position[i] = 0.0
