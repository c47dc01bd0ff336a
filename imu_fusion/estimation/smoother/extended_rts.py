"""The method of Fang et al. (2020), as published: the baseline of the benchmarks.

Extended Rauch-Tung-Striebel smoother with an additive quaternion and its norm as a pseudo
measurement, equations in :mod:`.extended_rts_model`, settings of tables 3 to 5. The noise of
table 4 is that of one sample, held over the sample.

Memory: a filtered covariance, a predicted one and a transition matrix of every sample are
11.6 kB. So the filter keeps its state at the first of every ``_SEGMENT`` samples only, and
the pass back filters each segment once more; the operations are the same and so the numbers.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.smoother.extended_rts_model import (
    DA,
    DW,
    ENU_NED,
    SIZE,
    Model,
    Q,
    R,
    V,
    d_to_ned,
    rate_matrix,
    to_ned,
)
from imu_fusion.estimation.smoother.imu_input import (
    ImuInput,
    first_place,
    prepare_imu,
    reference_frame,
)
from imu_fusion.estimation.smoother.initial import attitude_from_vectors
from imu_fusion.estimation.smoother.jump_events import JumpEvents, find_jump
from imu_fusion.estimation.smoother.jump_result import jump_result
from imu_fusion.estimation.smoother.measurements.registry import (
    FIX,
    MAG,
    MEASUREMENTS,
    VELOCITY,
    prepare_readings,
)
from imu_fusion.estimation.smoother.measurements.surface_contact import holds
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.result import SAMPLE, SmootherResult, reading_variances
from imu_fusion.estimation.smoother.surface_fit import surface_fits
from imu_fusion.estimation.smoother.surroundings import surroundings_of
from imu_fusion.geometry.geodesy import hill_axes
from imu_fusion.samples.logs import FixLog, ImuLog, MagLog, VelocityLog
from imu_fusion.surfaces.constraint import Surface
from imu_fusion.surfaces.hill import Hill

_SEGMENT = 64   # samples kept at once on the way back

# Tables 3 and 5.
_P0 = np.square([5, 5, 15, 1, 1, 3, *[0.1] * 4, *[0.0873] * 3, *[0.2] * 3, *[5.0] * 3,
                 *[0.1] * 3])
_R_READING = {FIX: np.square([3, 3, 5.0]), VELOCITY: np.square([0.1, 0.1, 0.3]),
              MAG: np.full(3, 25.0)}
_R_NORM = 0.01 ** 2


@dataclass(frozen=True)
class _Data:
    """Of a recording: stamps (N,) ns, inputs (N, 6), steps (N - 1,) s and variance densities
    (N - 1, 6) of the intervals; order of the readings used, start (N + 1,) of those of each
    sample among them, kinds and values (m, 3); by name of the constraint, mask (N,) of the samples
    where one of the hill's is active, and sigma."""

    stamp: np.ndarray
    inputs: np.ndarray
    steps: np.ndarray
    noise: np.ndarray
    order: np.ndarray
    start: np.ndarray
    kind: np.ndarray
    value: np.ndarray
    active: dict
    sigma: dict


class ExtendedRts:
    """Runs like :class:`~imu_fusion.estimation.smoother.Smoother`. Takes noise and ranges of the
    inputs, gravity, field, events, windows and the choice of readings (``gnss.even_stamps``,
    ``gnss.min_interval``) from its parameters, all else from the paper: tables 3 and 5 rather
    than the covariances of fixes and velocities. Clipped readings are used as they are, with the
    noise of unknown ones.
    """

    def __init__(self, params: SmootherParams, surface: Surface | None):
        self.params, self.surface = params, surface

    def run(self, imu: ImuLog, mag: MagLog | None, fix: FixLog | None,
            velocity: VelocityLog | None, events: JumpEvents | None = None,
            initial_quat: np.ndarray | None = None) -> SmootherResult:
        """See Smoother.run. Needs a magnetometer, fixes and velocities.

        ``cost`` of the result is half the sum of squares of all normalised innovations,
        constraints included, in the one pass there is; ``converged`` is None.

        Raises:
            EstimationError: a sensor is missing, the surface is no hill or the filter diverged.
            SampleError: unusable samples.
        """
        params, hill = self.params, self.surface
        if hill is not None and not isinstance(hill, Hill):
            raise EstimationError("method extended_rts knows hills only, no "
                                  f"{type(hill).__name__} (method: iterated)")
        prepared = prepare_imu(imu, params)
        frame = reference_frame(hill, first_place(fix, None))
        if hill is not None and events is None:
            events = find_jump(prepared.log, velocity, params.jump.takeoff, params.jump.touchdown)
        readings = prepare_readings({"fix": fix, "velocity": velocity, "mag": mag}, frame, params)
        around = surroundings_of(params, frame, int(prepared.log.stamp[0]), magnetic=True)
        model = Model(hill.axes if hill is not None else hill_axes(0.0),
                      np.array([0.0, 0.0, around.gravity]), ENU_NED @ around.magnetic_field, hill)
        data = _bind(model, prepared, readings, events, params)
        try:
            samples, mag_errors, mag_sd, innovation, cost = _smooth(
                model, data, _first_state(model, data, initial_quat))
        except np.linalg.LinAlgError:
            raise EstimationError(
                "extended_rts diverged: noise far below that of the data, or measurements of "
                "another recording") from None
        if not prepared.recorded.all():
            samples, mag_errors, mag_sd = (v[prepared.recorded]
                                           for v in (samples, mag_errors, mag_sd))
        _put_reading_sds(samples, prepared, params)
        states = {"mag_bias": (1e-6 * mag_errors[:, :3], 1e-6 * mag_sd[:, :3]),
                  "mag_scale": (mag_errors[:, 3:], mag_sd[:, 3:])}
        stamps = readings["stamp"][data.order]
        innovations = {m.name: (stamps[data.kind == kind], innovation[data.kind == kind])
                       for kind, m in enumerate(MEASUREMENTS) if np.any(data.kind == kind)}
        jump = None
        if hill is not None and events is not None:
            jump = jump_result(hill, samples, prepared.log, events)
        constraints = () if hill is None else hill.constraints()
        fits = surface_fits(constraints, samples, states, events, params)
        return SmootherResult(samples, frame, states, innovations, (cost,), 1, None, events, jump,
                              fits)


def _put_reading_sds(samples: np.ndarray, prepared: ImuInput, params: SmootherParams) -> None:
    """Standard deviations of the corrected readings: their bias and noise, or that of unknown
    ones where they were clipped."""
    noise = reading_variances(samples["stamp"], params)
    lost = noise * np.square([
        params.gap.gyro_noise_density / params.sensor.gyro_noise_density,
        params.gap.acc_noise_density / params.sensor.acc_noise_density])
    for i, name in enumerate(("gyr", "acc")):
        clipped = prepared.clipped[prepared.recorded, 3 * i:3 * i + 3]
        samples[name + "_sd"] = np.sqrt(samples[name + "_bias_sd"] ** 2
                                        + np.where(clipped, lost[i], noise[i]))


def _bind(model, prepared, readings, events, params):
    """The recording as :class:`_Data`: readings within the Imu's span at their nearest samples,
    in the frames of the outputs (48).

    The paper has one reading of a kind at a sample at most; of two, each is a measurement of
    that sample.

    Raises:
        EstimationError: a kind of reading is missing.
    """
    log = prepared.log
    inside = (readings["stamp"] >= log.stamp[0]) & (readings["stamp"] <= log.stamp[-1])
    middle = log.stamp[:-1] + np.diff(log.stamp) // 2
    sample = np.searchsorted(middle, readings["stamp"])
    order = np.lexsort((readings["stamp"], readings["kind"], sample))
    order = order[inside[order]]
    kind, value = readings["kind"][order], readings["value"][order]
    if not np.any(kind == FIX):
        raise EstimationError("no fix lies within the Imu recording: do the stamps belong "
                              "together?")
    if not (np.any(kind == VELOCITY) and np.any(kind == MAG)):
        raise EstimationError("method extended_rts needs a magnetometer and GNSS velocities")
    value[kind == FIX] = value[kind == FIX] @ model.axes.T
    value[kind == VELOCITY] = value[kind == VELOCITY] @ ENU_NED.T
    constraints = model.hill.constraints() if model.hill is not None else ()
    active = {c.name: holds(c, log.stamp, events, params.surface.windows, 0.0)
              for c in constraints}
    sigma = {"norm": np.sqrt(_R_NORM), **{c.name: c.sigma for c in constraints}}
    return _Data(log.stamp, np.concatenate([log.gyr, log.acc], axis=1), prepared.steps,
                 prepared.noise, order, np.searchsorted(sample[order], np.arange(len(log) + 1)),
                 kind, value, active, sigma)


def _first_state(model, data, quat_world_imu):
    """x (22,) of section 4.1: first fix, velocity, and the attitude from the first force and
    field unless one is given."""
    fix, velocity, mag = (data.value[data.kind == kind][0] for kind in (FIX, VELOCITY, MAG))
    if quat_world_imu is None:
        quat_world_imu = attitude_from_vectors(data.inputs[0, 3:], mag,
                                               ENU_NED @ model.field_ned)
    attitude = ENU_NED @ scipy.spatial.transform.Rotation.from_quat(quat_world_imu).as_matrix()
    x = np.zeros(SIZE)
    x[R], x[V] = fix, attitude.T @ velocity
    x[Q] = np.roll(scipy.spatial.transform.Rotation.from_matrix(attitude).as_quat(), 1)
    return x


def _update(model, data, k, x, cov):
    """Equations (14)-(16), (24) with all readings and constraints of sample k.

    Returns:
        State and covariance; the innovations, each by its standard deviation given those before
        it: readings first.
    """
    deviation: list[float] = []
    jacobian: list[np.ndarray] = []
    variance: list[float] = []
    for i in range(data.start[k], data.start[k + 1]):
        predicted, h = model.output(data.kind[i], x)
        deviation.extend(data.value[i] - predicted)
        jacobian.extend(h)
        variance.extend(_R_READING[data.kind[i]])
    active = [name for name, mask in data.active.items() if mask[k]]
    for name, (value, h) in model.constraints(x, active).items():
        deviation.append(-value)
        jacobian.append(h)
        variance.append(data.sigma[name] ** 2)
    innovation, h = np.array(deviation), np.array(jacobian)
    spread = h @ cov @ h.T + np.diag(variance)
    gain = np.linalg.solve(spread, h @ cov).T
    x = x + gain @ innovation
    cov = cov - gain @ (h @ cov)
    return x, 0.5 * (cov + cov.T), np.linalg.solve(np.linalg.cholesky(spread), innovation)


def _filter(model, data, first, last, x, cov, innovation):
    """Filter samples first <= k < last from the state and covariance predicted for ``first``;
    writes the innovations (m, 3) of their readings.

    Returns:
        Of each sample: filtered state and covariance, and the prediction for the next with Phi
        (None after the last of the recording). Half the sum of squared innovations.
    """
    trace, cost = [], 0.0
    for k in range(first, last):
        x, cov, normal = _update(model, data, k, x, cov)
        begin, end = data.start[k], data.start[k + 1]
        innovation[begin:end] = normal[:3 * (end - begin)].reshape(-1, 3)
        cost += 0.5 * float(normal @ normal)
        ahead = None
        if k < len(data.stamp) - 1:
            dt = data.steps[k]
            # The density, as the variance of one sample held over the step.
            ahead = model.predict(x, cov, data.inputs[k], data.inputs[k + 1], dt,
                                  data.noise[k] / dt)
        trace.append((x, cov, ahead))
        if ahead is not None:
            x, cov, _ = ahead
    return trace, cost


def _smooth(model, data, x):
    """Both passes from the first state x.

    Returns:
        Samples (N,) of :data:`SAMPLE`; magnetometer bias (microtesla) and scale errors (N, 6) and
        their standard deviations (N, 6); normalised innovations (m, 3); cost.

    Raises:
        LinAlgError: states that are not finite, or covariances that are none.
    """
    n = len(data.stamp)
    bounds = [*range(0, n, _SEGMENT), n]
    innovation, cov, cost, kept = np.empty((len(data.kind), 3)), np.diag(_P0), 0.0, []
    for first, last in zip(bounds[:-1], bounds[1:]):
        kept.append((first, last, x, cov))
        trace, part = _filter(model, data, first, last, x, cov, innovation)
        cost += part
        if last < n:
            x, cov, _ = trace[-1][2]
    if not (np.isfinite(cost) and np.isfinite(trace[-1][0]).all()):
        raise np.linalg.LinAlgError
    samples, mag, mag_sd = np.empty(n, SAMPLE), np.empty((n, 6)), np.empty((n, 6))
    for first, last, x0, cov0 in reversed(kept):
        trace, _ = _filter(model, data, first, last, x0, cov0, innovation)
        states, covs = np.empty((last - first, SIZE)), np.empty((last - first, SIZE, SIZE))
        for i in range(last - first - 1, -1, -1):
            filtered, cov_filtered, ahead = trace[i]
            if ahead is None:  # (17), (18)
                x, cov = filtered, cov_filtered
            else:  # (19)-(21)
                predicted, cov_predicted, phi = ahead
                gain = np.linalg.solve(cov_predicted, phi @ cov_filtered).T
                x = filtered + gain @ (x - predicted)
                cov = cov_filtered + gain @ (cov - cov_predicted) @ gain.T
            states[i], covs[i] = x, cov
        if not np.isfinite(states).all():
            raise np.linalg.LinAlgError
        here = slice(first, last)
        sd = np.sqrt(np.maximum(np.diagonal(covs, axis1=1, axis2=2), 0.0))
        samples[here] = _samples(model, data.stamp[here], data.inputs[here], states, covs, sd)
        mag[here], mag_sd[here] = states[:, 16:], sd[:, 16:]
    return samples, mag, mag_sd, innovation, cost


def _samples(model, stamp, inputs, x, cov, sd):
    """Smoothed states (m, 22), their covariances and standard deviations in the conventions of
    this package: structured array (:data:`SAMPLE`)."""
    samples = np.empty(len(x), SAMPLE)
    samples["stamp"] = stamp
    samples["position_world"] = x[:, R] @ model.axes
    samples["cov_position"] = model.axes.T @ cov[:, R, R] @ model.axes
    turn = scipy.spatial.transform.Rotation.from_matrix(ENU_NED)
    attitude = turn * scipy.spatial.transform.Rotation.from_quat(np.roll(x[:, Q], -1, axis=1))
    samples["vel_world"] = attitude.apply(x[:, V])
    samples["quat_world_imu"] = attitude.as_quat()
    for sample, xk, ck in zip(samples, x, cov):
        q = xk[Q] / np.linalg.norm(xk[Q])
        h = ENU_NED @ np.hstack([to_ned(q), d_to_ned(q, xk[V])])
        sample["cov_velocity"] = h @ ck[3:10, 3:10] @ h.T
        local = 2.0 * rate_matrix(q).T  # dq = 1/2 Omega(q) dtheta, inverted
        sample["cov_attitude"] = local @ ck[Q, Q] @ local.T
    samples["gyr_bias"], samples["acc_bias"] = x[:, DW], x[:, DA]
    samples["gyr_bias_sd"], samples["acc_bias_sd"] = sd[:, DW], sd[:, DA]
    samples["gyr"], samples["acc"] = inputs[:, :3] - x[:, DW], inputs[:, 3:] - x[:, DA]
    return samples
