"""What else may be true of a recording whose readings contradict the model, and the evidence.

Only where innovations wander or are larger than stated, and nothing else explains it: each
hypothesis is smoothed, and kept if the readings are a thousand times as likely under it. Then the
noise is fitted.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from imu_fusion.errors import EstimationError
from imu_fusion.estimation.smoother.attempt import Attempt, Model, clipped_forces, other_centre
from imu_fusion.estimation.smoother.gnss_step import find_steps
from imu_fusion.estimation.smoother.measurements.registry import (
    FIX,
    KINDS,
    MEASUREMENTS,
    MOVED_FIX,
)
from imu_fusion.estimation.smoother.noise_fit import fit_noise
from imu_fusion.estimation.smoother.problem import log_density
from imu_fusion.estimation.smoother.profile_fit import profile_error, widened_by_profile
from imu_fusion.estimation.smoother.receiver_fit import (
    clock_error,
    delay_of_fixes,
    height_error,
    lever_errors,
)
from imu_fusion.estimation.smoother.remarks import MOST_EXCESS, MOST_FIRST_EXCESS, is_many
from imu_fusion.estimation.smoother.result import SmootherResult
from imu_fusion.estimation.smoother.sensor_lag import field_lag
from imu_fusion.estimation.smoother.touch_down import is_doubtful, stands_at_touch_down
from imu_fusion.estimation.smoother.whiteness import correlation, wandering

_GAIN = 7.0          # of the log-likelihood: odds of a thousand
_LEFT = 0.5          # of how much fixes wander, that a step of them may leave
_LARGE = 1.5         # standard deviations, of typical innovations of the receiver
_FEWEST = 20         # readings of a kind, of which a typical size is no chance
_DELAY, _VELOCITY_DELAY = "gnss.time_offset_sd", "gnss.velocity_time_offset_sd"
_LEVER = "gnss.lever_arm_sd"
_SHIFTED = (2.0 * _GAIN) ** 0.5   # standard deviations of an error of the antenna: less gains less
_DRIFTS = 12.0       # and of the clock: velocities of a real receiver, whose lag varies, get to 6
_SCALED, _MUCH = 10.0, 0.2   # standard deviations of a scale of heights, and the least of it
_LEVER_SD = 1.0      # m, or twice as far as the antenna is said to be: what a wrong sign makes
_CLOCK_TRIES = 4     # a trajectory that is bent by a clock tells a part of what it is off by
_LONGEST_DELAY = 2.0   # s, of fixes alone; velocities tell what is longer, see gnss_lag
_PERHAPS = 1.0       # standard deviation of a delay that is tried: far from it they err
_LAG_TRIES = 3       # what turns to and fro within a lag tells only a part of it
_FIELD_TRIES = 3     # a magnetometer that counts less leaves larger residuals
_SINKS = 1.0         # s after touch-down, in which a jumper who landed deeply has risen again
_BESIDE = 0.3        # m from the profile: as near as a contact is told to be
_OTHER_PROFILE = 3.5   # standard deviations of an error of a profile that is no chance
_DOUBTED_PROFILE = 2.0   # and of one that hardly is
_MAD = 1.4826        # standard deviations of a normal distribution in a median deviation


def fits(result: SmootherResult) -> bool:
    """Whether innovations of the receiver are white and no larger than they should be. Smaller
    ones are no reason, if they are white: what is stated then is too cautious, and not wrong. A
    magnetometer's are none: iron is no noise."""
    return (all(excess == 1.0 for name, excess in result.wander.items() if name != "mag")
            and not any(len(values) >= _FEWEST and correlation(values)
                        for name, (_, values) in result.innovations.items() if name != "mag")
            and all(size < _LARGE or len(result.innovations[name][0]) < _FEWEST
                    for name, size in result.misfit().items() if name != "mag"))


def contradicted(result: SmootherResult) -> bool:
    """Whether a surface is what does not fit. Any other explanation would hide it."""
    return any(fit.excess > MOST_EXCESS or fit.first_excess > MOST_FIRST_EXCESS
               for fit in result.surface.values())


def likelier(found: Attempt, model: Model, smooth: Callable[[Model], Attempt]) -> SmootherResult:
    """The result of the likeliest model.

    Args:
        found: under ``model``. smooth: a model -> its Attempt.
    """
    given = model.params.to_mapping()
    model = model._replace(rests=found.result.rests)    # likelihoods are of the same rows
    found, model = _deep_landing(found, model, smooth)
    found, model = _fall(found, model, smooth)
    found, model = _other_profile(found, model, smooth)
    if contradicted(found.result):
        return _adapted(found, model, given)
    if model.params.maximum_likelihood != "off":
        found, model = _other_antenna(found, model, smooth)
        found, model = _other_clock(found, model, smooth)
        found, model = _other_time(found, model, smooth)
        found, model = _bent_field(found, model, smooth)
    found, model = _repeated(found, model, smooth)
    # Where fixes scatter more than stated, chance makes larger steps, and gains.
    scatter = max(1.0, found.result.misfit().get("fix", 1.0))
    for other in _steps(found.result, model, scatter):
        tried, chosen = _try(found, model, other, smooth, _GAIN * scatter ** 2)
        if chosen is other and _left(tried.result) <= max(1.0, _LEFT * _left(found.result)):
            found, model = tried, other
            break
    if (model.params.maximum_likelihood != "off" and "velocity" not in found.result.innovations
            and len(found.result.innovations.get("fix", ((),))[0]) >= _FEWEST):
        found, model = _late_fixes(found, model, smooth)
        found, model = _other_clock(found, model, smooth)
    # Readings in a row far beside the trajectory are no noise either.
    if (model.params.maximum_likelihood == "off" or fits(found.result)
            or _many_outliers(found.result)):
        return _adapted(found, model, given)
    for alternatives in (_delays, _velocity_delays, _wandering_fixes, _wandering_velocities,
                         _walks):
        for other in alternatives(found, model):
            found, model = _try(found, model, other, smooth)
    # What wanders can have looked like a delay, or another antenna.
    for name in (_DELAY, _VELOCITY_DELAY, _LEVER):
        if model.params.get(name) != given[name]:
            found, model = _try(found, model, model.changed({name: given[name]}), smooth, -_GAIN)
    # Or like a step.
    if model.step_at is not None:
        found, model = _try(found, model, model._replace(step_at=None), smooth, -_GAIN)
    found, model = _try(found, model, fit_noise(found.problem, model), smooth)
    if model.params.gnss.position_error_sd != tuple(given["gnss.position_error_sd"]):
        found, model = _no_surer_than_stated(found, model, given, smooth)
    return _adapted(found, model, given)


def _other_antenna(found, model, smooth):
    """With an antenna that is not where it is said to be, or fixes and velocities that are late,
    which is much the same to a body that goes straight on."""
    sd = max(_LEVER_SD, 2.0 * float(np.linalg.norm(model.params.gnss.lever_arm)))
    for _ in range(2):
        sds = max(abs(error.sds) for error in lever_errors(found.problem))
        if sds < _SHIFTED * found.result.wander.get("fix", 1.0):
            break
        others = (*_where_zero(model, {_LEVER: sd}), *_delays(found, model),
                  *_where_zero(model, {_DELAY: 0.2, _VELOCITY_DELAY: 0.2}))
        best = _likeliest(found, model, others, smooth)
        if best[0] is found:
            break
        found, model = best
    return found, model


def _other_clock(found, model, smooth):
    """With a receiver whose clock runs faster or slower, and may be off in the middle, too."""
    for _ in range(_CLOCK_TRIES):
        error, known = clock_error(found.problem), model.clock_rate != 0.0
        if abs(error.sds) < (1.0 if known else
                             _DRIFTS * found.result.wander.get("fix", 1.0)):
            break
        other = model._replace(clock_rate=model.clock_rate + error.size)
        best = _likeliest(found, model, (other, *_delays(found, other)), smooth,
                          0.0 if known else _GAIN)
        if best[0] is found:
            break
        found, model = best
    return found, model


def _late_fixes(found, model, smooth):
    """With fixes alone that are late: a smooth path hardly contradicts seconds of that. Those of
    its ends alone would be free of either."""
    for other in _where_zero(model, {_DELAY: _LONGEST_DELAY}):
        if abs(delay_of_fixes(found.problem).sds) > _PERHAPS:
            found, model = _try(found, model, other, smooth)
    return found, model


def _scale_of_heights(found):
    """How many times as much as the body heights of fixes alone surely change; else 1. Velocities
    would contradict them."""
    if "velocity" in found.result.innovations:
        return 1.0
    error = height_error(found.problem)
    sure = abs(error.sds) > _SCALED * found.result.wander.get("fix", 1.0)
    return 1.0 + error.size if sure and abs(error.size) > _MUCH else 1.0


def _adapted(found, model, given):
    """The result with what was taken in place of the parameters that were given."""
    return replace(found.result, noise=dict(model.noise), stands=model.stands,
                   height_scale=_scale_of_heights(found),
                   profile=model.profile, late=dict(model.late), clock_rate=model.clock_rate,
                   centre=other_centre(found.problem),
                   clipped_forces=clipped_forces(found.problem), adapted={
        name: value for name, value in model.params.to_mapping().items()
        if value != given[name]})


def _deep_landing(found, model, smooth):
    """Without the heights of the second in which a body sinks deeply, if it stands afterwards; not
    compared by likelihood, as these rows are left out."""
    fit = found.result.surface.get("landing")
    if (found.result.jump is None or fit is None or model.params.jump.event_margin >= _SINKS
            or not (is_doubtful(found.result) or fit.first_excess > MOST_FIRST_EXCESS)):
        return found, model
    other = model.changed({"jump.event_margin": _SINKS})
    tried = _smoothed(other, smooth)
    if tried is None:
        return found, model
    lands = (tried.result.jump is not None and not is_doubtful(tried.result)
             and stands_at_touch_down(tried.result, tried.problem.constraints, other.params))
    better = is_doubtful(found.result) or (lands and tried.result.surface["landing"].first_excess
                                           < fit.first_excess)
    return (tried, other) if lands and better else (found, model)


def _fall(found, model, smooth):
    """With a body that lies after the touch-down at some height of its own, if it is beside the
    profile then, and was not when it touched down; not compared by likelihood, as these rows do not
    count."""
    fit = found.result.surface.get("landing")
    if found.result.jump is None or fit is None or not (
            fit.excess > MOST_EXCESS or fit.first_excess > MOST_FIRST_EXCESS):
        return found, model
    other = model._replace(stands=False)
    tried = _smoothed(other, smooth)
    if tried is None:
        return found, model
    lies = (tried.result.jump is not None and not is_doubtful(tried.result)
            and stands_at_touch_down(tried.result, tried.problem.constraints, other.params)
            and abs(np.median(tried.result.surface["landing"].residual)) > _BESIDE)
    return (tried, other) if lies else (found, model)


def _other_profile(found, model, smooth):
    """With a landing profile that counts as much less as an error of it is beyond chance; not
    compared by likelihood, as that of the error itself is the evidence: as far as fixes do not
    wander. One that may be chance widens what is stated."""
    events = found.result.events
    if found.result.jump is None or not model.stands or contradicted(found.result):
        return found, model
    error = profile_error(found.problem, events)
    sds = abs(error.sds) / found.result.wander.get("fix", 1.0)
    if sds < _OTHER_PROFILE:
        return (found if sds < _DOUBTED_PROFILE else found._replace(
            result=widened_by_profile(found.result, error))), model
    other = model._replace(profile=error)
    tried = _smoothed(other, smooth)
    if tried is None or tried.result.jump is None:
        return found, model
    return tried, other


def _repeated(found, model, smooth):
    """Without readings that are the one before exactly, of a receiver that holds its last while the
    body moves, if the others fit then, or far better; not compared by likelihood, as these rows are
    left out."""
    if fits(found.result) and not _many_outliers(found.result):
        return found, model
    other = model._replace(repeats=False)
    tried = _smoothed(other, smooth)
    if tried is None or not tried.result.repeats or _many_outliers(tried.result):
        return found, model
    better = fits(tried.result) or _left(tried.result) <= max(1.0, _LEFT * _left(found.result))
    return (tried, other) if better else (found, model)


def _many_outliers(result):
    return any(is_many(outliers) for outliers in result.outliers().values())


def _other_time(found, model, smooth):
    """With a magnetometer, or rates, of another time."""
    for _ in range(_LAG_TRIES):
        mag, predicted = _field(found)
        lag = field_lag(mag["stamp"], predicted, found.result.residuals.get("mag", predicted),
                        bool(model.late))
        # Recovered rates are of no single time.
        if not lag or found.problem.imu.log.gyr_sd is not None:
            break
        others = [model._replace(late={name: model.late.get(name, 0.0) + more})
                  for name, more in (("mag", lag), ("gyr", -lag))
                  if not model.late or name in model.late]
        best = _likeliest(found, model, others, smooth, 0.0)
        if best[0] is found:
            break
        found, model = best
    return found, model


def _bent_field(found, model, smooth):
    """With a magnetometer that counts as much less as the field wanders; not compared by
    likelihood, which has no name for iron.

    Along the field no attitude shows, so what wanders there is the field.
    """
    for _ in range(_FIELD_TRIES):
        excess = _field_wanders(found)
        if excess == 1.0:
            break
        other = model._replace(noise={**model.noise, "mag": excess * model.noise.get("mag", 1.0)})
        tried = _smoothed(other, smooth)
        if tried is None:
            break
        found, model = tried, other
    return found, model


def _field_wanders(found):
    """How much more the residuals along the field wander than white noise does."""
    mag, field = _field(found)
    if not len(mag):
        return 1.0
    # Not along what was read: noise has made that longer.
    field /= np.linalg.norm(field, axis=1, keepdims=True)
    along = np.sum(found.result.residuals["mag"] * field, axis=1, keepdims=True)
    return wandering(mag["stamp"], along)


def _field(found):
    """Magnetometer samples (m,) of records.READING, and what was expected of them (m, 3), in their
    standard deviations."""
    readings = found.problem.readings
    mag = readings[readings["kind"] == KINDS["mag"]]
    if not len(mag):
        return mag, mag["value"]
    read = np.einsum("nij,nj->ni", mag["whiten"], mag["value"])
    return mag, read - found.result.residuals["mag"]


def _delays(found, model):
    return _where_zero(model, {_DELAY: 0.2})


def _velocity_delays(found, model):
    return _where_zero(model, {_VELOCITY_DELAY: 0.2})


def _walks(found, model):
    return _where_zero(model, {"sensor.gyro_bias_walk": 1e-4, "sensor.acc_bias_walk": 3e-3})


def _wandering_velocities(found, model):
    return _wandering(found, model, "velocity", "gnss.velocity_error")


def _wandering_fixes(found, model):
    return _wandering(found, model, "fix", "gnss.position_error")


def _wandering(found, model, name, error):
    """What is left of readings as an error that wanders and noise that is white.

    Neighbours differ by the noise. What else is left, the trajectory has followed in part.
    """
    left = found.result.residuals.get(name, ())
    if len(left) < _FEWEST:
        return
    white = float(_MAD * np.median(np.abs(np.diff(left, axis=0))) / np.sqrt(2.0))
    slow = np.sqrt(np.maximum(np.mean(np.square(left), axis=0) - white ** 2, white ** 2))
    sd = slow * _sd_of_readings(found, name)
    for more in (1.0, 3.0):
        for other in _where_zero(model, {f"{error}_sd": tuple((more * sd).tolist())}):
            yield other._replace(noise={**model.noise, name: white * model.noise.get(name, 1.0)})


def _no_surer_than_stated(found, model, given, smooth):
    """With errors of the fixes that are no smaller in all than what the receiver and the parameters
    state.

    How fast they wander is told by the recording, an offset of all is not: the same variance
    density, and a longer time.
    """
    sd = _sd_of_readings(found, "fix")
    stated = np.square([sd / model.noise.get("fix", 1.0), given["gnss.position_error_sd"]])
    gnss = model.params.gnss
    longer = (stated.sum() - np.sum(sd ** 2)) / np.sum(np.square(gnss.position_error_sd))
    if longer <= 1.0:
        return found, model
    return _try(found, model, model.changed({
        "gnss.position_error_sd": tuple(np.sqrt(longer) * s for s in gnss.position_error_sd),
        "gnss.position_error_tau": float(longer) * gnss.position_error_tau}), smooth, -np.inf)


def _sd_of_readings(found, name):
    """Typical standard deviations (k,) of readings, as they count."""
    readings = found.problem.readings
    root = np.linalg.inv(readings["whiten"][readings["kind"] == KINDS[name]])
    return np.median(np.sqrt(np.sum(root ** 2, axis=2)), axis=0)


def _where_zero(model, changes):
    """The model with other values of parameters, unless they were set."""
    if not any(np.any(model.params.get(name)) for name in changes):
        yield model.changed(changes)


def _try(found, model, other, smooth, gain=_GAIN):
    """The attempt and model that are likelier by a gain, else those found."""
    return _likeliest(found, model, (other,), smooth, gain)


def _likeliest(found, model, others, smooth, gain=_GAIN):
    """The likeliest of attempts under other models, and its model, if it is by a gain; else those
    found."""
    best = found, model
    for other in others:
        tried = _smoothed(other, smooth)
        if tried is not None and (gained := _gained(tried, found)) > gain:
            best, gain = (tried, other), gained
    return best


def _smoothed(other, smooth):
    """The Attempt under another model, None where there is none."""
    try:
        return smooth(other)
    except EstimationError:
        return None


def _gained(tried, found):
    """By how much the log-likelihood is larger. Readings that another delay has moved beyond the
    Imu count as such that fit."""
    gained = tried.result.log_likelihood - found.result.log_likelihood
    before, after = (np.where(one.problem.readings["kind"] == MOVED_FIX, FIX,
                              one.problem.readings["kind"]) for one in (found, tried))
    for kind in np.unique(before):
        of_kind = found.problem.readings[before == kind]
        lost = len(of_kind) - np.count_nonzero(after == kind)
        gained += lost * (log_density(of_kind) / len(of_kind)
                          - 0.5 * len(MEASUREMENTS[kind].components))
    return gained


def _steps(result: SmootherResult, model: Model, scatter: float) -> Iterator[Model]:
    """Models with a step of the fixes, where there seems to be one."""
    if "fix" in result.residuals:
        for at in find_steps(result.innovations["fix"][0], result.residuals["fix"] / scatter,
                             result.wander["fix"] == 1.0):
            yield model._replace(step_at=at)


def _left(result: SmootherResult) -> float:
    """How much fixes wander: all the time, where it is no step."""
    return max(result.wander.get(name, 1.0) for name in ("fix", "moved_fix"))
