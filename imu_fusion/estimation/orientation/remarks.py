"""What makes estimates doubtful, in words, and what to do about it."""

import numpy as np

from imu_fusion.estimation.orientation import wander


def remarks(state: np.ndarray, realigned: int, blind: bool = False) -> list[str]:
    """Remarks on one hypothesis.

    Args:
        state: its record. realigned: how many rests have refuted bias and attitude.
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
    iron = state["hard_iron"]
    if iron["found"]:
        found.append(
            "the magnetometer carries hard iron of "
            + ", ".join(f"{value * 1e6:.0f}" for value in iron["offset"]) + " uT (x, y, z), which "
            + ("was taken off" if (iron["taken_off"] == iron["offset"]).all() else
               "was found after the start: the heading may be off by what it does to the needle")
            + "; calibrate it (imu_fusion calibrate magnetometer) or set sensor.mag_offset")
    if state["wander"]["overall"][wander.TILT] > wander.LOST:
        found.append(
            "field, forces and rates contradict each other by far more than their stated "
            "errors allow: the heading may be any; begin at rest, or calibrate the "
            "magnetometer (imu_fusion calibrate magnetometer)")
    return found
