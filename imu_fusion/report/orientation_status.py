"""What the orientation estimator said about itself: shaded spans, gyroscope bias."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from imu_fusion.estimation.orientation import rows as st
from imu_fusion.messages.orientation_status import bias_values, flags_value
from imu_fusion.report import figures as fig
from imu_fusion.report.figures import Band, Line, Panel, Shade, time_figure
from imu_fusion.report.html import Figure, Section
from imu_fusion.samples import seconds

# Name, flags, colour of what is shaded.
_SHADES = (
    ("at rest", st.FLAG_STILL, "#009E73"),
    ("magnetic disturbance", st.FLAG_MAG_DISTURBED, "#E69F00"),
    ("sensor at its limit", st.FLAG_SATURATED | st.FLAG_MAG_SATURATED, "#D55E00"),
    ("samples missing", st.FLAG_GAP, "#1f2933"),
    ("a wild sample held", st.FLAG_HELD, "#56B4E9"),
    ("heading unknown", st.FLAG_NO_HEADING, "#CC79A7"),
)


@dataclass(frozen=True, eq=False)
class Status:
    """Changes of flags, stamps (n,) int64 ns and flags (n,) int, and gyroscope biases: stamps
    (m,), biases and standard deviations (m, 3) rad/s. Both may be empty."""

    flags_stamp: np.ndarray
    flags: np.ndarray
    bias_stamp: np.ndarray
    bias: np.ndarray
    bias_sd: np.ndarray

    @classmethod
    def from_messages(cls, flags: Sequence[bytes], biases: Sequence[bytes]) -> Self:
        """From CDR messages of imu/flags and imu/gyro_bias.

        Raises:
            MessageError: bytes that are no such message.
        """
        pairs = np.array([flags_value(cdr) for cdr in flags], dtype=np.int64).reshape(-1, 2)
        values = bias_values(biases) if biases else (
            np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))
        return cls(pairs[:, 0], pairs[:, 1], *values)


def shades(status: Status, origin: int, end: int, with_rest: bool = True) -> list[Shade]:
    """Spans of the flags.

    Args:
        status: Status.
        origin: int ns, zero of the time axis; end: int ns, up to which the last flags hold.
        with_rest: whether rest is shaded, too.

    Returns:
        list of Shade, of flags that occur.
    """
    if not len(status.flags):
        return []
    edges = seconds(np.append(status.flags_stamp, max(end, status.flags_stamp[-1])), origin)
    result = []
    for name, mask, color in _SHADES[0 if with_rest else 1:]:
        on = (status.flags & mask) != 0
        spans = tuple((float(a), float(b)) for a, b in zip(edges[:-1][on], edges[1:][on]))
        if spans:
            result.append(Shade(name, spans, color, 0.16))
    return result


def bias_section(status: Status, origin: int, shades: Sequence[Shade] = ()) -> Section:
    """Section with the gyroscope bias and its standard deviation."""
    time = seconds(status.bias_stamp, origin)
    bias, sd = np.degrees(status.bias), np.degrees(status.bias_sd)
    panels = [Panel(f"{axis} in °/s", (
        Band("±3σ", time, bias[:, i] - 3 * sd[:, i], bias[:, i] + 3 * sd[:, i]),
        Line("bias", time, bias[:, i], fig.ESTIMATE))) for i, axis in enumerate("xyz")]
    return Section("Gyroscope bias", (
        Figure(time_figure(panels, shades, panel_height=150),
               "What the estimator takes from the angular rates, in the axes of the sensor. The "
               "band shrinks where rest or movement shows the bias."),))
