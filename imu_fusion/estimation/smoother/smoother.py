"""The smoother: trajectory, attitude and sensor errors from a whole recording."""

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.smoother.events import find_jump, jump_result, refine_jump
from imu_fusion.estimation.smoother import initial, iterated, model
from imu_fusion.estimation.smoother.extended_rts import ExtendedRts
from imu_fusion.estimation.smoother.inputs import (prepare_imu, prepare_measurements,
                                                   reference_frame)
from imu_fusion.estimation.smoother.params import SmootherParams
from imu_fusion.estimation.smoother.result import SAMPLE, SmootherResult, reading_variances
from imu_fusion.estimation.smoother.surface_fit import at_surface, surface_fits
from imu_fusion.geometry.gravity import earth_rate_world, gravity_world, normal_gravity
from imu_fusion.geometry.magnetic_field import decimal_year, magnetic_field_world
from imu_fusion.surfaces.hill import Hill

_KINDS = {model.FIX: "fix", model.VELOCITY: "velocity", model.MAG: "mag"}
# A wrong first attitude can end in another minimum: converged or not, fixes then do not fit.
_STARTS = 4          # first attitudes tried until one fits
_PLAUSIBLE = 1.5     # typical innovation of fixes, in standard deviations, that is taken as a fit


class Smoother:
    """Smooths recordings; holds parameters only.

    Args:
        params: SmootherParams.
        surface: Surface or None.
    """

    def __init__(self, params=SmootherParams(), surface=None):
        self.params, self.surface = params, surface

    def run(self, imu, mag=None, fix=None, velocity=None, events=None, initial_quat=None):
        """Smooth one recording.

        Args:
            imu: ImuLog. mag: MagLog or None. fix: FixLog. velocity: VelocityLog or None.
            events: JumpEvents, or None: found by ``find_jump`` when the surface needs them.
            initial_quat: (4,) attitude of the first sample; found from the data when None.

        Returns:
            SmootherResult.

        Raises:
            SampleError: unusable samples.
            EstimationError: no fix; events needed and not found; no convergence to finite
                values.
        """
        params, surface = self.params, self.surface
        if params.method == "extended_rts":
            return ExtendedRts(params, surface).run(imu, mag, fix, velocity, events,
                                                    initial_quat)
        prepared = prepare_imu(imu, params)
        frame = reference_frame(surface, fix)
        constraints = surface.constraints() if surface is not None else ()
        if events is None and any(c.phase != "always" for c in constraints):
            events = find_jump(prepared.log, velocity, params.jump.takeoff, params.jump.touchdown)
        measurements = prepare_measurements(frame, mag, fix, velocity, params)
        problem = self._problem(prepared, frame, measurements, constraints, fix)
        hill = surface if isinstance(surface, Hill) and events is not None else None

        def refine(problem, events):
            return refine_jump(hill, _positions(problem), prepared.log, events)

        best = None
        for quat in self._first_attitudes(problem, mag, initial_quat)[:_STARTS]:
            attempt = problem.from_attitude(quat)
            outcome = iterated.solve(attempt, events if hill is not None else None, refine)
            if not np.isfinite(attempt.x).all():
                continue
            result = self._result(attempt, frame, hill, *outcome)
            if best is None or result.cost[-1] < best.cost[-1]:
                best = result
            if result.converged and result.misfit().get("fix", np.inf) < _PLAUSIBLE:
                break
        if best is None:
            raise EstimationError("the smoother diverged: noise far below that of the data, or "
                                  "measurements of another recording")
        return best

    def _problem(self, prepared, frame, measurements, constraints, fix):
        p = self.params
        has_mag = bool(np.any(measurements.kind == model.MAG))
        wander, drift = np.array(p.gnss.position_error_sd), np.array(p.gnss.velocity_error_sd)
        blocks = {"mag_bias": [p.sensor.mag_bias_sd * 1e6] * 3 if has_mag else 0,
                  "mag_scale": [p.sensor.mag_scale_sd] * 3 if has_mag else 0,
                  "gnss_position_error": wander if wander.any() else 0,
                  "gnss_time_offset": [p.gnss.time_offset_sd],
                  "velocity_time_offset": [p.gnss.velocity_time_offset_sd],
                  "acc_matrix": [p.sensor.acc_matrix_sd] * 9,
                  "gyr_scale": [p.sensor.gyro_scale_sd] * 3, "gnss_lever_arm": [p.gnss.lever_arm_sd] * 3,
                  "body_height": [p.surface.body_height_sd],
                  "surface_lever_arm": [p.surface.lever_arm_sd] * 3,
                  "gnss_velocity_error": drift if drift.any() else 0}
        present = {name: sd for name, sd in blocks.items() if np.any(sd)}
        layout, size = model.make_layout(present)
        sd = np.concatenate([[p.initial.position_sd] * 3, [p.initial.speed_sd] * 3, [p.initial.attitude_sd] * 3,
                             [p.sensor.gyro_bias_sd] * 3, [p.sensor.acc_bias_sd] * 3,
                             *(present[name] for name, _ in model.BLOCKS if name in present)])
        decay, walk = np.zeros(size), np.zeros(size)
        walk[model.GYR_BIAS:model.GYR_BIAS + 3] = p.sensor.gyro_bias_walk ** 2
        walk[model.ACC_BIAS:model.ACC_BIAS + 3] = p.sensor.acc_bias_walk ** 2
        for block, spread, tau in ((model.GNSS_ERROR, wander, p.gnss.position_error_tau),
                                   (model.GNSS_VELOCITY_ERROR, drift, p.gnss.velocity_error_tau)):
            i = layout[block]
            if i >= 0:
                decay[i:i + 3] = 1.0 / tau
                walk[i:i + 3] = 2.0 * spread ** 2 * decay[i]
                sd[i:i + 3] = np.maximum(spread, 1e-6)
        gravity = p.gravity
        if gravity is None:
            gravity = float(normal_gravity(frame.latitude_deg, frame.height))
        field = np.zeros(3)
        if has_mag:
            field = p.magnetic_field
            if field is None:
                field = magnetic_field_world(frame.latitude_deg, frame.longitude_deg,
                                             frame.height, decimal_year(fix.stamp[0]))
        return iterated.Problem(
            imu=prepared, params=p, measurements=measurements, gravity=gravity,
            earth_rate=earth_rate_world(frame.latitude_deg), field_world=np.array(field) * 1e6,
            constraints=constraints, layout=layout,
            prior_sd=sd, decay_rate=decay, walk=walk)

    def _first_attitudes(self, problem, mag, initial_quat):
        """Set the problem's prior; attitudes (k, 4) to start from, the most plausible first."""
        p, size = self.params, problem.size
        kind, value = problem.attached[1], problem.attached[3]
        prior = np.zeros(size + 1)
        if not np.any(kind == model.FIX):
            raise EstimationError("no fix lies within the Imu recording: do the stamps belong "
                                  "together?")
        prior[0:3] = value[kind == model.FIX][0]
        if np.any(kind == model.VELOCITY):
            prior[3:6] = value[kind == model.VELOCITY][0]
        log = problem.imu.log
        # A fifth of a second: long enough against noise, short against motion.
        beginning = int(np.searchsorted(log.stamp, log.stamp[0] + 200_000_000))
        acc = log.acc[:beginning].mean(axis=0)
        for block, lever in ((model.LEVER_ARM, p.gnss.lever_arm),
                             (model.SURFACE_ARM, p.surface.lever_arm)):
            i = problem.layout[block]
            if i >= 0:
                prior[i + 1:i + 4] = lever
        i = problem.layout[model.BODY_HEIGHT]
        problem.prior, problem.x = prior, np.empty((len(log), size + 1))
        if i >= 0:
            prior[i + 1] = p.surface.body_height
        # Quarter turns insure against a disturbed or mounted-over magnetometer.
        candidates = 4
        if initial_quat is None:
            reading = None
            if np.any(kind == model.MAG):
                early = mag.between(log.stamp[0], log.stamp[beginning] + 1)
                finite = np.isfinite(early.mag).all(axis=1)
                reading = early.mag[finite].mean(axis=0) if finite.any() else None
            initial_quat = initial.attitude_from_vectors(acc, reading, problem.field_world)
            candidates = 12 if reading is None else 4
        return problem.rank(initial.headings(initial_quat, candidates))

    def _result(self, problem, frame, hill, events, steps, converged, cov, var):
        recorded = problem.imu.recorded
        x, layout, log = problem.x[recorded], problem.layout, problem.imu.log
        cov, sd = cov[recorded], np.sqrt(np.maximum(var[recorded], 0.0))
        samples = np.empty(len(x), SAMPLE)
        samples["stamp"] = log.stamp[recorded]
        samples["position_world"], samples["vel_world"] = x[:, 0:3], x[:, 3:6]
        samples["quat_world_imu"] = x[:, 6:10]
        samples["gyr_bias"], samples["acc_bias"] = x[:, 10:13], x[:, 13:16]
        for block, name in enumerate(("cov_position", "cov_velocity", "cov_attitude")):
            samples[name] = cov[:, block]
        samples["gyr_bias_sd"], samples["acc_bias_sd"] = sd[:, 0:3], sd[:, 3:6]
        gyr, acc = log.gyr[recorded], log.acc[recorded]
        noise = np.sqrt(reading_variances(samples["stamp"], problem.params))
        samples["gyr_sd"] = np.hypot(samples["gyr_bias_sd"], noise[0])
        samples["acc_sd"] = np.hypot(samples["acc_bias_sd"], noise[1])
        samples["gyr"], samples["acc"] = gyr - x[:, 10:13], acc - x[:, 13:16]
        if layout[model.GYR_SCALE] >= 0:
            i = layout[model.GYR_SCALE] + 1
            samples["gyr"] += x[:, i:i + 3] * gyr
            samples["gyr_sd"] = np.hypot(samples["gyr_sd"], sd[:, i - 10:i - 7] * gyr)
        if layout[model.ACC_MATRIX] >= 0:
            i = layout[model.ACC_MATRIX] + 1
            samples["acc"] += np.einsum("nij,nj->ni", x[:, i:i + 9].reshape(-1, 3, 3), acc)
            spread = sd[:, i - 10:i - 1].reshape(-1, 3, 3) * acc[:, None, :]
            samples["acc_sd"] = np.sqrt(samples["acc_sd"] ** 2 + (spread ** 2).sum(axis=2))
        _recover_clipped(samples, problem)
        states = {}
        for block, (name, width) in enumerate(model.BLOCKS):
            if layout[block] >= 0:
                i = layout[block]
                unit = 1e-6 if name == "mag_bias" else 1.0
                states[name] = (unit * x[:, i + 1:i + 1 + width],
                                unit * sd[:, i - 9:i - 9 + width])
        stamps, kinds = problem.measurements.stamp[problem.order], problem.attached[1]
        innovations = {name: (stamps[kinds == kind], problem.innovation[kinds == kind])
                       for kind, name in _KINDS.items() if np.any(kinds == kind)}
        jump = None
        if hill is not None:
            jump = jump_result(hill, at_surface(samples, states, problem.params), log, events)
        fits = surface_fits(problem.constraints, samples, states, events, problem.params)
        return SmootherResult(samples, frame, states, innovations, tuple(problem.cost), steps,
                              converged, events, jump, fits)


def _positions(problem):
    samples = np.empty(len(problem.x), SAMPLE)
    samples["stamp"] = problem.imu.log.stamp
    samples["position_world"] = problem.surface_points()
    return samples


def _recover_clipped(samples, problem):
    """Where a reading was clipped, take that of the smoothed motion from sample to sample.

    Its variance is that of the difference, as if the errors at the two ends had nothing in
    common, or of what was assumed of the lost reading if that is less.
    """
    p, log, x = problem.params, problem.imu.log, problem.x
    clipped = problem.imu.clipped
    inner = np.flatnonzero(clipped.any(axis=1))
    inner = inner[(inner > 0) & (inner < len(x) - 1)]
    if not len(inner):
        return
    row = np.cumsum(problem.imu.recorded) - 1   # of a sample in ``samples``
    span = ((log.stamp[inner + 1] - log.stamp[inner - 1]) * 1e-9)[:, None]
    attitude = Rotation.from_quat(x[:, 6:10])
    rate = (attitude[inner - 1].inv() * attitude[inner + 1]).as_rotvec() / span
    rate += attitude[inner].inv().apply(problem.earth_rate)
    fall = np.array([gravity_world(at, problem.gravity) for at in x[inner, 0:3]])
    fall -= 2.0 * np.cross(problem.earth_rate, x[inner, 3:6])
    force = attitude[inner].inv().apply((x[inner + 1, 3:6] - x[inner - 1, 3:6]) / span - fall)
    turn = attitude[inner].as_matrix()
    cov_velocity = samples["cov_velocity"][row[inner]]
    ends = (samples["cov_attitude"][row[inner]].diagonal(0, 1, 2),
            np.einsum("nji,njk,nki->ni", turn, cov_velocity, turn))
    for name, value, end, unknown, lost in (
            ("gyr", rate, ends[0], p.gap.gyro_noise_density, clipped[inner, 0:3]),
            ("acc", force, ends[1], p.gap.acc_noise_density, clipped[inner, 3:6])):
        sd = np.sqrt(np.minimum(2.0 * end / span ** 2, unknown ** 2 / span))
        for field, new in ((name, value), (name + "_sd", sd)):
            samples[field][row[inner]] = np.where(lost, new, samples[field][row[inner]])
