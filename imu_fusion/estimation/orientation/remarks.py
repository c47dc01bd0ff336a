"""What makes estimates doubtful, in words, and what to do about it."""

import numpy as np

from imu_fusion.estimation.orientation import error_state as es
from imu_fusion.estimation.orientation import wander

# By how much more than stated a scale is surely (3 sigma) off where it is said: 6 %, what no
# hypothesis expects. Chosen between recordings made 8 % worse and those of the sets as they are,
# of which a phone in a runner's pocket gets to 5.6 %.
_FAR_OFF = 12.0
# Likewise of an accelerometer: 2.5 %, what none of the sets gets to.
_BIASED = 5.0
_STUCK = 5_000_000_000     # ns of one value: no magnetometer is as slow


def remarks(state: np.ndarray, par: np.ndarray, realigned: int, blind: bool = False) -> list[str]:
    """Remarks on one hypothesis.

    Args:
        state: its record. par: its parameters.
        realigned: how many rests have refuted bias and attitude.
        blind: whether the start told no attitude (:func:`.lost_turn.is_blind`).
    """
    found = []
    if realigned:
        found.append(
            f"{realigned} time{'s' * (realigned != 1)} rates and forces stood still where the "
            "estimate took its gyroscope to turn: bias and attitude were wrong by more than "
            "they were stated to be, and begin anew there; begin at rest, calibrate the "
            "gyroscope (imu_fusion calibrate gyroscope) or raise sensor.gyro_bias_sd")
    if blind:
        found.append(
            "the samples begin in motion, or go on in motion after a gap in which all starts "
            "anew (gap.restart), and forces are not used (fusion.use_acc): nothing shows the "
            "vertical, the orientation there may be any; begin at rest")
    scale = np.diag(state["gyro_scale"])
    variance = np.diag(state["cov"])[es.GYRO_SCALE:es.VELOCITY].reshape(3, 3)
    surely = np.abs(scale) - 3.0 * np.sqrt(np.maximum(np.diag(variance), 0.0))
    if (surely > _FAR_OFF * par["sensor"]["gyro_scale_sd"] / par["gyro_factor"]).any():
        found.append(
            "the gyroscope's scale is off by "
            + ", ".join(f"{round(-100.0 * value)}" for value in scale)
            + " % (x, y, z), far more than stated: until that was found, for some 10 s after "
            "motion began, estimates are further off than they state; calibrate it (imu_fusion "
            "calibrate gyroscope) or raise sensor.gyro_scale_sd")
    iron = state["hard_iron"]
    if iron["found"]:
        found.append(
            "the magnetometer carries hard iron of "
            + ", ".join(f"{value * 1e6:.0f}" for value in iron["offset"]) + " uT (x, y, z), which "
            + ("was taken off" if (iron["taken_off"] == iron["offset"]).all() else
               "was found after the start: the heading may be off by what it does to the needle")
            + "; calibrate it (imu_fusion calibrate magnetometer) or set sensor.mag_offset")
    found += _stuck(state) + _biased(state, par)
    if state["wander"]["overall"][wander.TILT] > wander.LOST:
        found.append(
            "field, forces and rates contradict each other by far more than their stated "
            "errors allow: the heading may be any; begin at rest, or calibrate the "
            "magnetometer (imu_fusion calibrate magnetometer)")
    return found


def _stuck(state):
    """Remarks on sensors that repeated one value."""
    found = []
    if state["gyro_repeats"]["stuck"]:
        found.append(
            f"the gyroscope repeated one value for {state['gyro_repeats']['stuck'] * 1e-9:.0f} s "
            "while the force turned: stuck, and not used meanwhile; how the body turned is unknown")
    stuck = int(state["mag_repeats"]["longest"])
    if stuck > _STUCK:
        found.append(
            f"the magnetometer repeated one value for {stuck * 1e-9:.0f} s while the body turned: "
            "stuck, and not used meanwhile; look at its driver, or leave it out")
    return found


def _biased(state, par):
    """A remark on an accelerometer that is off by far more than stated."""
    bias = np.abs(state["acc_bias"])
    sd = np.sqrt(np.maximum(np.diag(state["cov"])[es.ACC_BIAS:es.MAG_LAG], 0.0))
    if (par["lasting_acc_sd"] == 0.0
            and (bias - 3.0 * sd > _BIASED * par["sensor"]["acc_bias_sd"]).any()):
        return ["the accelerometer is off by "
                + ", ".join(f"{value:.2f}" for value in state["acc_bias"]) + " m/s^2 (x, y, z), "
                "far more than stated: what of it is not seen tilts the estimates; calibrate it or "
                "raise sensor.acc_bias_sd"]
    return []
