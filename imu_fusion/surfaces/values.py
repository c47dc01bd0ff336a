"""Numbers as users write them."""

import contextlib
import math
import numbers
import reprlib
from typing import Any

from imu_fusion.errors import LayoutError


def number(value: Any, name: str, unit: str, low: float = -math.inf, high: float = math.inf
           ) -> float:
    """``value`` as a finite float within ``low`` to ``high`` (inclusive).

    Text that reads as a number is one: to YAML 1.1, ``1e-1`` without a point is text.

    Args:
        value: what a file or a caller gave.
        name: of the key, for the message: ``origin.latitude``.
        unit: for the message.

    Raises:
        LayoutError: no number, not finite, out of bounds.
    """
    result = math.nan
    if isinstance(value, (numbers.Real, str)) and not isinstance(value, bool):
        with contextlib.suppress(ValueError, OverflowError):
            result = float(value)
    if not math.isfinite(result):
        raise LayoutError(f"key '{name}': {reprlib.repr(value)} is not a finite number ({unit})")
    if not low <= result <= high:
        bounds = (f"at least {low:g}" if high == math.inf else
                  f"at most {high:g}" if low == -math.inf else f"{low:g} to {high:g}")
        raise LayoutError(f"key '{name}': {result:g} is out of bounds; allowed: {bounds} {unit}")
    return result
