"""What the kernels remember: every number by name, shape, unit and meaning.

One state for both methods, a structured array of one element per hypothesis (bank): a kernel takes
it as ``state``, works on ``s = state[k]``, and a snapshot is one copy. Parts that belong to one
module are records of their own. Rates are rad/s in imu axes, specific forces m/s^2, stamps int64
ns; ``raw`` is as the sensor reports it.
"""

import numpy as np

from imu_fusion.estimation.orientation.error_state import PREDICTION, ROW, N
from imu_fusion.estimation.orientation.hard_iron import HARD_IRON
from imu_fusion.estimation.orientation.mag_repeats import REPEATS
from imu_fusion.samples.flat_tops import FLAT_TOPS

HISTORY_LENGTH = 256  # rotations kept: 0.25 s at 1 kHz, more than the largest delay and latency
MOST_REFUTING = 4     # rests that are remembered
QUEUE_LENGTH = 128    # samples that wait: at 1 kHz more than the largest delay, 0.1 s

ROTATION_HISTORY = np.dtype([
    ("quat", "f8", 4),                   # chain of all rotations so far, from the rates alone
    ("count", "i8"),                     # rotations pushed; the ring holds the last ones
    ("quats", "f8", (HISTORY_LENGTH, 4)),   # ring of ``quat``, at count % HISTORY_LENGTH
    ("stamps", "i8", HISTORY_LENGTH),
], align=True)
"""Rotations by the gyroscope, without corrections, hence without jumps (rotation_history)."""

MAG_QUEUE = np.dtype([
    ("count", "i8"),
    ("stamps", "i8", QUEUE_LENGTH),      # the sample's own, its lag taken off
    ("field", "f8", (QUEUE_LENGTH, 3)),  # T, calibrated
], align=True)
"""Magnetometer samples that wait for the Imu to pass them (mag_queue)."""

SPIKE = np.dtype([
    ("usual_change", "f8"),              # from sample to sample
    ("is_held", "?"),                    # a value waits for the next to resemble it
    ("value", "f8", 3),                  # that value
    ("step", "f8"),                      # s, that it ended
], align=True)
"""Single wild values of a sensor (spike)."""

REST = np.dtype([
    ("mean_rate", "f8", 3),              # low-passed, raw
    ("mean_force", "f8", 3),             # low-passed, raw
    ("since", "i8"),                     # stamp of the last sign of motion
    ("changed", "i8"),                   # stamp of the last change of rate or force
    ("settled", "i8"),                   # stamp from which on neither has, and the mean rate is
                                         # no bias; 0 where it is otherwise
    ("settled_force", "f8", 3),          # mean_force at that stamp
    ("settled_rate", "f8", 3),           # mean_rate, likewise
    ("turn", "f8", 3),                   # rad, that the rates less their bias make since then
    ("refuting", "i8", MOST_REFUTING),   # ``changed`` of rests that refuted a bias; 0: no more
], align=True)
"""The rest detector (rest_detection)."""

MOTION = np.dtype([
    ("velocity", "f8", 3),               # m/s, world axes, high-passed: a leaky integral
    ("ratio", "f8"),                     # its mean square over the stated velocity's variance
], align=True)
"""How much more the body moves than was said (motion_scale)."""

GYRO_REPEATS = np.dtype([
    ("count", "i8"),                     # samples that repeat the present value
    ("longest", "i8"),                   # of them, of a gyroscope that was not stuck
    ("is_stuck", "?"),
    ("since", "i8"),                     # ns, stamp of the first of them
    ("begun", "i8"),                     # ns, stamp at which it was found to be stuck
    ("force", "f8", 3),                  # m/s^2, mean force there
    ("quat", "f8", 4),                   # attitude there, in axes that stand still
    ("stuck", "i8"),                     # ns, longest time that it was
], align=True)
"""The search for a stuck gyroscope (gyro_repeats)."""


WANDER = np.dtype([
    ("velocity", "f8", 2),               # low-passed normalised innovations, horizontal
    ("field", "f8"),                     # of the field, across its horizontal part
    ("since", "f8"),                     # s since the last of the field
    ("time", "f8"),                      # s that were judged so far
    ("recent", "f8", 2),                 # mean squares of both: tilt, heading
    ("overall", "f8", 2),                # the same of the whole recording
], align=True)
"""How far innovations are from white (wander)."""

MAG_SUM = np.dtype([
    ("count", "i8"),
    ("field", "f8", 3),                  # of R m, relative to the norm
    ("lag", "f8", 3),                    # of R (rate x m)
    ("offset", "f8", (3, 3)),            # of R
    ("matrix", "f8", (3, 9)),            # of R[:, i] m_raw[j]
], align=True)
"""Sums over the block's magnetometer samples (measurements.magnetometer)."""

STEP = np.dtype([
    ("dt", "f8"),                        # s since the sample before
    ("gyr", "f8", 3),                    # raw; a held rate's stand-in
    ("acc", "f8", 3),                    # raw
    ("force", "f8", 3),                  # the same; a held force's stand-in
    ("missed", "f8", 3),                 # rad, rotation to make up for after a held rate
    ("missed_force", "f8", 3),           # m/s, likewise
    ("clipped", "i8"),                   # bits of the gyroscope axes at their limit, x first
    ("begun", "i8"),                     # of those that have just reached it
    ("back", "i8"),                      # of those that have just come back
    ("still", "?"),
    ("flags", "i8"),                     # FLAG constants of the row
    ("mag_count", "i8"),                 # magnetometer samples taken in
    ("mag", "f8", 3),                    # T, their mean in present imu axes; nan: none
    ("reliability", "f8"),               # weight (10) of it; nan: none
], align=True)
"""What the newest Imu sample brought: between the parts of one step of the fusion filter."""

COUNT_NAMES = ("imu_used", "imu_rejected", "mag_used", "mag_rejected", "mag_late", "mag_disturbed",
               "mag_saturated", "mag_repeated", "gaps", "saturated", "rates_held", "forces_held",
               "realigned")
COUNTS = np.dtype([(name, "i8") for name in COUNT_NAMES], align=True)
"""What became of the samples: used; refused as impossible, out of order or too many; too late;
disturbed; with an axis at its limit; repeated while the body turned; steps with a gap; Imu
samples at a limit; rates and forces held; rests that refuted bias and attitude."""

EQUATION = np.dtype([
    ("rate", "f8", 3), ("rate_next", "f8", 3),   # rad/s at both ends, each in its own imu axes
    ("dt", "f8"),             # s
    ("field", "f8", 3),       # expected field / B0, in the axes of the step's start
    ("mag", "f8", 3),         # measured field / B0, in the axes of its end
    ("weight", "f8"),         # w of (10), 0 without a sample
    # Weight of each gyroscope axis: 1, or next to nothing. Not 0: a missing axis along the field is
    # in no other row.
    ("keep", "f8", 3),
], align=True)
"""The least-squares problem (9) of one step.

The paper writes (9) in world axes; turned into those of the step's start it
is the same least-squares problem with R_n = I. There a gyroscope axis is a row, which
``keep`` can leave out where the axis is at its limit (appendix B).
"""

PRINTED = np.dtype([
    ("field_world", "f8", 3),            # T
    ("cov", "f8", (9, 9)),               # attitude (world axes), bias, field relative to its norm
    ("was_clipped", "i8"),               # bits of the axes at their limit at the step's start
    # Here and not made in each step: a numba record does not keep its array alive.
    ("equation", EQUATION),
], align=True)
"""Of Winkler's method as printed alone (gyro_mag)."""

STATE = np.dtype([
    ("stamp", "i8"),                     # of the newest Imu sample
    ("started", "?"),                    # whether there was one
    ("align_until", "i8"),               # stamp of the end of the first interval
    ("began_in_motion", "?"),            # that it was no rest
    ("gyr_last", "f8", 3),               # raw, of the newest sample; a held rate's stand-in
    ("force_last", "f8", 3),             # raw, likewise
    ("history", ROTATION_HISTORY),
    ("queue", MAG_QUEUE),
    ("hard_iron", HARD_IRON),            # of a magnetometer that nobody has calibrated
    ("iron_shown", "?"),                 # a window of it ended with the newest Imu sample
    ("mag_limit", FLAT_TOPS),            # the search for the magnetometer's range (mag_rejection)
    ("mag_repeats", REPEATS),            # and for samples that are old ones (mag_repeats)
    ("gyro_limit", FLAT_TOPS),           # and the gyroscope's (gyro_limit)
    ("gyro_repeats", GYRO_REPEATS),
    ("gyro_spike", SPIKE),
    ("acc_spike", SPIKE),
    ("rest", REST),
    ("motion", MOTION),
    ("wander", WANDER),
    ("counts", COUNTS),
    ("waiting_flags", "i8"),             # FLAG constants for the next row
    ("heading_known", "?"),
    # The nominal state; errors of the same in the order of error_state.
    ("quat_world_imu", "f8", 4),         # xyzw, in gyroscope time, world ENU
    ("gyro_bias", "f8", 3),
    ("gyro_scale", "f8", (3, 3)),        # scale and misalignment
    ("velocity", "f8", 3),               # m/s, world axes, about its mean
    ("position", "f8", 3),               # m, world axes, about its mean
    ("field", "f8", 3),                  # world axes, relative to field_norm
    ("local_field", "f8", 3),            # likewise
    ("mag_offset", "f8", 3),             # relative to field_norm
    ("acc_bias", "f8", 3),               # m/s^2
    ("mag_lag", "f8"),                   # s, how much later magnetometer samples are stamped
    ("mag_matrix", "f8", (3, 3)),        # soft iron and misalignment
    ("clipped_rate", "f8", 3),           # what axes at their limit do not show
    ("angular_acc", "f8", 3),            # rad/s^2, of the same axes
    ("cov", "f8", (N, N)),               # of the error state, at the end of the last block
    ("field_norm", "f8"),                # T; 0 before the first sample
    ("gravity", "f8"),                   # m/s^2
    ("log_likelihood", "f8"),            # of the measurements so far but positions, less a constant
    ("position_likelihood", "f8"),       # of positions, likewise
    ("is_anchored", "?"),                # whether the heading is that of the first needle
    ("anchor", "f8", 12),                # rad, of that per hard (3) and soft iron (9)
    ("first_tilt_var", "f8"),            # rad^2, of what the first tilt turned that needle by
    ("field_scatter", "f8"),             # mean square per axis about ``field`` while moving
    ("scattered", "i8"),                 # blocks that it is the mean of
    ("heading_var", "f8"),               # rad^2, of a heading that no filter can improve on
    # The block being collected.
    ("block", PREDICTION),
    ("mag_sum", MAG_SUM),
    ("block_start", "i8"),               # stamp of the last block's end
    ("world_turned", "?"),               # the heading was fixed in this block
    ("clipped", "i8"),                   # bits of the axes at their limit in this block
    ("was_clipped", "i8"),               # the same at the end of the block before
    ("slope", "f8", 3),                  # rad/s^2, the last that each axis showed within its limit
    ("step", STEP),
    ("row", ROW),                        # of the measurement of the first magnetometer sample
    ("printed", PRINTED),
], align=True)
"""The whole state, zeroed at the start."""


def new_state(hypotheses: int = 1) -> np.ndarray:
    """A state before its first sample, (hypotheses,)."""
    return np.zeros(hypotheses, STATE)
