"""A device's clock brought to that of this computer, from when its samples came.

A sample comes some delay after it was measured, never before. Of all lines that lie below every
(device time, arrival) the one that is nearest says how the clocks differ and drift, up to the least
delay there is (D. Moon, P. Skelly, D. Towsley, "Estimation and Removal of Clock Skew from Network
Delay Measurements", INFOCOM 1999). Stamps follow it slowly, so that intervals stay what the device
measured, and never run backwards.
"""

import numpy as np

_WINDOW = 1_000_000_000       # ns of device time, of which the least delay is kept
_WINDOWS = 120
_LEVER = 20_000_000_000       # ns, over which delays tell a drift
_DRIFT = 1e-3                 # of clocks; more is none
_FASTEST = 2e-3               # by which stamps may be shifted to follow: 2 ms in a second
_SETTLING = 500_000_000       # ns, after which the least delay is known well enough to begin
_STEP = 500_000_000           # ns, by which a clock was set back
_AHEAD = 100_000_000          # ns; a sample does not come before it was measured


class DeviceClock:
    """Maps device times to arrival times; both int ns.

    Call :meth:`observe` with each lot of samples, then :meth:`map` for their stamps; before it
    :meth:`restart` where :meth:`has_stepped` says so.

    ``offset`` is what is added now, None before the first sample; ``drift`` how it changes per
    second; ``steps`` counts clocks that were set.
    """

    def __init__(self) -> None:
        self.steps = 0
        self.restart()

    def restart(self) -> None:
        """The clock was set: it counts anew."""
        self.offset: int | None = None
        self.drift = 0.0
        self._least: list[tuple[int, int]] = []    # (device time, arrival - device) of a window
        self._anchor = 0, 0    # one of them, through which the line goes
        self._began = self._arrival = 0
        self._before, self._start, self._latest = 0, 0, 0

    @property
    def is_settled(self) -> bool:
        """Whether samples have come for long enough to map them."""
        return self._arrival - self._began >= _SETTLING

    def has_stepped(self, latest: int, arrival: int) -> bool:
        """Whether the clock must have been set before samples of which the last, ``latest``, came
        at ``arrival``."""
        if self.offset is None:
            return False
        ahead = latest + self.offset - arrival
        stepped = latest < self._latest - _STEP or (self.is_settled and ahead > _AHEAD)
        self.steps += stepped
        return stepped

    def observe(self, latest: int, arrival: int) -> None:
        """Samples have come, of which the last was measured at ``latest``."""
        if not self._least:
            self._began = arrival
        self._arrival = max(arrival, self._arrival)
        self._keep(latest, arrival - latest)
        if self.offset is None or not self.is_settled:
            self.offset = self._before = self._line(latest)
            self._start = self._latest = latest
        else:
            advance = max(latest - self._latest, 0)
            self._before, self._start = self.offset, self._latest
            room = round(_FASTEST * advance)
            self.offset += min(max(self._line(latest) - self.offset, -room), room)
            self._latest += advance

    def map(self, device: np.ndarray) -> np.ndarray:
        """Stamps (n,) int64 of device times (n,), rising with them."""
        assert self.offset is not None
        if self._latest <= self._start:
            return device + self.offset
        # From the lot before to this one the offset goes over evenly.
        share = np.clip((device - self._start) / (self._latest - self._start), 0.0, 1.0)
        return device + self._before + np.round(
            share * (self.offset - self._before)).astype(np.int64)

    def _keep(self, device: int, delay: int) -> None:
        """The least delay of each window; the line below them, where that has changed."""
        if not self._least or device // _WINDOW != self._least[-1][0] // _WINDOW:
            self._least.append((device, delay))
            del self._least[:-_WINDOWS]
        elif delay < self._least[-1][1]:
            self._least[-1] = device, delay
        else:
            return
        self._fit()

    def _line(self, at: int) -> int:
        device, delay = self._anchor
        return delay + round(self.drift * (at - device))

    def _fit(self) -> None:
        """The line below all least delays that is nearest to them on the average."""
        first, least = self._least[0]
        x = np.array([device - first for device, _ in self._least], dtype=np.float64)
        y = np.array([delay - least for _, delay in self._least], dtype=np.float64)
        self.drift = 0.0
        touching = int(np.argmin(y))
        if x[-1] > _LEVER:
            hull = _lower_hull(x, y)
            k = int(np.clip(np.searchsorted(x[hull], x.mean()), 1, len(hull) - 1))
            slope = float((y[hull[k]] - y[hull[k - 1]]) / (x[hull[k]] - x[hull[k - 1]]))
            if abs(slope) < _DRIFT:
                self.drift, touching = slope, hull[k]
        self._anchor = self._least[touching]


def _lower_hull(x: np.ndarray, y: np.ndarray) -> list[int]:
    """Indices of the lower convex hull of points with rising x (Andrew's monotone chain)."""
    hull: list[int] = []
    for k in range(len(x)):
        while len(hull) > 1:
            i, j = hull[-2], hull[-1]
            if (y[j] - y[i]) * (x[k] - x[i]) < (y[k] - y[i]) * (x[j] - x[i]):
                break
            hull.pop()
        hull.append(k)
    return hull
