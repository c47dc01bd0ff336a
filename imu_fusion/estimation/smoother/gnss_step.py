"""A step of all fixes that the body did not make: another height datum, antenna or base.

The loss takes either side for outliers and the trajectory lies between them, sure of itself. What
a fix lies off the trajectory changes at the step by all of it, whichever side was believed.
"""

from dataclasses import dataclass

import numpy as np

_BESIDE = (10, 40)  # fixes on either side, whose medians are compared
_MEDIAN_SD = 1.2533  # of a median, by that of the mean: sqrt(pi / 2)
_CERTAIN = 7.0      # standard deviations of the difference that are no chance
_LIKELY = 3.0       # the same where fixes are known not to be white


@dataclass(frozen=True)
class GnssStep:
    """Fixes from ``stamp`` (ns) on lie ``offset`` (3,) m east, north, up, give or take ``sd`` (3,),
    of those before."""

    stamp: int
    offset: np.ndarray
    sd: np.ndarray


def find_steps(stamp: np.ndarray, residual: np.ndarray, white: bool) -> list[int]:
    """Stamps of the first fix after what may be the greatest step, the most plausible first.

    Args:
        stamp: (m,) ns. residual: (m, 3), of fixes against a trajectory, in standard deviations.
        white: whether their innovations are.
    """
    found = {}
    for beside in _BESIDE:
        if len(stamp) < 2 * beside:
            break
        windows = np.median(np.lib.stride_tricks.sliding_window_view(residual, beside, axis=0),
                            axis=2)
        size = np.abs(windows[beside:] - windows[:-beside]).max(axis=1)
        size /= _MEDIAN_SD * np.sqrt(2.0 / beside)
        i = int(np.argmax(size))
        if size[i] > (_CERTAIN if white else _LIKELY):
            found[int(stamp[i + beside])] = size[i]
    return sorted(found, key=lambda at: -found[at])
