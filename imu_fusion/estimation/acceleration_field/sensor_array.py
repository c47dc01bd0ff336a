"""Arrays of accelerometers on a rigid body: channels, what they determine, what they cannot.

A channel is one measured axis of one accelerometer. In body axes, relative to the reference
point (the weighted centre of the accelerometers), its reading along the unit vector u at r is

    u . (P r + a),   P = [alpha]x + S,   S symmetric

(Rahaman 2019, eq. (3.4)): linear in twelve numbers, a (3), alpha (3) and S (6). Four tri-axial
accelerometers that are not coplanar determine all twelve; fewer channels may determine some.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from imu_fusion.errors import LayoutError
from imu_fusion.estimation.acceleration_field.motion_model import BIAS
from imu_fusion.estimation.acceleration_field.params import AXIS_NAMES, AccelerometerParams, Sensor

# Order of the six numbers of the symmetric part: xx yy zz xy xz yz.
SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))

# States of mounting in their order, their sd and number: of a sensor, or one of a channel.
_MOUNTING = (("turn", "axes_sd", 3), ("scale", "scale_sd", 1), ("shift", "position_sd", 3))

# Directions of turning at which an array may tell the angular velocity.
_TURNINGS = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, -1.0], [-1.0, 1.0, 1.0]])


#: One measured axis. ``direction`` (3,) unit vector in body axes; ``lever`` (3,) m from the
#: reference point; ``density``, ``range``, ``bias_sd``, ``bias_walk`` in units of the sensor;
#: ``position_sd`` m, ``axes_sd`` rad and ``scale_sd`` of its mounting; ``turn`` and ``shift``, the
#: first of the three states of the errors of its sensor's axes and position, and ``scale``, that of
#: its own scale, negative if there are none; ``column`` where it stands in a flattened reading,
#: ``sensor`` the number of its accelerometer (the gyroscope comes last).
CHANNEL = np.dtype([
    ("direction", "f8", 3), ("lever", "f8", 3), ("density", "f8"), ("range", "f8"),
    ("bias_sd", "f8"), ("bias_walk", "f8"), ("position_sd", "f8"), ("axes_sd", "f8"),
    ("scale_sd", "f8"), ("turn", "i8"), ("scale", "i8"), ("shift", "i8"), ("column", "i8"),
    ("sensor", "i8"), ("is_gyro", "?")], align=True)


@dataclass(frozen=True, eq=False)
class SensorArray:
    """The channels of a set of accelerometers and, optionally, of a gyroscope.

    ``channels`` (m,) CHANNEL; ``reference`` (3,) m in body coordinates, the point that levers
    begin at; ``specific_force`` whether gravity is felt; ``accelerometers`` their number.
    """

    channels: np.ndarray
    reference: np.ndarray
    specific_force: bool
    accelerometers: int

    @property
    def felt(self) -> np.ndarray:
        """The channels (m',) of accelerometers."""
        return self.channels[~self.channels["is_gyro"]]

    @property
    def design(self) -> np.ndarray:
        """(m', 12) matrix of the accelerometer channels: their readings from (a, alpha, S)."""
        u, r = self.felt["direction"], self.felt["lever"]
        symmetric = np.stack([u[:, i] * r[:, j] + (u[:, j] * r[:, i] if i != j else 0.0)
                              for i, j in SYMMETRIC], axis=1)
        return np.hstack([u, np.cross(r, u), symmetric])

    @property
    def radius(self) -> float:
        """Root mean square distance of the accelerometer channels from the reference, m."""
        return float(np.sqrt(np.mean(np.sum(self.felt["lever"] ** 2, axis=1))))

    def scaled_design(self) -> np.ndarray:
        """The design matrix with weights and lengths made dimensionless: (m', 12)."""
        weight = self.channels["density"].min() / self.felt["density"]
        scale = np.r_[np.ones(3), np.full(9, 1.0 / max(self.radius, 1e-12))]
        return self.design * scale * weight[:, None]

    @property
    def condition_affine(self) -> float:
        """Condition number of the fit of all twelve numbers (scaled); inf if undetermined."""
        return _condition(self.scaled_design())

    @property
    def condition_rigid(self) -> float:
        """Condition number of the fit of a and alpha with the angular velocity known."""
        return _condition(self.scaled_design()[:, :6])

    @property
    def condition_rates(self) -> float:
        """Condition number of the fit of a, alpha and the angular velocity of a body that turns;
        inf where only integration tells the latter."""
        u, r = self.felt["direction"], self.felt["lever"] / max(self.radius, 1e-12)
        rigid = self.scaled_design()[:, :6]
        weight = (self.channels["density"].min() / self.felt["density"])[:, None]
        numbers = []
        for w in _TURNINGS / np.sqrt(3.0):
            centripetal = u * (r @ w)[:, None] + r * (u @ w)[:, None] \
                - 2.0 * np.sum(u * r, axis=1)[:, None] * w
            numbers.append(_condition(np.hstack([rigid, weight * centripetal])))
        return min(numbers)

    @property
    def common_shift_variance(self) -> float:
        """Variance (m^2) of each coordinate of the weighted mean of all positions.

        No reading tells such a shift of everything: it only renames the point that a belongs to.
        What a motion model seems to say of it is its own error, so it is no part of the states.
        """
        _, first = np.unique(self.felt["sensor"], return_index=True)
        sd = self.felt["position_sd"][first]
        return 0.0 if np.any(sd == 0.0) else float(1.0 / np.sum(sd ** -2.0))

    def mounting_covariance(self) -> np.ndarray:
        """Covariance (k, k) of the states of mounting, which follow the biases."""
        first = BIAS + len(self.channels)
        end = max(int(self.channels[name].max()) + size for name, _, size in _MOUNTING)
        cov = np.zeros((max(end - first, 0),) * 2)
        for name, sd, size in _MOUNTING:
            for channel in self.channels[self.channels[name] >= 0]:
                own = np.arange(size) + channel[name] - first
                cov[own, own] = channel[sd] ** 2
        shifts = np.unique(self.channels["shift"][self.channels["shift"] >= 0]) - first
        for i in range(3):
            cov[np.ix_(shifts + i, shifts + i)] -= self.common_shift_variance
        return cov

    def with_mounting_states(self) -> "SensorArray":
        """This array with states for what may be off of the mounting of the sensors."""
        channels = self.channels.copy()
        free = BIAS + len(channels)
        for name, sd, size in _MOUNTING:
            owner = channels["column"] if size == 1 else channels["sensor"]
            for number in np.unique(owner):
                own = owner == number
                if np.any(channels[sd][own] > 0.0):
                    channels[name][own] = free
                    free += size
        return replace(self, channels=channels)

    def determines_alpha(self, max_condition: float) -> bool:
        """Whether a and alpha follow from the readings although S does not follow entirely."""
        matrix = self.scaled_design()
        _, values, rows = np.linalg.svd(matrix)
        free = rows[np.sum(values > values[0] / max_condition):]
        return bool(np.all(np.abs(free[:, :6]) < 1.0 / max_condition))

    def for_affine_fit(self, max_condition: float) -> "SensorArray":
        """This array with a reference point at which the fit determines a and alpha.

        Where S is not determined entirely, as in the nine-accelerometer package, that is one of
        the positions rather than the centre. Unchanged if there is no such point.
        """
        for place in np.vstack([np.zeros(3), self.felt["lever"]]):
            channels = self.channels.copy()
            channels["lever"] -= place
            moved = replace(self, channels=channels, reference=self.reference + place)
            if moved.determines_alpha(max_condition):
                return moved
        return self

    def require(self, method: str, max_condition: float) -> None:
        """Refuse an array that ``method`` cannot use.

        Raises:
            LayoutError: with the condition number and what to change.
        """
        if method == "rigid_body":
            number = self.condition_rigid
            if number > max_condition:
                raise LayoutError(
                    f"accelerometer array: condition number {number:.3g} of the fit of linear and "
                    f"angular acceleration exceeds {max_condition:g}: {self._diagnosis()}; use "
                    "three or more accelerometers that do not lie on one line")
            if len(self.felt) == len(self.channels) and self.condition_rates > max_condition:
                raise LayoutError(
                    f"accelerometer array: {self._diagnosis()}: they do not tell the angular "
                    "velocity, and integrated from angular acceleration it is lost within seconds; "
                    "use nine channels or more, or a gyroscope (use_gyro: true)")
            return
        number = self.condition_affine
        if number <= max_condition or (method == "ao" and self.determines_alpha(max_condition)):
            return
        raise LayoutError(
            f"accelerometer array: condition number {number:.3g} of the affine fit exceeds "
            f"{max_condition:g}: {self._diagnosis()}; method '{method}' needs twelve channels at "
            "four or more positions that are not in one plane"
            + ("" if self.condition_rigid > max_condition else ", or use method 'rigid_body'"))

    def _diagnosis(self):
        places = np.unique(np.round(self.felt["lever"], 9), axis=0)
        rank = np.linalg.matrix_rank(places - places[0], tol=1e-6 * max(self.radius, 1e-9))
        shape = ("all positions coincide", "the positions are collinear",
                 "the positions are coplanar", "the measured axes do not suffice")[rank]
        return f"{len(places)} positions, {len(self.felt)} channels, {shape}"


def _condition(matrix):
    if matrix.shape[0] < matrix.shape[1]:
        return np.inf
    values = np.linalg.svd(matrix, compute_uv=False)
    return float(values[0] / values[-1]) if values[-1] > 0 else np.inf


def make_sensor_array(accelerometers: Sequence[AccelerometerParams], common: Sensor = Sensor(),
                      use_gyro: bool = False) -> SensorArray:
    """The array of accelerometers and, with ``use_gyro``, of the gyroscope of ``common``.

    A reading of N accelerometers is (N, 3) in their own axes, channel ``3 k + axis`` of its
    flattened form; a gyroscope's three rates follow.

    Raises:
        LayoutError: no accelerometer, axes that are not orthonormal, an axis listed twice,
            specific force mixed with acceleration.
    """
    if not accelerometers:
        raise LayoutError("accelerometer array: no accelerometers; set accelerometers.names")
    kinds = {a.reports for a in accelerometers}
    if len(kinds) > 1:
        raise LayoutError("accelerometer array: some report specific force, some acceleration; "
                          "convert the readings to one of the two")
    channels = np.concatenate([_accelerometer(k, a.completed(common))
                               for k, a in enumerate(accelerometers)])
    weight = 1.0 / channels["density"] ** 2
    reference = weight @ np.ascontiguousarray(channels["lever"]) / weight.sum()
    channels["lever"] -= reference
    if use_gyro:
        channels = np.concatenate([channels, _gyroscope(3 * len(accelerometers), common)])
    return SensorArray(channels, reference, specific_force=kinds == {"specific_force"},
                       accelerometers=len(accelerometers))


def _channels():
    """Three CHANNELs without states of their mounting."""
    channels = np.zeros(3, CHANNEL)
    for name, _, _ in _MOUNTING:
        channels[name] = -1
    return channels


def _accelerometer(k, sensor):
    """CHANNELs of the k-th accelerometer, with levers from the body origin."""
    axes = _orthonormal(sensor.axes, f"accelerometer {k}")
    if not sensor.measured_axes or len(set(sensor.measured_axes)) < len(sensor.measured_axes):
        raise LayoutError(f"accelerometer {k}: measured_axes {list(sensor.measured_axes)} must "
                          "name at least one axis and none twice")
    measured = sorted(AXIS_NAMES.index(a) for a in sensor.measured_axes)
    channels = _channels()
    channels["direction"], channels["lever"] = axes, sensor.position
    channels["density"], channels["range"] = sensor.noise_density, _limit(sensor.range)
    channels["bias_sd"], channels["bias_walk"] = sensor.bias_sd, sensor.bias_walk
    channels["position_sd"], channels["axes_sd"] = sensor.position_sd, sensor.axes_sd
    channels["scale_sd"] = sensor.scale_sd
    channels["column"], channels["sensor"] = 3 * k + np.arange(3), k
    return channels[measured]


def _gyroscope(first, common):
    """CHANNELs of the gyroscope, whose readings begin at column ``first``."""
    channels = _channels()
    channels["is_gyro"] = True
    channels["direction"] = _orthonormal(common.gyro_axes, "gyroscope")
    channels["density"], channels["range"] = common.gyro_noise_density, _limit(common.gyro_range)
    channels["bias_sd"], channels["bias_walk"] = common.gyro_bias_sd, common.gyro_bias_walk
    channels["axes_sd"], channels["scale_sd"] = common.gyro_axes_sd, common.gyro_scale_sd
    channels["column"], channels["sensor"] = first + np.arange(3), first // 3
    return channels


def _limit(values):
    """A range as numbers: infinite if unset."""
    return np.inf if values is None else values


def _orthonormal(values, name):
    axes = np.array(values, dtype=float).reshape(3, 3)
    # Directions given to four digits, as in data sheets, are good enough.
    if np.abs(axes @ axes.T - np.eye(3)).max() > 1e-3:
        raise LayoutError(f"{name}: axes {np.round(axes, 4).tolist()} are not orthonormal; each "
                          "row must be a unit vector, perpendicular to the others")
    return axes
