"""Blocks of samples of several topics, guarded and merged by stamp as arrays.

In a replay and in batch merging is strict: a sample is released once every topic of the session
has passed its stamp or has ended, so what comes out depends on stamps alone, never on arrival or
on how the samples were cut into blocks. Live, all that has come is released at once.

When a clock is set back, a topic that is too slow to show it (a fix a second, a clock set back by
half of one) follows the first of the topics that have one clock: what is later than the end of
that one's epoch belongs to the next. It is given ``JUMP`` to show the jump itself.
"""

from array import array
from collections import deque
from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from imu_fusion.samples.guard import JUMP, Guard, Judged, Run, Verdict

Samples = tuple[np.ndarray, np.ndarray]
"""Stamps (n,) int64 ns, ascending, and values (n, k) of one topic."""


def joined(parts: Sequence[Samples]) -> Samples:
    """Samples of one topic that follow each other."""
    if len(parts) == 1:
        return parts[0]
    return (np.concatenate([stamp for stamp, _ in parts]),
            np.concatenate([values for _, values in parts]))


class Growing:
    """Samples of one topic that follow each other, in memory that grows in place.

    Args:
        width: numbers of a sample.
    """

    def __init__(self, width: int) -> None:
        self._width = width
        self._stamp, self._values = array("q"), array("d")

    def __len__(self) -> int:
        return len(self._stamp)

    def add(self, stamp: np.ndarray, values: np.ndarray) -> None:
        """Copy the next n samples: (n,) int64 ns, (n, width) float64."""
        self._stamp.frombytes(stamp.tobytes())
        self._values.frombytes(values.tobytes())

    def take(self) -> Samples:
        """All of them; none are left."""
        stamp, values, self._stamp, self._values = self._stamp, self._values, array("q"), array("d")
        return np.asarray(stamp), np.asarray(values).reshape(-1, self._width)


@dataclass(frozen=True, eq=False)
class Segment:
    """Samples of one epoch that may be used now, each topic in order of its stamps.

    ``restart``: the clock was set back before them. ``samples`` maps topics that have some to
    their Samples; across topics, and at equal stamps, the order is that of the merger's topics.
    """

    restart: bool
    samples: Mapping[str, Samples]


class BlockMerger:
    """Guards blocks of samples and releases them in order.

    Args:
        topics: names, in order of rank at equal stamps.
        refused: called with (topic, stamps, list of Verdict) of what its guard has refused.
        one_clock: topics whose sensors share a clock, the one that others follow first; None:
            all of them, and none follows.
    """

    def __init__(self, topics: Iterable[str],
                 refused: Callable[[str, np.ndarray, list[Verdict]], object] = lambda *_: None,
                 one_clock: Collection[str] | None = None) -> None:
        self._topics = tuple(topics)
        self._refused = refused
        self._one_clock = one_clock
        self._leader = next(iter(one_clock or ()), None)
        self.begin(None)

    def begin(self, session_topics: Container[str] | None) -> None:
        """Start over: strict merging of the topics named, or live (None).

        Topics of ours that are not named count as ended.
        """
        named = session_topics or ()
        self.strict = session_topics is not None
        self.guards = {topic: Guard(self._one_clock is None or topic in self._one_clock)
                       for topic in self._topics}
        self._epoch = 0
        self._open = {topic for topic in self._topics if topic in named}
        self._waiting: dict[str, deque[Run]] = {topic: deque() for topic in self._topics}

    def add(self, blocks: Mapping[str, Samples]) -> list[Segment]:
        """Take samples in order of arrival within each topic; return what may be used now."""
        for topic, (stamp, values) in blocks.items():
            self._wait(topic, self.guards[topic].take(stamp, values))
        return self._release()

    def end(self, topics: Iterable[str]) -> list[Segment]:
        """Nothing more comes on these topics; return what that releases."""
        for topic in topics:
            self._wait(topic, self.guards[topic].finish())
            self._open.discard(topic)
        return self._release()

    def _wait(self, topic: str, judged: Judged) -> None:
        if judged.verdicts:
            self._refused(topic, np.array(judged.refused_stamps), judged.verdicts)
        self._waiting[topic].extend(judged.runs)

    def _follow(self) -> None:
        """Let topics that did not see the clock set back follow the one that did."""
        ends = self.guards[self._leader].ends if self._leader is not None else {}
        for topic, guard in self.guards.items() if ends else ():
            if topic == self._leader:
                continue
            followed: deque[Run] = deque()
            ahead = 0
            for epoch, stamp, values in self._waiting[topic]:
                epoch += ahead
                while epoch in ends and len(stamp) and stamp[-1] > ends[epoch] + JUMP:
                    at = int(stamp.searchsorted(ends[epoch] + JUMP, side="right"))
                    followed.append(Run(epoch, stamp[:at], values[:at]))
                    epoch, stamp, values = epoch + 1, stamp[at:], values[at:]
                    ahead += 1
                followed.append(Run(epoch, stamp, values))
            self._waiting[topic] = deque(run for run in followed if len(run.stamp))
            guard.epoch += ahead

    @property
    def held(self) -> int:
        """Number of samples that wait for another topic."""
        return sum(len(run.stamp) for runs in self._waiting.values() for run in runs)

    def _release(self) -> list[Segment]:
        self._follow()
        bound = self._bound()
        taken = {topic: _up_to(bound, runs) for topic, runs in self._waiting.items() if runs}
        segments = []
        for epoch in sorted({epoch for parts in taken.values() for epoch in parts}):
            segments.append(Segment(epoch > self._epoch, {
                topic: joined(parts[epoch]) for topic, parts in taken.items() if epoch in parts}))
            self._epoch = max(self._epoch, epoch)
        if not self.strict:
            # The other topics' clocks were set back too, seen yet or not.
            for guard in self.guards.values():
                if guard.epoch < self._epoch:
                    guard.join(self._epoch)
        return segments

    def _bound(self) -> tuple[int, int] | None:
        """Epoch and stamp that every open topic has reached; None: there is no open one."""
        passed = [(self.guards[topic].epoch, self.guards[topic].last) for topic in self._open]
        return min(((epoch, -1 << 63 if last is None else last) for epoch, last in passed),
                   default=None)


def _up_to(bound: tuple[int, int] | None, runs: deque[Run]) -> dict[int, list[Samples]]:
    """Remove what lies before epoch and stamp ``bound``, both inclusive (None: all); return it by
    epoch."""
    taken: dict[int, list[Samples]] = {}
    while runs:
        epoch, stamp, values = runs[0]
        count = len(stamp)
        if bound is not None and (epoch, int(stamp[-1])) > bound:
            count = int(stamp.searchsorted(bound[1], side="right")) if epoch == bound[0] else 0
        if count:
            taken.setdefault(epoch, []).append((stamp[:count], values[:count]))
        if count < len(stamp):
            runs[0] = Run(epoch, stamp[count:], values[count:])
            break
        runs.popleft()
    return taken
