"""Which samples are fit for use: one rule for live nodes, replay and batch.

A sample is refused, and counted, if a value is not finite, if its stamp repeats
the last one of its topic, or if its stamp is older than that by at most
``JUMP_BACK`` (it was overtaken on the way). An older stamp than that means that
the clock was set back (a simulation or a replay starts over): a new *epoch*
begins, and estimators start anew with it.
"""

import enum
from collections import Counter
from typing import TypeVar

import numpy as np

from imu_fusion.samples.logs import Log

AnyLog = TypeVar("AnyLog", bound=Log)

JUMP_BACK = 1_000_000_000
"""Nanoseconds. Transport delays reorder samples by less, restarts go back by more."""


class Verdict(enum.Enum):
    """Why a sample was refused; OK if it was not."""

    OK = "ok"
    NOT_FINITE = "not finite (NaN, infinite or absent)"
    DUPLICATE = "repeated stamp"
    BACKWARDS = "stamp older than the one before"


class Guard:
    """The rule for one topic; ``epoch`` counts the clock's jumps back."""

    def __init__(self) -> None:
        self.epoch = 0
        self.last: int | None = None
        self.counts: Counter[Verdict] = Counter()

    def check(self, stamp: int, values: np.ndarray) -> Verdict:
        """Judge the next sample.

        Args:
            stamp: int nanoseconds.
            values: float64 array of any shape.

        Returns:
            Verdict; ``self.epoch`` is that of this sample.
        """
        verdict = Verdict.OK
        if not np.isfinite(values).all():
            verdict = Verdict.NOT_FINITE
        elif self.last is not None and stamp <= self.last:
            if stamp == self.last:
                verdict = Verdict.DUPLICATE
            elif self.last - stamp <= JUMP_BACK:
                verdict = Verdict.BACKWARDS
            else:
                self.epoch += 1
        if verdict is Verdict.OK:
            self.last = stamp
        self.counts[verdict] += 1
        return verdict

    def refused(self) -> dict[str, int]:
        """Counts of what was refused, in words."""
        return {verdict.value: count for verdict, count in self.counts.items()
                if verdict is not Verdict.OK and count}

    def check_block(self, stamp: np.ndarray,
                    values: np.ndarray) -> tuple[list[Verdict] | None, np.ndarray]:
        """Judge the next n samples, as :meth:`check` would one by one.

        Args:
            stamp: (n,) int64 ns.
            values: (n, k) float64.

        Returns:
            The verdicts, None if all are fit for use, and the epoch of each, (n,) int64.
        """
        n = len(stamp)
        if n and (self.last is None or stamp[0] > self.last) and (
                (np.diff(stamp) > 0).all() and np.isfinite(values).all()):
            self.counts[Verdict.OK] += n
            self.last = int(stamp[-1])
            return None, np.full(n, self.epoch, dtype=np.int64)
        verdicts, epochs = [], np.zeros(n, dtype=np.int64)
        for i in range(n):
            verdicts.append(self.check(int(stamp[i]), values[i]))
            epochs[i] = self.epoch
        return verdicts, epochs


def fit_for_use(verdicts: list[Verdict] | None, count: int) -> np.ndarray:
    """(count,) bool of the verdicts of :meth:`Guard.check_block`."""
    if verdicts is None:
        return np.ones(count, dtype=bool)
    return np.array([verdict is Verdict.OK for verdict in verdicts], dtype=bool)


def guard_log(log: AnyLog) -> tuple[AnyLog, np.ndarray, Guard]:
    """The usable samples of a whole log.

    Returns:
        (log of what is fit for use, epochs (n,) int64 of its samples, Guard with the counts)
    """
    guard = Guard()
    verdicts, epochs = guard.check_block(log.stamp, log.flat())
    keep = fit_for_use(verdicts, len(log))
    return (log, epochs, guard) if keep.all() else (log[keep], epochs[keep], guard)
