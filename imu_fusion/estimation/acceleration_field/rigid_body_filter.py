"""The causal filter of the rigid-body model: an extended Kalman filter."""

import math

import numpy as np

from imu_fusion.estimation.acceleration_field.adaptation import (
    ADAPTATION,
    GRACE,
    adapt,
    follow,
)
from imu_fusion.estimation.acceleration_field.cross_check import (
    CHECK,
    contradiction,
    cross_check,
    learns_mounting,
    linearise_well,
    make_workspace,
)
from imu_fusion.estimation.acceleration_field.exact_mounting import (
    Exact,
    ask,
    change_of,
    make_exact,
    share,
)
from imu_fusion.estimation.acceleration_field.hardly_known_rate import (
    is_hardly_known,
    leave_rate_out,
    settle_rate,
)
from imu_fusion.estimation.acceleration_field.kernel_params import kernel_params
from imu_fusion.estimation.acceleration_field.measurement import (
    RATE_ROWS,
    TOUCHED,
    Trace,
    linearise,
    make_trace,
    update,
)
from imu_fusion.estimation.acceleration_field.misfit import widening
from imu_fusion.estimation.acceleration_field.motion_model import (
    ALPHA,
    BIAS,
    OMEGA,
    THETA,
    State,
    Step,
    motion_step,
    parts,
    predict,
    reopen,
)
from imu_fusion.estimation.acceleration_field.motion_watch import watch_motion
from imu_fusion.estimation.acceleration_field.params import AccelerationFieldParams
from imu_fusion.estimation.acceleration_field.rows import GAP, HELD, ROW, put_rigid_row
from imu_fusion.estimation.acceleration_field.sensor_array import SensorArray
from imu_fusion.estimation.acceleration_field.start import Start
from imu_fusion.estimation.acceleration_field.wrong_start import (
    doubt_of_start,
    fit_start,
    move_on,
)
from imu_fusion.geometry.rotation import quat_exp, quat_multiply, quat_normalize
from imu_fusion.kernels import njit


def _make_step():
    return Step(np.full(1, -1.0), np.empty((4, 4)), np.empty((4, 4)))


@njit
def _predict_to(stamp, state, p, channels, step, trace, n):
    """Move the State to a stamp (ns), in place; the Trace gets sample n. Returns GAP or 0.

    step: the last Step, used again if it is as long.
    """
    trace.dt[n] = 0.0
    flags = 0
    if state.last[0] < 0:
        step.dt[0] = -1.0
    else:
        dt = (stamp - state.last[0]) * 1e-9
        if dt > p.gap.max:
            flags = GAP
            step.dt[0] = -1.0
            state.adaptation[0].grace = GRACE
            reopen(state.x, state.cov, dt, p.spread)
            state.error[:] = 0.0
            trace.phi[n] = 0.0
            trace.dt[n] = -dt
        else:
            if dt != step.dt[0]:
                step.dt[0] = dt
                step.chain[:], step.noise[:] = motion_step(dt, p.motion.rate)
            trace.phi[n] = predict(state, p, channels, step)
            move_on(state, step, trace.phi[n])
            trace.dt[n] = dt
    state.last[0] = stamp
    return flags


@njit
def _fold(state):
    """Take theta into the quaternion."""
    state.quat[:] = quat_normalize(quat_multiply(state.quat, quat_exp(state.x[THETA:OMEGA])))
    state.x[THETA:OMEGA] = 0.0


@njit
def _correct(state, p, channels, reading, at, is_predicted, is_causal, step, work, trace, n):
    """Correct the State by a sample, linearised at the state ``at`` (N,), which may be that
    predicted, in place; the other arguments and what is returned are those of :func:`update`."""
    m = len(channels)
    trace.total[n, m:] = 0.0
    work.is_settled[0] = work.is_open[0] = False
    if p.is_adaptive and is_predicted and is_hardly_known(state, channels, p):
        work.is_settled[0] = settle_rate(state, p, channels, reading, at, work, trace, n)
    linearise(channels, at, work)
    cross_check(state, p, channels, reading, at, work)
    if p.is_adaptive:
        follow(state.adaptation[0], work.innovation, state.innovation)
        watch_motion(state, p, channels, reading, at, step, work)
    if is_predicted:
        linearise_well(state, p, channels, at, work)
    if work.is_open[0]:
        leave_rate_out(channels, work)
    open_states = len(state.x)
    if is_causal and not learns_mounting(state, p, channels, at, work):
        open_states = BIAS + m
    found = update(state, p, channels, reading, at, work, trace, n, open_states)
    fit_start(state, p, channels, at, work, trace, n, open_states)
    if work.is_settled[0] and is_hardly_known(state, channels, p):
        state.adaptation[0].vague += 1
    if found.used > 0 and p.is_adaptive:
        adapt(state.adaptation[0], found.squares / found.used, contradiction(p, channels, work),
              work.fit.redundancy[0] >= 0)
    return found


@njit
def filter_samples(state, par, channels, stamp, readings, rows, step, trace, work, exact):
    """Filter n samples in order, in place; one of ``rows`` (n,) ROW each.

    par: (1,) record of :func:`kernel_params`, channels: (m,) CHANNEL, stamp: (n,) int64 ns,
    readings: (n, m), step: the last Step, trace: a Trace of one sample and work: a Workspace, to
    work in; exact: Exact.
    """
    p = par[0]
    at = np.empty_like(state.x)
    # Literals would compile what is called once more.
    only, yes = np.int64(0), np.bool_(True)
    for n in range(len(stamp)):
        flags = _predict_to(stamp[n], state, p, channels, step, trace, only)
        at[:] = state.x
        found = _correct(state, p, channels, readings[n], at, yes, yes, step, work, trace, only)
        _fold(state)
        if found.learnt:
            ask(exact, state.x, state.cov)
        _put(rows[n], p, channels, state, exact)
        flags |= found.flags
        residual = math.nan
        if found.used > 0:
            residual = math.sqrt(found.squares / found.used)
        else:
            flags |= HELD
        rows[n].stamp = stamp[n]
        rows[n].flags = flags
        rows[n].residual_rms = residual


@njit
def _put(row, p, channels, state, exact):
    """Fill a ROW by the State, moved to where the hypothesis that the mounting is exact has it, as
    far as that counts; that much further its mean may be off."""
    cov, part = widening(state.x, channels) * state.cov[:BIAS, :BIAS], share(exact)
    s, doubt = parts(state.x), np.empty(BIAS)
    doubt_of_start(state, doubt)
    if part == 0.0:
        put_rigid_row(row, p, state.quat, s.omega, s.alpha, s.acc, cov, doubt)
        return
    change = part * change_of(exact, state.cov)
    for i in range(BIAS):
        for j in range(BIAS):
            cov[i, j] += change[i] * change[j]
    d = parts(change)
    put_rigid_row(row, p, quat_normalize(quat_multiply(state.quat, quat_exp(d.theta))),
                  s.omega + d.omega, s.alpha + d.alpha, s.acc + d.acc, cov, doubt)


@njit
def trace_samples(state, par, channels, stamp, readings, at, step, trace, work):
    """As :func:`filter_samples`, but for the smoother: keeps a Trace of all n samples.

    at: (n, N) states to linearise at, or (0, N): at each prediction. Returns the log likelihood of
    the readings.
    """
    p = par[0]
    where = np.empty_like(state.x)
    likelihood, no = 0.0, np.bool_(False)
    for n in range(len(stamp)):
        _predict_to(stamp[n], state, p, channels, step, trace, n)
        predicted = len(at) == 0
        where[:] = state.x if predicted else at[n]
        likelihood += _correct(state, p, channels, readings[n], where, predicted, no, step, work,
                               trace, n).log_likelihood
        trace.x[n] = state.x
        trace.cov[n] = state.cov
        _fold(state)
    return likelihood


class RigidBodyFilter:
    """The filter with its memory: a start, then samples in order.

    is_adaptive: whether noise and motion may be taken to be larger, see :mod:`.adaptation`.
    asks: whether the hypothesis that the mounting is exact is followed, see :mod:`.exact_mounting`.
    """

    def __init__(self, params: AccelerationFieldParams, array: SensorArray, start: Start,
                 is_adaptive: bool = True, asks: bool = False):
        self._par = kernel_params(params, array)
        self._par["is_adaptive"] = is_adaptive
        self._channels = array.channels
        self._one = make_trace(1, len(array.channels), len(start.x))
        self._step = _make_step()
        self._work = make_workspace(array.channels)
        linearise(array.channels, start.x, self._work)
        self.state = _first_state(start, array)
        self._exact = make_exact(array, asks)
        ask(self._exact, start.x, start.cov)

    def get_state(self) -> tuple[State, Exact]:
        """A copy of the memory, for :meth:`set_state`."""
        return copied(self.state), Exact(*(member.copy() for member in self._exact))

    def set_state(self, state: tuple[State, Exact]) -> None:
        """Go on from where :meth:`get_state` was called."""
        self.state = copied(state[0])
        self._exact = Exact(*(member.copy() for member in state[1]))

    @property
    def share_of_exact(self) -> float:
        """How likely it is, of one, that the mounting is exact."""
        return float(share(self._exact))

    def process(self, stamp: np.ndarray, readings: np.ndarray) -> np.ndarray:
        """Rows (n,) ROW of samples: stamp (n,), readings (n, m)."""
        rows = np.empty(len(stamp), ROW)
        filter_samples(self.state, self._par, self._channels, stamp, readings, rows, self._step,
                       self._one, self._work, self._exact)
        return rows

    @property
    def touched(self) -> np.ndarray:
        """(m + RATE_ROWS, TOUCHED) int, which states the entries of a Trace's rows belong to."""
        return np.vstack([self._work.touched, np.tile(np.arange(TOUCHED) % 3 + OMEGA,
                                                      (RATE_ROWS, 1))])

    def trace(self, stamp: np.ndarray, readings: np.ndarray, at: np.ndarray,
              trace: Trace) -> float:
        """:func:`trace_samples` with this filter's memory."""
        return trace_samples(self.state, self._par, self._channels, stamp, readings, at, self._step,
                             trace, self._work)


def copied(state: State) -> State:
    """A State of its own memory."""
    return State(*(member.copy() for member in state))


def _first_state(start, array):
    state = State(start.x.copy(), start.cov.copy(), start.quat.copy(),
                  np.array([-1], dtype=np.int64), np.zeros(array.accelerometers, CHECK),
                  np.zeros(1, ADAPTATION), np.zeros(len(array.channels)),
                  np.zeros(len(array.channels), bool), np.zeros((len(start.x), 3)))
    state.adaptation["grace"] = GRACE
    state.error[OMEGA:ALPHA] = np.eye(3)
    state.adaptation["about"] = start.about
    return state
