"""Which samples are fit for use: one rule for live nodes, replay and batch.

A sample is refused, and counted, if a value is not finite or its stamp is below zero, if it
repeats what has been taken, or if it was *overtaken* on the way: it is older than the last one and
fills a hole of at most ``JUMP`` that the others have left. Every other stamp that does not follow
the last one is a jump, and one sample is no proof of it: the sample is held back until those after
it tell a clock that was set from a stamp that is wild.

- Set *back*, by however little: samples come again for times that have been measured already. The
  same true time has two stamps then, and none of them says how much time has passed: a new
  *epoch* begins, and estimators start anew with it.
- Set *ahead*: a gap, over which estimators predict; beyond ``OTHER_CLOCK`` a new epoch, too. One
  sample or two ahead, and the others behind them again: their stamps are wild. Were they believed,
  all those up to them would be refused.

All of this follows from the sequence of the samples of a topic alone, not from when they come.
"""

import enum
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from imu_fusion.samples.logs import AnyLog

JUMP = 1_000_000_000
"""Nanoseconds. Transport delays reorder samples by less, sensors pause for less."""

AHEAD = 50_000_000
"""Nanoseconds. What is ahead by more waits for the samples after it."""

OTHER_CLOCK = 7 * 86400 * 1_000_000_000
"""Nanoseconds. No recording pauses for so long; a computer that boots without a clock jumps by
more."""

_SLOW = 5          # usual intervals: what is ahead by no more is no jump, of slow sensors
_AGREEING = 3      # samples in a row that make a clock that was set
_HOLE = 1.5        # usual intervals: a longer one has lost a sample
_UNPROVEN = 3600 * 1_000_000_000    # a pause before the very last sample may be as long
_PARTS = 64        # after how many parts the latest samples are put together


class Verdict(enum.Enum):
    """Why a sample was refused; OK if it was not."""

    OK = "ok"
    NOT_FINITE = "not finite (NaN, infinite or absent)"
    NEGATIVE = "stamp below zero"
    DUPLICATE = "repeated stamp"
    BACKWARDS = "stamp older than the one before"
    WILD = "stamp far from those before and after"


class Run(NamedTuple):
    """Samples of one topic and one epoch: stamps (n,) int64 ns, ascending, and values (n, k)."""

    epoch: int
    stamp: np.ndarray
    values: np.ndarray


@dataclass
class Judged:
    """Samples fit for use, in order; and the stamps and Verdicts of what was refused."""

    runs: list[Run] = field(default_factory=list)
    refused_stamps: list[int] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)


class Guard:
    """The rule for one topic.

    Args:
        small_jumps: whether a clock that is set back by less than ``JUMP`` is looked for; without,
            such samples are refused as overtaken.

    ``epoch`` counts what begins anew; ``ends`` maps each epoch that this topic itself has ended
    to its last stamp; ``last`` is the last stamp taken, None at the start of an epoch.
    """

    def __init__(self, small_jumps: bool = True) -> None:
        self.counts: Counter[Verdict] = Counter()
        self.ends: dict[int, int] = {}
        self._small_jumps = small_jumps
        self.begin(0)

    def begin(self, epoch: int) -> None:
        """Start an epoch, whatever was before."""
        self.epoch = epoch
        self.last: int | None = None
        self._interval = 0
        self._latest: list[tuple[np.ndarray, np.ndarray]] = []   # at least one JUMP of samples
        self._held: list[tuple[int, np.ndarray]] = []            # a jump that is not proven

    def join(self, epoch: int) -> None:
        """Go on in an epoch that others have begun, at any stamp."""
        self.counts[Verdict.BACKWARDS] += len(self._held)
        self.begin(epoch)

    def take(self, stamp: np.ndarray, values: np.ndarray) -> Judged:
        """Judge the next n samples: (n,) int64 ns, (n, k) float64."""
        found = Judged()
        n = len(stamp)
        if self._is_usual(stamp, values):
            self._accept(found, stamp, values)
            return found
        fine = np.isfinite(values).all(axis=1) & (stamp >= 0)
        step = stamp[1:] - stamp[:-1]
        breaks = np.flatnonzero(~(fine[1:] & (step > 0) & (step <= AHEAD))) + 1
        i = 0
        while i < n:
            if not self._held and fine[i] and self._follows(int(stamp[i]), AHEAD):
                following = int(breaks.searchsorted(i + 1))
                end = int(breaks[following]) if following < len(breaks) else n
                self._accept(found, stamp[i:end], values[i:end])
                i = end
                continue
            if fine[i]:
                self._judge(found, int(stamp[i]), values[i])
            else:
                self._refuse(found, int(stamp[i]), Verdict.NEGATIVE
                             if np.isfinite(values[i]).all() else Verdict.NOT_FINITE)
            i += 1
        return found

    def finish(self) -> Judged:
        """The end of the topic: what is held back, judged without a sample after it."""
        found = Judged()
        if self._held:
            ahead = self._held[0][0] - (self.last or 0)
            if 0 < ahead <= _UNPROVEN:
                self._believe(found)
            else:
                self._drop(found)
        return found

    def refused(self) -> dict[str, int]:
        """Counts of what was refused, in words."""
        return {verdict.value: count for verdict, count in self.counts.items()
                if verdict is not Verdict.OK and count}

    def _is_usual(self, stamp: np.ndarray, values: np.ndarray) -> bool:
        """Whether nothing is to be judged: each sample is fine and follows the one before."""
        if self._held or not len(stamp) or not self._follows(int(stamp[0]), AHEAD):
            return False
        if stamp[0] < 0 or not np.isfinite(values).all():
            return False
        if len(stamp) == 1:
            return True
        step = stamp[1:] - stamp[:-1]
        return bool(step.min() > 0 and step.max() <= AHEAD)

    def _follows(self, stamp: int, limit: int) -> bool:
        return self.last is None or 0 < stamp - self.last <= limit

    def _judge(self, found: Judged, stamp: int, row: np.ndarray) -> None:
        """Judge one sample that is not simply the next one."""
        limit = max(JUMP, _SLOW * self._interval)
        follows = self._follows(stamp, limit)
        if self._held and stamp == self._held[-1][0]:
            self._refuse(found, stamp, Verdict.DUPLICATE)
            return
        if self._held:
            side = self._side(stamp, follows, limit)
            if side > 0:
                self._held.append((stamp, row))
                if side > 1 or len(self._held) >= _AGREEING:
                    self._believe(found)
                return
            self._drop(found)
        if self._follows(stamp, max(AHEAD, _SLOW * self._interval)):
            self._accept(found, np.array([stamp]), row[None])
        elif stamp == self.last or self._repeats(stamp, row):
            self._refuse(found, stamp, Verdict.DUPLICATE)
        elif self._is_overtaken(stamp):
            self._refuse(found, stamp, Verdict.BACKWARDS)
        else:
            self._held.append((stamp, row))

    def _side(self, stamp: int, follows: bool, limit: int) -> int:
        """Whether a sample agrees with what is held back: 0 no, 1 yes, 2 yes and that proves it."""
        assert self.last is not None
        held = self._held[-1][0]
        if stamp <= held or (held < self.last < stamp and stamp > held + limit):
            return 0
        if held > self.last or not follows:
            return 1
        # Set back by a few intervals, or overtaken: the interval that is more like the others.
        usual = self._usual()
        return 2 if abs(stamp - held - usual) <= abs(stamp - self.last - usual) else 0

    def _believe(self, found: Judged) -> None:
        held, self._held = self._held, []
        assert self.last is not None
        if held[0][0] < self.last or held[0][0] > self.last + OTHER_CLOCK:
            self.ends[self.epoch] = self.last
            self.begin(self.epoch + 1)
        self._accept(found, np.array([stamp for stamp, _ in held]),
                     np.array([row for _, row in held]))

    def _drop(self, found: Judged) -> None:
        held, self._held = self._held, []
        assert self.last is not None
        near = self.last - JUMP <= held[0][0] < self.last
        for stamp, _ in held:
            self._refuse(found, stamp, Verdict.BACKWARDS if near else Verdict.WILD)

    def _accept(self, found: Judged, stamp: np.ndarray, values: np.ndarray) -> None:
        found.runs.append(Run(self.epoch, stamp, values))
        self.counts[Verdict.OK] += len(stamp)
        if len(stamp) > 1:
            self._interval = int(stamp[-1] - stamp[-2])
        elif self.last is not None:
            self._interval = int(stamp[-1]) - self.last
        self.last = int(stamp[-1])
        oldest = self.last - JUMP
        first = 0 if stamp[0] >= oldest else int(stamp.searchsorted(oldest))
        if first or len(self._latest) > _PARTS:
            before = self._together() if not first else []
            self._latest = [part for part in before if len(part[0])]
        self._latest.append((stamp[first:].copy(), values[first:].copy()))

    def _refuse(self, found: Judged, stamp: int, verdict: Verdict) -> None:
        self.counts[verdict] += 1
        found.refused_stamps.append(stamp)
        found.verdicts.append(verdict)

    def _together(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """The samples of the latest JUMP, as one part."""
        assert self.last is not None
        stamp = np.concatenate([s for s, _ in self._latest])
        values = np.concatenate([v for _, v in self._latest])
        first = int(stamp.searchsorted(self.last - JUMP))
        self._latest = [(stamp[first:], values[first:])]
        return self._latest

    def _usual(self) -> float:
        stamp = self._together()[0][0]
        return float(np.median(np.diff(stamp))) if len(stamp) > 2 else float(self._interval)

    def _repeats(self, stamp: int, row: np.ndarray) -> bool:
        """Whether the very same sample has been taken lately. Of a signal that stands still, equal
        values are no sign of it."""
        stamps, values = self._together()[0]
        place = int(stamps.searchsorted(stamp))
        return (place < len(stamps) and stamps[place] == stamp
                and bool((values[place] == row).all() and (values != row).any()))

    def _is_overtaken(self, stamp: int) -> bool:
        """Whether an older sample is one that is missing, rather than of a clock set back."""
        assert self.last is not None
        if not self.last - JUMP <= stamp < self.last:
            return False
        if not self._small_jumps:
            return True
        stamps = self._together()[0][0]
        place = int(stamps.searchsorted(stamp))
        return place > 0 and bool(
            stamps[place] > stamp and stamps[place] - stamps[place - 1] > _HOLE * self._usual())


def guard_log(log: AnyLog, small_jumps: bool = True) -> tuple[AnyLog, np.ndarray, Guard]:
    """The usable samples of a whole log; ``small_jumps`` as of Guard.

    Returns:
        (log of what is fit for use, epochs (n,) int64 of its samples, Guard with the counts)
    """
    guard = Guard(small_jumps)
    places = np.arange(len(log))[:, None].astype(np.float64)
    finite = np.isfinite(log.flat()).all(axis=1)
    judged = guard.take(log.stamp, np.where(finite[:, None], places, np.nan)).runs
    runs = [Run(0, log.stamp[:0], places[:0]), *judged, *guard.finish().runs]
    keep = np.concatenate([run.values[:, 0] for run in runs]).astype(np.int64)
    epochs = np.concatenate([np.full(len(run.stamp), run.epoch) for run in runs])
    return (log, epochs, guard) if len(keep) == len(log) else (log[keep], epochs, guard)


def usable_part(log: AnyLog, name: str) -> tuple[AnyLog, list[str]]:
    """The usable samples of a whole log up to where its clock was set back.

    Returns:
        (log, texts on what was left out, that begin with ``name``)
    """
    kept, epochs, guard = guard_log(log)
    texts = [f"{name}: {count} samples left out: {reason}"
             for reason, count in guard.refused().items()]
    if len(epochs) and epochs[-1] > 0:
        texts.append(f"{name}: the clock was set back; only what comes before is used")
        kept = kept[epochs == 0]
    return kept, texts
