"""Specific forces at the stamps of a gyroscope that is sampled beside its accelerometer."""

import numpy as np

from imu_fusion.samples.logs import ImuLog

# Forces further apart than this many usual intervals are not connected; the usual one is the
# median of so many before it.
_GAP_FACTOR = 5.0
_INTERVALS = 32
_WAITING = 5_000_000    # samples of one sensor while the other is silent: hours
_NONE = np.iinfo(np.int64).min

Vectors = tuple[np.ndarray, np.ndarray]
"""Stamps (n,) int64 ns and values (n, 3)."""


class Pairing:
    """Interpolates specific force to the stamps of the gyroscope, whose samples are what is
    integrated: without extrapolation and over no gap.

    What comes out depends on the samples alone, not on how they were cut. ``left_out`` counts rates
    outside of the forces or in their gaps, ``repeated`` samples whose stamp did not rise.
    """

    def __init__(self) -> None:
        self.left_out = self.repeated = 0
        self.restart()

    def restart(self) -> None:
        """The clock began anew."""
        self._forces, self._rates = _Queue(), _Queue()

    def add(self, forces: Vectors | None = None, rates: Vectors | None = None) -> ImuLog:
        """Take samples of either or both; return the rates that can be paired now."""
        for queue, more in ((self._forces, forces), (self._rates, rates)):
            if more is not None:
                self.repeated += queue.add(*more)
        return self._pair(ends=False)

    def finish(self) -> ImuLog:
        """No force follows: what waits for one is left out."""
        return self._pair(ends=True)

    def remarks(self) -> list[str]:
        """What to say at the end."""
        return [f"{count} {what} are left out" for count, what in (
            (self.left_out, "rates without a force beside them"),
            (self.repeated, "readings whose time does not rise")) if count]

    def _pair(self, ends: bool) -> ImuLog:
        if not self._rates.parts or not (self._forces.parts or ends):
            return ImuLog(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))
        (at, force), (stamp, rate) = self._forces.joined(), self._rates.joined()
        ready = len(stamp)
        if not ends:
            # At the only force there is, a rate waits for the second one.
            ready = int(np.searchsorted(stamp, at[-1], "right" if len(at) > 1 else "left"))
        now, keep, found = stamp[:ready], np.zeros(ready, bool), np.empty((0, 3))
        if ready and len(at) > 1:
            step = np.diff(at)
            after = np.clip(np.searchsorted(at, now), 1, len(step))
            keep = ((now >= at[0]) & (now <= at[-1])
                    & ~(step[after - 1] > _GAP_FACTOR * _usual(step)[after - 1]))
            since, at_since = now[keep] - at[0], at - at[0]
            found = np.column_stack([np.interp(since, at_since, v) for v in force.T])
            # Kept are the force before the next rate and the intervals before that.
            self._forces.drop(int(np.searchsorted(at, now[-1], "right")) - 2 - _INTERVALS)
        self._rates.drop(ready)
        self.left_out += ready - int(keep.sum())
        return ImuLog(now[keep], rate[:ready][keep], found)


class _Queue:
    """Samples of one sensor with rising stamps, in parts as they came."""

    def __init__(self) -> None:
        self.parts: list[Vectors] = []
        self._last, self._count = _NONE, 0

    def add(self, stamp: np.ndarray, values: np.ndarray) -> int:
        """Take samples; return how many were left out."""
        before = np.maximum.accumulate(np.r_[self._last, stamp])[:-1]
        keep = (stamp > before) & np.isfinite(values).all(axis=1)
        keep[max(_WAITING - self._count, 0):] = False
        if keep.any():
            self.parts.append((stamp[keep], values[keep]))
            self._last = int(self.parts[-1][0][-1])
            self._count += int(keep.sum())
        return len(stamp) - int(keep.sum())

    def joined(self) -> Vectors:
        """All that is here."""
        if not self.parts:
            return np.empty(0, np.int64), np.empty((0, 3))
        if len(self.parts) > 1:
            self.parts = [(np.concatenate([stamp for stamp, _ in self.parts]),
                           np.concatenate([values for _, values in self.parts]))]
        return self.parts[0]

    def drop(self, count: int) -> None:
        """Let go of the first samples."""
        stamp, values = self.joined()
        if count > 0:
            self.parts = [(stamp[count:], values[count:])] if count < len(stamp) else []
            self._count = max(self._count - count, 0)


def _usual(step: np.ndarray) -> np.ndarray:
    """Median of the up to _INTERVALS intervals before each, NaN for the first."""
    before = np.concatenate([np.full(_INTERVALS, np.nan), step.astype(np.float64)])
    usual = np.full(len(step), np.nan)
    if len(step) > 1:
        windows = np.lib.stride_tricks.sliding_window_view(before, _INTERVALS)
        usual[1:] = np.nanmedian(windows[1:-1], axis=1)
    return usual
