"""The method of Fang et al. (2020), as published: the baseline of the benchmarks.

Extended Rauch-Tung-Striebel smoother with an additive quaternion and its norm as a pseudo
measurement: states (40), parameters (42), inputs (41), outputs (48)-(50), constraints
(51), settings of tables 3 to 5. Where the print errs: the covariance prediction (13) is
``Phi P Phi' + Gamma Q Gamma'``, and the last term of (45) is ``- w x v``. The noise of
table 4 is that of one sample, held over the sample.

Frames are those of the paper: position in the hill frame N (x forward, z down), velocity in
body axes, quaternion (w, x, y, z) of the body against north-east-down.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.events import detect_jump, jump_result
from imu_fusion.estimation.smoother.initial import attitude_from_vectors
from imu_fusion.estimation.smoother.inputs import prepare_imu, reference_frame
from imu_fusion.estimation.smoother.result import SAMPLE, SmootherResult
from imu_fusion.estimation.smoother.surface_fit import surface_fits
from imu_fusion.geometry.geodesy import hill_axes
from imu_fusion.geometry.gravity import normal_gravity
from imu_fusion.geometry.magnetic_field import decimal_year, magnetic_field_world
from imu_fusion.surfaces.hill import Hill

_R, _V, _Q = slice(0, 3), slice(3, 6), slice(6, 10)
_DW, _DA, _DM, _DS = slice(10, 13), slice(13, 16), slice(16, 19), slice(19, 22)
_N = 22
_SERIES = 6  # terms of (7)-(9); the next is below 1e-12 at 100 Hz
_ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])

# Tables 3 and 5; magnetic quantities in microtesla.
_P0 = np.square([5, 5, 15, 1, 1, 3, *[0.1] * 4, *[0.0873] * 3, *[0.2] * 3, *[5.0] * 3,
                 *[0.1] * 3])
_R_FIX, _R_VEL, _R_MAG = np.square([3, 3, 5.0]), np.square([0.1, 0.1, 0.3]), np.full(3, 25.0)
_R_NORM = 0.01 ** 2


def _skew(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _to_ned(q):
    """M_BO transposed (47), without normalisation, as the derivatives need it."""
    w, v = q[0], q[1:]
    return (w * w - v @ v) * np.eye(3) + 2.0 * np.outer(v, v) + 2.0 * w * _skew(v)


def _d_to_ned(q, u):
    """Derivative (3, 4) of M_BO' u by q."""
    w, v = q[0], q[1:]
    return 2.0 * np.column_stack([w * u + np.cross(v, u), (v @ u) * np.eye(3) + np.outer(v, u)
                                  - np.outer(u, v) - w * _skew(u)])


def _d_to_body(q, u):
    """Derivative (3, 4) of M_BO u by q."""
    conjugate = q * [1.0, -1.0, -1.0, -1.0]
    return _d_to_ned(conjugate, u) * [1.0, -1.0, -1.0, -1.0]


def _rate_matrix(q):
    """The matrix of (46), (4, 3)."""
    return np.vstack([-q[1:], q[0] * np.eye(3) + _skew(q[1:])])


class ExtendedRts:
    """Runs like :class:`~imu_fusion.estimation.smoother.Smoother`; takes noise of the inputs,
    gravity and field from its parameters, all else from the paper."""

    def __init__(self, params, surface):
        self.params, self.surface = params, surface

    def run(self, imu, mag, fix, velocity, events=None):
        """See Smoother.run. Needs a magnetometer, fixes and velocities.

        Raises:
            EstimationError: a sensor is missing or the filter diverged.
        """
        if mag is None or velocity is None or not len(mag) or not len(velocity):
            raise EstimationError("method extended_rts needs a magnetometer and GNSS velocities")
        imu = prepare_imu(imu, self.params).log
        frame = reference_frame(self.surface, fix)
        hill = self.surface if isinstance(self.surface, Hill) else None
        if hill is not None and events is None:
            events = detect_jump(imu, velocity)
        self.axes = hill.axes if hill is not None else hill_axes(0.0)
        self.from_ned = self.axes @ _ENU_NED
        gravity = self.params.gravity or normal_gravity(frame.latitude_deg, frame.height)
        self.gravity_ned = np.array([0.0, 0.0, gravity])
        field = self.params.magnetic_field
        if field is None:
            field = magnetic_field_world(frame.latitude_deg, frame.longitude_deg, frame.height,
                                         decimal_year(fix.stamp[0]))
        self.field_ned = _ENU_NED @ np.asarray(field) * 1e6

        readings = self._readings(imu, mag, fix, velocity, frame)
        x0 = np.zeros(_N)
        x0[_R] = readings["fix"][1][0]
        attitude = Rotation.from_quat(attitude_from_vectors(
            imu.acc[0], mag.mag[0], _ENU_NED @ self.field_ned)).as_matrix()
        attitude = _ENU_NED @ attitude
        x0[_Q] = np.roll(Rotation.from_matrix(attitude).as_quat(), 1)
        x0[_V] = attitude.T @ readings["velocity"][1][0]
        x, cov, cost = self._smooth(imu, readings, hill, events, x0)
        if not np.isfinite(x).all():
            raise EstimationError("extended_rts diverged")
        samples = self._samples(imu, x, cov)
        jump = jump_result(hill, samples, imu, events) if hill is not None else None
        constraints = () if hill is None else hill.constraints()
        fits = surface_fits(constraints, samples, {}, events, self.params)
        return SmootherResult(samples, frame, {}, {}, (cost,), 1, True, events, jump, fits)

    def _readings(self, imu, mag, fix, velocity, frame):
        """Kind -> (sample of each reading, values); readings go to the nearest sample."""
        def nearest(stamp):
            middle = imu.stamp[:-1] + np.diff(imu.stamp) // 2
            return np.searchsorted(middle, stamp)
        enu = frame.to_enu(fix.latitude_deg, fix.longitude_deg, fix.height)
        return {"fix": (nearest(fix.stamp), enu @ self.axes.T),
                "velocity": (nearest(velocity.stamp), velocity.vel_world @ _ENU_NED.T),
                "mag": (nearest(mag.stamp), mag.mag * 1e6)}

    def _rate(self, x, u):
        """The state equations (44)-(46); parameters stand still."""
        omega, force = u[:3] - x[_DW], u[3:] - x[_DA]
        to_ned = _to_ned(x[_Q])
        rate = np.zeros(_N)
        rate[_R] = self.from_ned @ (to_ned @ x[_V])
        rate[_V] = force + to_ned.T @ self.gravity_ned - np.cross(omega, x[_V])
        rate[_Q] = 0.5 * _rate_matrix(x[_Q]) @ omega
        return rate

    def _jacobians(self, x, u):
        omega = u[:3] - x[_DW]
        a, f = np.zeros((_N, _N)), np.zeros((_N, 6))
        a[_R, _V] = self.from_ned @ _to_ned(x[_Q])
        a[_R, _Q] = self.from_ned @ _d_to_ned(x[_Q], x[_V])
        a[_V, _V] = -_skew(omega)
        a[_V, _Q] = _d_to_body(x[_Q], self.gravity_ned)
        a[_V, _DW] = -_skew(x[_V])
        a[_V, _DA] = -np.eye(3)
        a[_Q, _Q] = 0.5 * np.block([[0.0, -omega[None, :]], [omega[:, None], -_skew(omega)]])
        a[_Q, _DW] = -0.5 * _rate_matrix(x[_Q])
        f[:, :3], f[:, 3:] = a[:, _DW], a[:, _DA]
        return a, f

    def _predict(self, x, cov, u0, u1, dt, q):
        """Equations (12), (13) with (7)-(9): RK4 with linearly interpolated inputs."""
        a, f = self._jacobians(x, u0)
        phi, gamma, term = np.eye(_N), np.eye(_N) * dt, np.eye(_N)
        for i in range(1, _SERIES):
            term = term @ a * (dt / i)
            phi = phi + term
            gamma = gamma + term * (dt / (i + 1))
        gamma = gamma @ f
        middle = 0.5 * (u0 + u1)
        k1 = self._rate(x, u0)
        k2 = self._rate(x + 0.5 * dt * k1, middle)
        k3 = self._rate(x + 0.5 * dt * k2, middle)
        k4 = self._rate(x + dt * k3, u1)
        return (x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4),
                phi @ cov @ phi.T + (gamma * q) @ gamma.T, phi)

    def _rows(self, x, k, latest, hill, phase):
        """Innovation, derivative and variances of the readings and constraints at sample k."""
        innovation, jacobian, variance = [], [], []
        to_ned = _to_ned(x[_Q])

        def add(value, rows, r):
            innovation.append(np.atleast_1d(value))
            jacobian.append(rows)
            variance.append(np.atleast_1d(r))

        if k in latest["fix"]:
            h = np.zeros((3, _N))
            h[:, _R] = np.eye(3)
            add(latest["fix"][k] - x[_R], h, _R_FIX)
        if k in latest["velocity"]:
            h = np.zeros((3, _N))
            h[:, _V], h[:, _Q] = to_ned, _d_to_ned(x[_Q], x[_V])
            add(latest["velocity"][k] - to_ned @ x[_V], h, _R_VEL)
        if k in latest["mag"]:
            scale, body = 1.0 + x[_DS], to_ned.T @ self.field_ned
            h = np.zeros((3, _N))
            h[:, _Q] = scale[:, None] * _d_to_body(x[_Q], self.field_ned)
            h[:, _DM], h[:, _DS] = np.eye(3), np.diag(body)
            add(latest["mag"][k] - (scale * body + x[_DM]), h, _R_MAG)
        h = np.zeros((1, _N))
        norm = np.linalg.norm(x[_Q])
        h[0, _Q] = x[_Q] / norm
        add(1.0 - norm, h, _R_NORM)
        if phase is not None:
            profile = hill.in_run if phase == "in_run" else hill.landing
            sigma = {c.name: c.sigma for c in hill.constraints()}
            z, slope, _ = profile(x[0])
            h = np.zeros((1, _N))
            h[0, 0], h[0, 2] = -slope, 1.0
            add(float(z - x[2]), h, sigma[phase] ** 2)
            if phase == "in_run":
                h = np.zeros((1, _N))
                h[0, 1] = 1.0
                add(-x[1], h, sigma["in_run_lateral"] ** 2)
        return np.concatenate(innovation), np.vstack(jacobian), np.concatenate(variance)

    def _smooth(self, imu, readings, hill, events, x):
        n = len(imu)
        inputs, steps = np.concatenate([imu.gyr, imu.acc], axis=1), np.diff(imu.stamp) * 1e-9
        p = self.params
        latest = {kind: dict(zip(sample.tolist(), value))
                  for kind, (sample, value) in readings.items()}
        cov, cost = np.diag(_P0), 0.0
        predicted, filtered = np.empty((n, _N)), np.empty((n, _N))
        cov_predicted, cov_filtered = np.empty((n, _N, _N)), np.empty((n, _N, _N))
        transition = np.empty((n, _N, _N))
        for k in range(n):
            if k:
                # The density, as the standard deviation of one sample held over the step.
                q = np.repeat([p.gyro_noise_density ** 2, p.acc_noise_density ** 2],
                              3) / steps[k - 1]
                x, cov, transition[k - 1] = self._predict(x, cov, inputs[k - 1], inputs[k],
                                                          steps[k - 1], q)
            predicted[k], cov_predicted[k] = x, cov
            phase = None
            if hill is not None and imu.stamp[k] <= events.takeoff:
                phase = "in_run"
            elif hill is not None and imu.stamp[k] >= events.touchdown:
                phase = "landing"
            innovation, h, r = self._rows(x, k, latest, hill, phase)
            spread = h @ cov @ h.T + np.diag(r)
            gain = np.linalg.solve(spread, h @ cov).T
            cost += 0.5 * float(innovation @ np.linalg.solve(spread, innovation))
            x = x + gain @ innovation
            cov = cov - gain @ (h @ cov)
            cov = 0.5 * (cov + cov.T)
            filtered[k], cov_filtered[k] = x, cov
        smoothed, cov_smoothed = filtered, cov_filtered
        for k in range(n - 2, -1, -1):  # (19)-(21)
            gain = np.linalg.solve(cov_predicted[k + 1],
                                   transition[k] @ cov_filtered[k]).T
            smoothed[k] = filtered[k] + gain @ (smoothed[k + 1] - predicted[k + 1])
            cov_smoothed[k] = cov_filtered[k] + gain @ (cov_smoothed[k + 1]
                                                        - cov_predicted[k + 1]) @ gain.T
        return smoothed, cov_smoothed, cost

    def _samples(self, imu, x, cov):
        """The paper's states in the conventions of this package."""
        samples = np.empty(len(x), SAMPLE)
        samples["stamp"] = imu.stamp
        samples["position_world"] = x[:, _R] @ self.axes
        samples["cov_position"] = self.axes.T @ cov[:, _R, _R] @ self.axes
        for k, (xk, ck) in enumerate(zip(x, cov)):
            q = xk[_Q] / np.linalg.norm(xk[_Q])
            to_enu = _ENU_NED @ _to_ned(q)
            samples["vel_world"][k] = to_enu @ xk[_V]
            h = np.column_stack([to_enu, _ENU_NED @ _d_to_ned(q, xk[_V])])
            samples["cov_velocity"][k] = h @ ck[3:10, 3:10] @ h.T
            samples["quat_world_imu"][k] = Rotation.from_matrix(to_enu).as_quat()
            local = 2.0 * _rate_matrix(q).T  # dq = 1/2 Omega(q) dtheta, inverted
            samples["cov_attitude"][k] = local @ ck[_Q, _Q] @ local.T
        samples["gyr_bias"], samples["acc_bias"] = x[:, _DW], x[:, _DA]
        samples["gyr"], samples["acc"] = imu.gyr - x[:, _DW], imu.acc - x[:, _DA]
        sd = np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0))
        samples["gyr_bias_sd"], samples["acc_bias_sd"] = sd[:, _DW], sd[:, _DA]
        return samples
