"""What the estimator says of itself in numbers: counts, the start, the likeliest hypothesis."""

import math
from typing import Any

import numpy as np

from imu_fusion.estimation.orientation import bank
from imu_fusion.estimation.orientation.alignment import Alignment
from imu_fusion.estimation.orientation.state import COUNT_NAMES

UNITS = {
    "initial_tilt_sd_deg": "deg", "initial_heading_sd_deg": "deg", "inclination_deg": "deg",
    "field_norm_ut": "uT", "gravity": "m/s^2", "lasting_acc_sd": "m/s^2", "gyro_delay": "s",
    "mag_delay": "s", **{f"gyr_bias_{axis}": "rad/s" for axis in "xyz"},
    **{f"initial_quat_{component}": "1" for component in "xyzw"},
    **dict.fromkeys(("local_field_sd", "gyro_factor", "local_field_weight", "gyro_factor_weight",
                     "lasting_acc_weight", "wander_tilt", "wander_heading"), "1")}
"""Units of :func:`summary`; what is not named here is a count."""


def summary(state: np.ndarray, par: np.ndarray, method: str, alignment: Alignment | None,
            counted: Any) -> dict[str, Any]:
    """See OrientationEstimator.summary.

    Args:
        state, par: (k,), one element per hypothesis. counted: COUNTS of all stretches.
        alignment: None before there is one.
    """
    counts = dict(method=method, aligned=alignment is not None,
                  **{name: int(value) for name, value in zip(COUNT_NAMES, counted)})
    if alignment is None:
        return counts
    weight = bank.weights(state, par)
    best = bank.likeliest(weight)
    s, own, a = state[best], par[best], alignment
    return counts | dict(
        started_at_rest=a.at_rest, has_heading=bool(s["heading_known"]),
        **{f"initial_quat_{c}": float(v) for c, v in zip("xyzw", a.quat_world_imu)},
        initial_tilt_sd_deg=math.degrees(math.sqrt(a.cov_attitude_world[0, 0])),
        initial_heading_sd_deg=math.degrees(math.sqrt(a.cov_attitude_world[2, 2])),
        **{name: float(own[name]) for name in ("local_field_sd", "gyro_factor", "lasting_acc_sd")},
        # Of all hypotheses that agree with the likeliest one.
        local_field_weight=float(weight[par["local_field_sd"] == own["local_field_sd"]].sum()),
        gyro_factor_weight=float(weight[par["gyro_factor"] == own["gyro_factor"]].sum()),
        lasting_acc_weight=float(weight[par["lasting_acc_sd"] == own["lasting_acc_sd"]].sum()),
        **{f"wander_{axis}": math.sqrt(value)
           for axis, value in zip(("tilt", "heading"), s["wander"]["overall"])},
        inclination_deg=math.degrees(a.inclination), field_norm_ut=a.field_norm * 1e6,
        gravity=a.gravity,
        **{f"gyr_bias_{c}": float(v) for c, v in zip("xyz", s["gyro_bias"])},
        gyro_delay=float(own["gyro_delay"]), mag_delay=float(own["gyro_delay"] + s["mag_lag"]))
