"""What the orientation estimator says about itself beside the orientation.

Flags as a diagnostic_msgs/DiagnosticArray, published when they change: a stamped message that
a person can read on the command line and a report can shade spans from. The gyroscope's
bias as a geometry_msgs/TwistWithCovarianceStamped.
"""

from collections.abc import Sequence

import numpy as np

from imu_fusion.estimation.orientation import rows as st
from imu_fusion.kernels import njit
from imu_fusion.messages.diagnostics import DIAGNOSTICS_TYPE, diagnostics_message, diagnostics_value
from imu_fusion.messages.layouts import TWIST

FLAGS_TYPE = DIAGNOSTICS_TYPE
_NAME = "orientation"

# Flags that last, by the word that stands for them; those that worry last.
WORDS = {st.FLAG_ALIGNING: "aligning", st.FLAG_STILL: "at rest",
         st.FLAG_NO_HEADING: "heading unknown", st.FLAG_MAG_DISTURBED: "magnetic disturbance",
         st.FLAG_MAG_SATURATED: "magnetometer at its limit",
         st.FLAG_SATURATED: "gyroscope at its limit", st.FLAG_GAP: "samples missing",
         st.FLAG_HELD: "a wild sample held"}
_LASTING = sum(WORDS)
_WORRIES = ~(st.FLAG_ALIGNING | st.FLAG_STILL)
_MAG_FLAGS = st.FLAG_MAG_DISTURBED | st.FLAG_MAG_SATURATED
_MAG_SEEN = _MAG_FLAGS | st.FLAG_MAG_USED


@njit
def lasting_flags(flags, before):
    """The flags of rows that are in ``WORDS``; what a magnetometer sample showed lasts until the
    next one.

    Args:
        flags: (n,) of the rows. before: the result for the row before the first.

    Returns:
        (n,) int64
    """
    out = np.empty(len(flags), np.int64)
    for i in range(len(flags)):
        shown = flags[i] if flags[i] & _MAG_SEEN else before
        out[i] = before = (flags[i] | shown & _MAG_FLAGS) & _LASTING
    return out


def flags_message(stamp: int, frame_id: str, flags: int) -> bytes:
    """CDR bytes of a diagnostic_msgs/DiagnosticArray. stamp: int ns; flags: of WORDS."""
    words = [word for flag, word in WORDS.items() if flags & flag]
    return diagnostics_message(
        stamp, frame_id, _NAME, ", ".join(words) or "in motion",
        {word: str(bool(flags & flag)) for flag, word in WORDS.items()},
        bool(flags & _WORRIES), frame_id)


def flags_value(cdr: bytes) -> tuple[int, int]:
    """(stamp int ns, flags) of a message of :func:`flags_message`.

    Raises:
        MessageError: the bytes are no DiagnosticArray.
    """
    stamp, values = diagnostics_value(cdr, _NAME)
    return stamp, sum(flag for flag, word in WORDS.items() if values.get(word) == "True")


def bias_message(row: np.void, frame_id: str) -> bytes:
    """CDR bytes of the geometry_msgs/TwistWithCovarianceStamped with the gyroscope bias of one
    row as its angular part, rad/s in imu axes; the linear part is absent."""
    cov = np.zeros((6, 6))
    cov[0, 0] = -1.0
    cov[3:, 3:] = np.diag(row["gyr_bias_sd"] ** 2)
    return TWIST.encode(row["stamp"], frame_id, [0.0, 0.0, 0.0, *row["gyr_bias"], *cov.ravel()])


def bias_values(messages: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps (n,) int64 ns, biases and standard deviations (n, 3) rad/s of bias messages."""
    stamp, _, values = TWIST.decode_many(messages)
    variance = np.diagonal(values[:, TWIST["covariance"]].reshape(-1, 6, 6), axis1=1, axis2=2)
    return stamp, values[:, TWIST["angular"]], np.sqrt(np.maximum(variance[:, 3:], 0.0))
