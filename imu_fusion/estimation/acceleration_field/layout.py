"""Layouts of accelerometers on a rigid body: channels, what they determine, what they cannot.

A channel is one measured axis of one accelerometer. In body axes, relative to the reference
point (the weighted centre of the accelerometers), its reading along the unit vector u at r is

    u . (P r + a),   P = [alpha]x + S,   S symmetric

(Rahaman 2019, eq. (3.4)): linear in twelve numbers, a (3), alpha (3) and S (6). Four tri-axial
accelerometers that are not coplanar determine all twelve; fewer channels may determine some.
"""

from dataclasses import dataclass, replace

import numpy as np

from imu_fusion.errors import LayoutError
from imu_fusion.parameters.declare import Parameters, param

# Order of the six numbers of the symmetric part: xx yy zz xy xz yz.
SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_AXIS_NAMES = ("x", "y", "z")


@dataclass(frozen=True)
class AccelerometerParams(Parameters):
    """One accelerometer; in files and ROS below ``accelerometers.<name>.``"""

    position: tuple[float, ...] = param(
        (0.0, 0.0, 0.0), unit="m", length=3, doc="Position in body coordinates.")
    axes: tuple[float, ...] = param(
        (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), length=9, low=-1, high=1,
        doc="Sensor axes in body coordinates, row by row; orthonormal, either handedness.")
    measured_axes: tuple[str, ...] = param(
        ("x", "y", "z"), choices=_AXIS_NAMES, doc="Sensor axes that are measured.")
    reports: str = param(
        "specific_force", choices=("specific_force", "acceleration"),
        doc="Specific force, as real accelerometers do, or coordinate acceleration.")
    noise_density: float = param(
        1e-3, unit="m/s^2/sqrt(Hz)", low=1e-9,
        doc="White noise; the sd of one sample is this times sqrt(sample_rate).")
    range: float | None = param(
        None, unit="m/s^2", low=0, doc="Readings of this magnitude or more are saturated.")
    bias_sd: float = param(
        0.2, unit="m/s^2", low=0, doc="Uncertainty of the constant bias of each axis.")
    bias_walk: float = param(
        0.0, unit="m/s^2/sqrt(s)", low=0, doc="Random walk of the bias of each axis.")


@dataclass(frozen=True, eq=False)
class Layout:
    """The channels of a set of accelerometers (and, optionally, a gyroscope), as arrays.

    m channels: ``is_gyro`` (m,) bool, ``direction`` (m, 3) unit vectors in body axes, ``lever``
    (m, 3) m from the reference point, ``density`` (m,) noise, ``range`` (m,), ``bias_sd`` (m,),
    ``bias_walk`` (m,), ``column`` (m,) where the channel stands in a flattened reading.
    ``reference`` (3,) m in body coordinates; ``specific_force`` whether gravity is felt.
    """

    is_gyro: np.ndarray
    direction: np.ndarray
    lever: np.ndarray
    density: np.ndarray
    range: np.ndarray
    bias_sd: np.ndarray
    bias_walk: np.ndarray
    column: np.ndarray
    reference: np.ndarray
    specific_force: bool
    accelerometers: int

    @property
    def design(self):
        """(m', 12) matrix of the accelerometer channels: their readings from (a, alpha, S)."""
        use = ~self.is_gyro
        u, r = self.direction[use], self.lever[use]
        symmetric = np.stack([u[:, i] * r[:, j] + (u[:, j] * r[:, i] if i != j else 0.0)
                              for i, j in SYMMETRIC], axis=1)
        return np.hstack([u, np.cross(r, u), symmetric])

    @property
    def radius(self):
        """Root mean square distance of the accelerometer channels from the reference, m."""
        return float(np.sqrt(np.mean(np.sum(self.lever[~self.is_gyro] ** 2, axis=1))))

    def scaled_design(self):
        """The design matrix with weights and lengths made dimensionless: (m', 12)."""
        weight = self.density.min() / self.density[~self.is_gyro]
        scale = np.r_[np.ones(3), np.full(9, 1.0 / max(self.radius, 1e-12))]
        return self.design * scale * weight[:, None]

    @property
    def condition_affine(self):
        """Condition number of the fit of all twelve numbers (scaled); inf if undetermined."""
        return _condition(self.scaled_design())

    @property
    def condition_rigid(self):
        """Condition number of the fit of a and alpha with the angular velocity known."""
        return _condition(self.scaled_design()[:, :6])

    def determines_alpha(self, max_condition):
        """Whether a and alpha follow from the readings although S does not follow entirely."""
        matrix = self.scaled_design()
        _, values, rows = np.linalg.svd(matrix)
        free = rows[np.sum(values > values[0] / max_condition):]
        return bool(np.all(np.abs(free[:, :6]) < 1.0 / max_condition))

    def for_affine_fit(self, max_condition):
        """This layout with a reference point at which the fit determines a and alpha.

        Where S is not determined entirely, as in the nine-accelerometer package, that is one of
        the positions rather than the centre. Unchanged if there is no such point.
        """
        places = self.lever[~self.is_gyro]
        for place in np.vstack([np.zeros(3), places]):
            moved = replace(self, reference=self.reference + place, lever=self.lever - place)
            if moved.determines_alpha(max_condition):
                return moved
        return self

    def require(self, method, max_condition):
        """Refuse a layout that ``method`` cannot use.

        Raises:
            LayoutError: with the condition number and what to change.
        """
        if method == "rigid_body":
            number = self.condition_rigid
            if number > max_condition:
                raise LayoutError(
                    f"accelerometer layout: condition number {number:.3g} of the fit of linear and "
                    f"angular acceleration exceeds {max_condition:g}: {self._diagnosis()}; use "
                    "three or more accelerometers that do not lie on one line")
            return
        number = self.condition_affine
        if number <= max_condition or (method == "ao" and self.determines_alpha(max_condition)):
            return
        raise LayoutError(
            f"accelerometer layout: condition number {number:.3g} of the affine fit exceeds "
            f"{max_condition:g}: {self._diagnosis()}; method '{method}' needs twelve channels at "
            "four or more positions that are not in one plane"
            + ("" if self.condition_rigid > max_condition else ", or use method 'rigid_body'"))

    def _diagnosis(self):
        places = np.unique(np.round(self.lever[~self.is_gyro], 9), axis=0)
        rank = np.linalg.matrix_rank(places - places[0], tol=1e-6 * max(self.radius, 1e-9))
        shape = ("all positions coincide", "the positions are collinear",
                 "the positions are coplanar", "the measured axes do not suffice")[rank]
        return f"{len(places)} positions, {int(np.sum(~self.is_gyro))} channels, {shape}"


def _condition(matrix):
    if matrix.shape[0] < matrix.shape[1]:
        return np.inf
    values = np.linalg.svd(matrix, compute_uv=False)
    return float(values[0] / values[-1]) if values[-1] > 0 else np.inf


def make_layout(accelerometers, gyroscope=None):
    """Layout of a sequence of AccelerometerParams, and optionally GyroscopeParams.

    A reading of N accelerometers is (N, 3) in their own axes, channel ``3 k + axis`` of its
    flattened form; a gyroscope's three rates follow.

    Raises:
        LayoutError: no accelerometer, axes that are not orthonormal, an axis listed twice,
            specific force mixed with acceleration.
    """
    if not accelerometers:
        raise LayoutError("accelerometer layout: no accelerometers; set accelerometers.names")
    kinds = {a.reports for a in accelerometers}
    if len(kinds) > 1:
        raise LayoutError("accelerometer layout: some report specific force, some acceleration; "
                          "convert the readings to one of the two")
    rows = []
    for k, sensor in enumerate(accelerometers):
        axes = _orthonormal(sensor.axes, f"accelerometer {k}")
        if not sensor.measured_axes or len(set(sensor.measured_axes)) < len(sensor.measured_axes):
            raise LayoutError(f"accelerometer {k}: measured_axes {list(sensor.measured_axes)} must "
                              "name at least one axis and none twice")
        for axis in sorted(_AXIS_NAMES.index(a) for a in sensor.measured_axes):
            rows.append((False, axes[axis], sensor.position, sensor, 3 * k + axis))
    position = np.array([row[2] for row in rows], dtype=float)
    weight = np.array([1.0 / row[3].noise_density ** 2 for row in rows])
    reference = weight @ position / weight.sum()
    lever = list(position - reference)
    if gyroscope is not None:
        axes = _orthonormal(gyroscope.axes, "gyroscope")
        for axis in range(3):
            rows.append((True, axes[axis], None, gyroscope, 3 * len(accelerometers) + axis))
            lever.append(np.zeros(3))
    sensors = [row[3] for row in rows]
    return Layout(
        is_gyro=np.array([row[0] for row in rows]),
        direction=np.array([row[1] for row in rows]),
        lever=np.array(lever),
        density=np.array([s.noise_density for s in sensors]),
        range=np.array([np.inf if s.range is None else s.range for s in sensors]),
        bias_sd=np.array([s.bias_sd for s in sensors]),
        bias_walk=np.array([s.bias_walk for s in sensors]),
        column=np.array([row[4] for row in rows]),
        reference=reference,
        specific_force=kinds == {"specific_force"},
        accelerometers=len(accelerometers))


def _orthonormal(values, name):
    axes = np.array(values, dtype=float).reshape(3, 3)
    # Directions given to four digits, as in data sheets, are good enough.
    if np.abs(axes @ axes.T - np.eye(3)).max() > 1e-3:
        raise LayoutError(f"{name}: axes {np.round(axes, 4).tolist()} are not orthonormal; each "
                          "row must be a unit vector, perpendicular to the others")
    return axes


def nine_accelerometer_package(arm, center=(0.0, 0.0, 0.0), **common):
    """AccelerometerParams of the package of Padgaonkar et al. 1975: three at the centre, two on
    each of three perpendicular arms of length ``arm`` (m), measuring across the arm.

    ``common`` goes to each AccelerometerParams.
    """
    center = np.asarray(center, dtype=float)
    sensors = [AccelerometerParams(position=tuple(center), **common)]
    for axis in range(3):
        across = tuple(name for i, name in enumerate(_AXIS_NAMES) if i != axis)
        sensors.append(AccelerometerParams(position=tuple(center + arm * np.eye(3)[axis]),
                                           measured_axes=across, **common))
    return tuple(sensors)
