"""What makes a smoothed result doubtful, in words: what was seen, and what may mend it."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from imu_fusion.estimation.smoother.measurements.registry import MEASUREMENTS
from imu_fusion.estimation.smoother.surface_place import fixes_beside
from imu_fusion.estimation.smoother.touch_down import FOLLOWS

if TYPE_CHECKING:
    from imu_fusion.estimation.smoother.result import Outliers, SmootherResult

_MISFIT = 3.0
# RMS of a single pass. Simulated jumps: 1.0 to 1.1 where the attitude is within 1 deg of the truth,
# 1.7 where it is 6 deg off.
_SINGLE_PASS = 1.3
MOST_EXCESS = 1.5            # of the deviation from a surface; see smoother_surface_fit
# Simulated jumps, sunk by 0.3 m: up to 1.4; by 0.7 m, or a fall of 0.4 m: from 2.5.
MOST_FIRST_EXCESS = 2.0
_LEAP_SECONDS = 18.0         # s, GPS time ahead of UTC since 2017
_SILENT = 0.01               # share of the samples
_OUTLYING = 0.05             # share of the readings
_RUN = 10                    # outliers in a row: single ones are what the loss is for
_BESIDE = 4.0                # standard deviations of the mean residual of fixes
_WANDERS = {
    "fix": "of the receiver: gnss.position_error_sd; a change of datum or antenna",
    "velocity": "of the receiver: gnss.velocity_error_sd",
    "mag": "of the field: iron nearby, sensor.mag_bias_sd"}
_SENSORS = {"gyr": "rates of the gyroscope", "mag": "magnetometer samples"}
_ADVICE = {m.name: m.advice for m in MEASUREMENTS}


def remarks_on(result: "SmootherResult") -> Iterator[str]:
    """Texts on what a user should know before trusting a SmootherResult."""
    if result.converged is False:
        yield (f"the smoother did not converge in {result.iterations} iterations: take its "
               "result as provisional")
    if result.left_out and result.start_found:
        yield (f"the recording begins in motion, and initial.speed_sd says that the body rests: "
               f"the first {result.left_out} Imu samples, before its last rest, are left out "
               "(initial.start chooses another start)")
    yield from _on_missing_imu(result)
    yield from _on_lost_turns(result)
    yield from _on_clipped_forces(result)
    yield from _on_centre(result)
    yield from _on_stamps(result)
    yield from _on_repeats(result)
    yield from _on_step(result)
    yield from _on_single_pass(result)
    yield from _on_adapted(result)
    yield from _on_misfits(result)
    yield from _on_outliers(result)
    yield from _on_wander(result)
    yield from _on_place(result)
    yield from _on_flight(result)
    yield from _on_surface(result)


def _on_missing_imu(result):
    if result.acc_density is not None:
        yield ("no Imu samples: the trajectory is of fixes and velocities alone, and the attitude "
               "is not known. Between them the velocity changes by white accelerations of "
               f"{result.acc_density:.2g} m/s^2/sqrt(Hz)"
               ", and the fixes wander by what is stated of them (gnss.position_error_sd)")


def _on_lost_turns(result):
    if result.lost_turns:
        when = ", ".join(f"{(stamp - int(result.samples['stamp'][0])) * 1e-9:.1f}"
                         for stamp in result.lost_turns)
        yield (f"the turn about the magnetic field was lost (a gap in the Imu samples, or rates "
               f"beyond the range) {when} s after the first Imu sample: of several that fit what "
               "follows about as well the likeliest is taken, and attitude and trajectory from "
               "there on may be wrong by more than is stated; more fixes, or a surface known "
               "better, tell")


def _on_clipped_forces(result):
    count, limit = result.clipped_forces
    if count:
        yield (f"the accelerometer was at the end of its range in {count} samples, as readings of "
               f"{limit:.4g} m/s^2 that repeat tell: what was felt beyond is not known, and counts "
               "as gap.acc_noise_density says (sensor.acc_range gives the range)")


def _on_centre(result):
    if result.centre is not None:
        there = ", ".join(f"{v:.3f}" for v in result.centre)
        yield (f"the body tumbles about a point [{there}] m from the accelerometers, which is not "
               "surface.lever_arm, as the forces at high rates tell: flights are not seen for what "
               "they are, and the surface holds the wrong point. Put it there, and into "
               "gnss.lever_arm where the antenna is in the centre")


def _on_stamps(result):
    of_fixes, of_velocities = result.gnss_lag, result.gnss_lag + result.velocity_lag
    lags = [("fixes and velocities", of_fixes)] if of_fixes == of_velocities else [
        ("fixes", of_fixes), ("velocities", of_velocities)]
    for what, lag in lags:
        if not lag:
            continue
        leap = ": GPS time that was not turned into UTC" if abs(
            abs(lag) - _LEAP_SECONDS) < 0.5 else ""
        yield (f"the stamps of {what} are {abs(lag):.1f} s "
               f"{'late' if lag > 0 else 'early'} against those of the Imu, as turns and forces "
               f"tell{leap}; they were taken so much {'earlier' if lag > 0 else 'later'}. Correct "
               "the recording, or see that both clocks are one")
    if result.clock_rate:
        yield (f"the clock of fixes and velocities runs by {1e6 * abs(result.clock_rate):.0f} "
               f"millionths {'faster' if result.clock_rate > 0.0 else 'slower'} than that of the "
               "Imu; their stamps were taken as much closer to the middle of the recording or "
               "farther from it. Give both the stamps of one clock")
    if result.height_scale != 1.0:
        yield (f"heights of the fixes change {result.height_scale:.1f} times as much as forces "
               "say, or more: they may be in another unit, as feet (3.28), and all "
               "heights are off by as much. Give fixes their heights in metres")
    for name, lag in result.late.items():
        what, other = _SENSORS[name], _SENSORS["gyr" if name == "mag" else "mag"]
        yield (f"{what} are {abs(lag) * 1e3:.0f} ms {'late' if lag > 0.0 else 'early'} against "
               f"forces and {other}; they were taken so much "
               f"{'earlier' if lag > 0.0 else 'later'}. Give all of them the stamps of their "
               "measurements")


def _on_repeats(result):
    told = [f"{count} of the {name} readings" for name, count in result.repeats.items() if count]
    if told:
        yield (" and ".join(told) + " are the one before exactly, and contradict the rest: a "
               "receiver or driver that holds its last; they are left out")


def _on_step(result):
    step = result.gnss_step
    if step is not None:
        when = (step.stamp - int(result.samples["stamp"][0])) * 1e-9
        yield (f"from {when:.1f} s after the first Imu sample on the fixes lie "
               + "/".join(f"{o:+.1f}" for o in step.offset) + " m (east/north/up) of those "
               "before, a step that the Imu did not feel: another height datum, antenna or base. "
               "Positions are those of the fixes before it; if the later ones are right, all "
               "positions are off by as much")


def _on_single_pass(result):
    """A single pass: no iteration mends a wrong first attitude. By the RMS, as what that costs the
    first seconds is lost in a median."""
    if result.converged is not None:
        return
    rms = {name: float(np.sqrt(np.mean(values ** 2)))
           for name, (_, values) in result.innovations.items() if len(values)}
    name = max(rms, key=lambda name: rms[name], default=None)
    if name and rms[name] > _SINGLE_PASS:
        yield (f"the {name} innovations of the single pass have an RMS of {rms[name]:.1f} standard "
               "deviations: it may have begun with a wrong attitude and kept to it, or the noise "
               "is another; method: iterated starts from several and repeats")


def _on_adapted(result):
    adapted = {name: value for name, value in result.adapted.items()
               if name != "jump.event_margin"}
    if adapted or result.noise:
        taken = [f"{name}: {_short(value)}" for name, value in adapted.items()]
        if "gnss.time_offset_sd" in adapted:
            delay, sd = (values[0, 0] for values in result.states["gnss_time_offset"])
            taken.append(f"fixes {delay:.2f} s late (standard deviation {sd:.2f} s)")
        if "gnss.lever_arm_sd" in adapted:
            lever, sds = (", ".join(f"{v:.2f}" for v in values[0])
                          for values in result.states["gnss_lever_arm"])
            taken.append(f"an antenna at [{lever}] m in the axes of the sensor (standard "
                         f"deviations {sds} m), which is not gnss.lever_arm: see its sign, axes "
                         "and unit")
        taken += [f"{factor:.2g} times the stated standard deviations of {name}"
                  for name, factor in result.noise.items()]
        yield ("with the noise as given the innovations are not white, or larger than stated; "
               "taken instead is " + ", ".join(taken) + ". Put it into the parameters "
               "to keep it (maximum_likelihood: off keeps those given)")


def _short(value):
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_short, value))}]"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _on_misfits(result):
    for name, size in result.misfit().items():
        if size > _MISFIT:
            yield (f"the {name} innovations are {size:.1f} times as large as their standard "
                   f"deviations: {_ADVICE[name]}")


def is_many(outliers: "Outliers") -> bool:
    """Whether Outliers are more than the single ones that the loss is for."""
    return outliers.share > _OUTLYING or outliers.longest >= _RUN


def _on_outliers(result):
    for name, outliers in result.outliers().items():
        if is_many(outliers):
            yield (f"{100 * outliers.share:.0f} % of the {name} readings lie far beside the "
                   "trajectory and hardly count, up to "
                   f"{outliers.longest} in a row ({outliers.duration:.1f} s): {_ADVICE[name]}")


def _on_wander(result):
    for name, excess in result.wander.items():
        if excess > 1.0:
            yield (f"the {name} innovations wander: their means over seconds are {excess:.1f} "
                   "times as large as white noise leaves them: a step or slow errors "
                   f"({_WANDERS.get(name, 'sensor noise')}), or noise and bias walks of the Imu "
                   "that are too small (sensor.gyro_noise_density, sensor.acc_noise_density, "
                   "sensor.gyro_bias_walk, sensor.acc_bias_walk); the standard deviations of "
                   f"{'headings' if name == 'mag' else 'all'} are as much larger")


def _on_place(result):
    """Means of the residuals of fixes that cannot be chance where a surface holds the trajectory;
    or the error that was taken, as it can be the surface's as well."""
    if not result.surface or "fix" not in result.residuals:
        return
    middle, sd = fixes_beside(result.residuals["fix"], result.wander.get("fix", 1.0))
    unit = "of their standard deviations"
    taken = "gnss.position_error_sd" in result.adapted
    if taken:
        middle, unit = np.median(result.states["gnss_position_error"][0], axis=0), "m"
    if taken or np.abs(middle).max() > _BESIDE * sd:
        yield ("the fixes lie beside the trajectory that the surface holds, by "
               + "/".join(f"{b:+.1f}" for b in middle) + f" {unit} (east/north/up): the origin of "
               "the surface may be off, the sensor ride above it (surface.body_height) or the "
               "fixes wander (gnss.position_error_sd)")


def _on_flight(result):
    if result.jump is not None and result.near_ground > FOLLOWS:
        yield (f"for {result.near_ground:.1f} s before the touch-down the flight is close to the "
               "landing profile or below it: the touch-down may have been earlier, and the length "
               "is less certain by as much (jump.touchdown gives it)")
    if "jump.event_margin" in result.adapted:
        yield ("the first second of the landing stands off the profile, and what follows does not: "
               "a deep landing; heights of that second are left out (jump.event_margin)")
    if result.profile.sds:
        yield (f"heights of the landing profile are {abs(result.profile.metres):.1f} m too "
               f"{'large' if result.profile.metres > 0.0 else 'small'} for the motion that was "
               f"felt ({abs(result.profile.sds):.0f} standard deviations): snow, another profile "
               "or origin of it. It counts as much less (a larger sigma of the landing)")
    if not result.stands:
        beside = float(np.median(result.surface["landing"].residual))
        yield (f"after the touch-down the sensor is {abs(beside):.1f} m "
               f"{'above' if beside > 0.0 else 'below'} its height on the landing profile: a fall, "
               "or another profile. Heights there hardly count; the length rests on in-run, flight "
               "and fixes")


def _on_surface(result):
    for name, fit in result.surface.items():
        if fit.silent > _SILENT:
            yield (f"the surface ({name}) says nothing at {100 * fit.silent:.0f} % of the samples "
                   "that it should hold: its grid may end there")
        if fit.first_excess > MOST_FIRST_EXCESS and fit.excess <= MOST_EXCESS and result.jump:
            yield (f"in the first second the trajectory stands off the surface ({name}) by "
                   f"{fit.first_excess:.1f} times as much as its sigma of {fit.sigma:g} m allows: "
                   "a fall, a deep landing or another touch-down; standard deviations of the "
                   "landing are as much larger (jump.event_margin, jump.touchdown)")
        if fit.excess > MOST_EXCESS:
            yield (f"the trajectory stands off the surface ({name}) by {fit.rms:.2f} m (RMS; "
                   f"largest {fit.largest:.2f} m), over seconds {fit.excess:.1f} times as much as "
                   f"its sigma of {fit.sigma:g} m allows: the surface may be another than the one "
                   "given, or the sensor move against it (a larger sigma or surface.interval, "
                   "surface.body_height_sd)"
                   + ("" if result.jump else "; the standard deviations of all are as much larger"))
