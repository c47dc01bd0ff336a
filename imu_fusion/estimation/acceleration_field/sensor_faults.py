"""Why an accelerometer contradicts the others, and what its mounting turned out to be: in words."""

import itertools
from dataclasses import dataclass

import numpy as np
import scipy  # its parts are loaded where they are first used

from imu_fusion.estimation.acceleration_field.motion_model import BIAS, State
from imu_fusion.estimation.acceleration_field.params import AccelerationFieldParams
from imu_fusion.estimation.acceleration_field.sensor_array import SensorArray
from imu_fusion.estimation.acceleration_field.wrong_start import start_remarks

_SAMPLES = 10       # left out: fewer are single wild readings, without a cause to name
_EXPLAINED = 0.15   # of the squares of a contradiction that a cause may leave over
_STILL = 1e-3       # of the squares expected, by which the readings of a dead sensor may vary
_BEYOND = 4.0       # of its standard deviation: a mounting that is not as described
_FAR = 4.5          # of it: a bias, which takes up errors of the motion, too
_UNLIKELY = 0.01    # chance of mountings that, taken together, are further off: worth a remark
_HARDLY = 1e-5      # and of biases
_BLURS = 2.0        # of the share that positions are off by, of the turning that passes for it
_WIDER = 3.0        # times a standard deviation: an adaptation worth a remark
_NOISIER = 1.25     # as much for the noise, if it lasts: data that fit never change it
_SHARE = 0.1        # of the samples, in which noise may be larger, or the rate hardly known
_MOSTLY = 0.5       # of the samples: an impact is wilder than what is before and after it


FIT_UNITS = {"position_error": "m", "position_error_sd": "m", "axes_error": "rad",
             "axes_error_sd": "rad", "scale_error": "1", "scale_error_sd": "1", "residual": "1"}
"""Units of :meth:`SensorFit.numbers`; what is not named here is a count."""


@dataclass(frozen=True, eq=False)
class SensorFit:
    """How one accelerometer fits to the others.

    ``samples`` were checked, ``left_out`` of them were not used because it contradicted the others;
    ``residual`` rms in units of what noise, bias and mounting allow; ``position_error`` (3,) m and
    ``axes_error`` (3,) rad, estimates with ``_sd``, body axes, and ``scale_error`` (3,) of its own
    axes; nan where there is no such state.
    ``fault`` says why it was left out, ``mounting`` in what its mounting is not as described, each
    with what to do; empty where nothing is wrong.
    """

    name: str
    samples: int
    left_out: int
    residual: float
    position_error: np.ndarray
    position_error_sd: np.ndarray
    axes_error: np.ndarray
    axes_error_sd: np.ndarray
    scale_error: np.ndarray
    scale_error_sd: np.ndarray
    fault: str = ""
    mounting: tuple[str, ...] = ()

    def numbers(self) -> dict:
        """Plain numbers for results.json."""
        return {"samples": self.samples, "left_out": self.left_out, "residual": self.residual,
                **{name: [None if np.isnan(v) else float(v) for v in getattr(self, name)]
                   for name in ("position_error", "position_error_sd", "axes_error",
                                "axes_error_sd", "scale_error", "scale_error_sd")}}


def sensor_fits(names: list[str], array: SensorArray, state: State,
                standing: dict[int, str]) -> list[SensorFit]:
    """The SensorFits of an array after the samples that led to ``state``; ``standing``: texts on
    those that stand still, by their number."""
    found: list[SensorFit] = []
    for k, name in enumerate(names):
        own = array.channels[array.channels["sensor"] == k]
        check = state.checks[k]
        shift, shift_sd = _states(state, own["shift"][0] + np.arange(3))
        turn, turn_sd = _states(state, own["turn"][0] + np.arange(3))
        scale, scale_sd = np.full((2, 3), np.nan)
        axes = own["column"] % 3
        scale[axes], scale_sd[axes] = _states(state, own["scale"])
        residual = np.sqrt(check["squares"] / check["channels"]) if check["channels"] else np.nan
        fault = standing.get(k, "")
        if not fault and check["left_out"] >= _SAMPLES:
            fault = (f"accelerometer '{name}' contradicts the others in {check['left_out']} of "
                     f"{check['checked']} samples and was left out of them: "
                     f"{_cause(name, check, own)}")
        found.append(SensorFit(
            name, int(check["checked"]), int(check["left_out"]), float(residual), shift, shift_sd,
            turn, turn_sd, scale, scale_sd, fault,
            () if fault else _mounting(name, own, shift, turn, scale)))
    return found


def coarse_remarks(names: list[str], array: SensorArray, params: AccelerationFieldParams,
                   steps: np.ndarray) -> list[str]:
    """Accelerometers whose readings change by nothing finer than ``steps`` (K, 3), so that rounding
    alone is more than the noise that is stated. A step errs by its size / sqrt(12)."""
    remarks = []
    for k, name in enumerate(names):
        density = float(array.channels["density"][array.channels["sensor"] == k][0])
        stated = params.noise_scale * density * np.sqrt(params.sample_rate)
        known = steps[k][np.isfinite(steps[k])]
        if len(known) and known.max() > np.sqrt(12.0) * stated:
            step = float(known.max())
            # More than step / sqrt(12): what changes slowly is rounded alike for many samples.
            needed = step / np.sqrt(params.sample_rate)
            remarks.append(
                f"accelerometer '{name}' reads in steps of {step:.3g} m/s^2, whose rounding is "
                f"more than its noise of {stated:.2g}: set accelerometers.{name}.noise_density to "
                f"{needed:.2g} or more, and bias_sd to {step / np.sqrt(12.0):.2g} or more")
    return remarks


def fit_remarks(fits: list[SensorFit], array: SensorArray, params: AccelerationFieldParams,
                state: State) -> list[str]:
    """What is wrong with the sensors, single ones and as a whole, and what to do."""
    or_gyro = (", or unit, axes and sign of the gyroscope" if array.channels["is_gyro"].any()
               else "")
    remarks = [text for fit in fits for text in (fit.fault, *fit.mounting) if text]
    remarks = remarks or _together(fits, array)
    remarks += _biases(fits, array, state) + _gyro_bias(array, state) + _gyro_mounting(array, state)
    moved = [fit.name for fit in fits if fit.mounting]
    if len(moved) > len(fits) / 2:
        # Of so many, what they have in common is more likely.
        remarks = [fit.fault for fit in fits if fit.fault] + [
            f"positions or axes of {len(moved)} of {len(fits)} accelerometers do not fit what is "
            f"described: check units and scale of the positions{or_gyro}; or the motion is faster "
            "than the sampling"]
    doubted, checked = (int(state.checks[name].max()) for name in ("doubted", "checked"))
    if doubted >= _SAMPLES:
        remarks.append(
            f"the accelerometers contradict each other in {doubted} of {checked} samples, and no "
            "single one is to blame; these count for little: are two of them exchanged, or several "
            f"positions, axes, units or ranges wrong{or_gyro}?")
    adaptation = state.adaptation[0]
    noise, motion = (float(most) for most in adaptation["most"])
    lasts = adaptation["samples"][0] > max(_SAMPLES, _SHARE * checked)
    if noise > (_NOISIER if lasts else _WIDER):
        remarks.append(
            f"readings differ from a rigid body by up to {noise:.2g} times their noise, for "
            f"{adaptation['samples'][0]} samples; as much is added to what is stated: look for "
            "jitter of the stamps, flexing, ringing or clipping, or raise noise_scale")
    if adaptation["vague"] > max(_SAMPLES, _SHARE * checked):
        remarks.append(
            f"the angular velocity is hardly known in {adaptation['vague']} of {checked} samples: "
            "accelerometers tell its products alone, and by motion.jerk_density it may change by "
            "as much from sample to sample; lower that if it does not, sample faster, or add a "
            "gyroscope (use_gyro: true)")
    if motion > _WIDER and adaptation["samples"][1] > _MOSTLY * checked:
        remarks.append(
            f"the motion is up to {motion:.2g} times wilder than its densities say, for "
            f"{adaptation['samples'][1]} samples, in which they are taken to be larger: raise "
            "motion.jerk_density and motion.acceleration_rate_density, or use maximum_likelihood")
    felt = array.channels[~array.channels["is_gyro"]]
    blurred = _BLURS * float(felt["position_sd"].max()) / max(array.radius, 1e-12)
    return remarks + start_remarks(adaptation, params.initial, blurred)


def _biases(fits, array, state):
    """Texts on accelerometers whose biases are far beyond what was said of them, each, or taken
    together: those that drift have been smaller."""
    remarks = []
    squares, number = 0.0, 0
    for k, fit in enumerate(fits):
        own = np.flatnonzero(array.channels["sensor"] == k)
        bias, sd = state.x[BIAS + own], array.channels["bias_sd"][own[0]]
        if fit.fault or array.channels["bias_walk"][own[0]] > 0.0 or sd == 0.0:
            continue
        squares += float(np.sum((bias / sd) ** 2))
        number += len(own)
        if np.all(np.abs(bias) <= _FAR * sd):
            continue
        axes = ", ".join("xyz"[column % 3] for column in array.channels["column"][own])
        remarks.append(
            f"accelerometer '{fit.name}' fits best with biases of {_vector(bias, 2)} m/s^2 "
            f"({axes}), far beyond their sd of {sd:.2g}; what is stated is larger by as much: "
            f"calibrate it, or raise accelerometers.{fit.name}.bias_sd (bias_walk, if it drifts)")
    if not remarks and number and squares > scipy.special.chdtri(number, _HARDLY):
        remarks = ["the biases of the accelerometers, taken together, fit best "
                   f"{np.sqrt(squares / number):.2g} times as large as their sds say; what is "
                   "stated is larger by as much: calibrate them, or raise sensor.acc_bias_sd "
                   "(sensor.acc_bias_walk, if they drift)"]
    return remarks


def _gyro_bias(array, state):
    """A text on a gyroscope's biases that are far beyond what was said of them."""
    own = np.flatnonzero(array.channels["is_gyro"])
    if not len(own):
        return []
    bias, sd = state.x[BIAS + own], array.channels["bias_sd"][own[0]]
    if array.channels["bias_walk"][own[0]] > 0.0 or np.all(np.abs(bias) <= _BEYOND * sd):
        return []
    return [f"the gyroscope fits best with biases of {_vector(bias, 3)} rad/s: raise "
            "sensor.gyro_bias_sd; or it turned where it was taken to be still, or its unit, axes "
            "or sign are wrong"]


def _gyro_mounting(array, state):
    """A text on a gyroscope's scales or axes that are far beyond what was said of them."""
    own = array.channels[array.channels["is_gyro"]]
    if not len(own):
        return []
    scale, _ = _states(state, own["scale"])
    turn, _ = _states(state, own["turn"][0] + np.arange(3))
    found = []
    if np.any(np.abs(scale) > _BEYOND * own["scale_sd"][0]):
        found.append(f"scales that are off by {_vector(100.0 * scale, 1)} % (sensor.gyro_scale_sd)")
    if np.any(np.abs(turn) > _BEYOND * own["axes_sd"][0]):
        found.append(f"axes turned by {_vector(np.degrees(turn), 1)} deg (sensor.gyro_axes_sd)")
    return ["the gyroscope fits best with " + " and ".join(found) + "; what is stated is "
            "larger by as much: calibrate it, or raise what is in brackets"] if found else []


def _together(fits, array):
    """A text on mountings none of which is far off, while all of them together are."""
    squares, number = 0.0, 0
    for k, fit in enumerate(fits):
        own = array.channels[array.channels["sensor"] == k][0]
        for error, sd in ((fit.position_error, own["position_sd"]),
                          (fit.axes_error, own["axes_sd"]), (fit.scale_error, own["scale_sd"])):
            known = error[np.isfinite(error)]
            squares += float(np.sum((known / sd) ** 2))
            number += len(known)
    if number == 0 or squares < scipy.special.chdtri(number, _UNLIKELY):
        return []
    return ["positions, axes and scales of the accelerometers, taken together, fit best "
            f"{np.sqrt(squares / number):.2g} times as far from what is described as their sds "
            "say; what is stated is larger by as much: calibrate them, or raise "
            "sensor.acc_position_sd, sensor.acc_axes_sd and sensor.acc_scale_sd"]


def _states(state, index):
    """States of numbers ``index`` and their standard deviations; nan if there are none."""
    if index[0] < 0:
        return np.full(len(index), np.nan), np.full(len(index), np.nan)
    return state.x[index], np.sqrt(np.diag(state.cov)[index])


def _mounting(name, own, shift, turn, scale):
    """Texts on a mounting that is not as described."""
    remarks = []
    # What the data do not tell stays near zero: an estimate far from it is one.
    if np.any(np.abs(shift) > _BEYOND * own["position_sd"][0]):
        remarks.append(
            f"accelerometer '{name}' fits best {_vector(1e3 * shift, 1)} mm from its position: "
            f"correct accelerometers.{name}.position, or raise position_sd; or its noise_density "
            "or the densities of motion are too small for this motion, and so is what is stated")
    if np.any(np.abs(turn) > _BEYOND * own["axes_sd"][0]):
        remarks.append(
            f"accelerometer '{name}' fits best turned by {_vector(np.degrees(turn), 1)} deg about "
            f"the body's axes: correct accelerometers.{name}.axes, or raise axes_sd; or its "
            "noise_density or the densities of motion are too small for this motion, and so is "
            "what is stated")
    if np.any(np.abs(scale) > _BEYOND * own["scale_sd"][0]):
        remarks.append(
            f"accelerometer '{name}' fits best with scales that are off by "
            f"{_vector(100.0 * scale, 1)} %: calibrate it, or raise scale_sd")
    return tuple(remarks)


def _cause(name, check, own):
    """Why it contradicts the others, and what to do, by the sums of a CHECK."""
    expected, product = check["expected"], check["reading"]
    energy, along = float(np.trace(expected)), float(np.trace(product))
    squares = float(check["read_squares"])
    unexplained = float(check["unexplained"])
    count = int(check["left_out"])
    spread = squares - float(np.sum(check["read"] ** 2)) / count
    if spread < _STILL * energy:
        value = check["read"] / count
        return (f"it stands still at {_vector(value, 2)} m/s^2: it is dead, disconnected or not "
                "measured")
    turn, left = _best_axes(product, squares, energy)
    if left < _EXPLAINED * unexplained:
        letters = ["xyz"[int(np.argmax(np.abs(row)))] for row in turn]
        signs = ["-" if row.sum() < 0 else "" for row in turn]
        axes = ", ".join(sign + letter for sign, letter in zip(signs, letters))
        return (f"its axes x, y, z read what is expected of ({axes}): correct "
                f"accelerometers.{name}.axes")
    scale = along / energy
    if squares - scale * along < _EXPLAINED * unexplained:
        return (f"it reads {scale:.3g} times what is expected: check its unit and its range")
    shift, explained = _best_shift(check)
    if unexplained - explained < _EXPLAINED * unexplained:
        return (f"it seems to sit {_vector(1e3 * shift, 0)} mm from its position: correct "
                f"accelerometers.{name}.position")
    turn, left = _best_turn(product, squares, energy)
    if left < _EXPLAINED * unexplained:
        angle = np.degrees(scipy.spatial.transform.Rotation.from_matrix(turn).magnitude())
        return (f"it seems to be turned by {angle:.0f} deg: correct accelerometers.{name}.axes")
    return "check its mounting, cable, range and description"


def _best_axes(product, squares, energy):
    """The signed permutation (3, 3) of expected axes that the readings follow best, and the squares
    that it leaves over."""
    best, left = np.eye(3), np.inf
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = np.diag(signs) @ np.eye(3)[list(order)]
            remains = squares - 2.0 * float(np.sum(turn * product)) + energy
            if remains < left:
                best, left = turn, remains
    return best, left


def _best_turn(product, squares, energy):
    """As :func:`_best_axes`, any rotation (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(product)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return turn, squares - 2.0 * float(np.sum(turn * product)) + energy


def _best_shift(check):
    """The shift (3,) m of the sensor that explains most, and the squares that it explains."""
    shift = np.linalg.lstsq(check["place"], check["pull"], rcond=1e-3)[0]
    return shift, float(shift @ check["pull"])


def _vector(values, digits):
    return "(" + ", ".join(f"{v:.{digits}f}" for v in values) + ")"
