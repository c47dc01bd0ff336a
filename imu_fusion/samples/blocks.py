"""Blocks of samples of several topics, guarded and merged by stamp as arrays.

In a replay and in batch merging is strict: a sample is released once every topic of the session
has passed its stamp or has ended, so what comes out depends on stamps alone, never on arrival or
on how the samples were cut into blocks. Live, all that has come is released at once.

When a clock is set back, a topic that is too slow to show it (a fix a second, a clock set back by
half of one) follows the first of the topics that have one clock: what is later than the end of
that one's epoch belongs to the next. It is given ``JUMP`` to show the jump itself.
"""

from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from imu_fusion.samples.guard import JUMP, Guard, Judged, Verdict

Samples = tuple[np.ndarray, np.ndarray]
"""Stamps (n,) int64 ns, ascending, and values (n, k) of one topic."""


def joined(parts: Sequence[Samples]) -> Samples:
    """Samples of one topic that follow each other."""
    return (np.concatenate([stamp for stamp, _ in parts]),
            np.concatenate([values for _, values in parts]))


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
        widths: how many numbers a sample of each has.
        refused: called with (topic, stamps, list of Verdict) of what its guard has refused.
        one_clock: topics whose sensors share a clock, the one that others follow first; None:
            all of them, and none follows.
    """

    def __init__(self, topics: Mapping[str, int],
                 refused: Callable[[str, np.ndarray, list[Verdict]], object] = lambda *_: None,
                 one_clock: Collection[str] | None = None) -> None:
        self._widths = dict(topics)
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
                       for topic in self._widths}
        self._epoch = 0
        self._open = {topic for topic in self._widths if topic in named}
        self._waiting = {topic: _Waiting(width) for topic, width in self._widths.items()}

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
        self._waiting[topic].append(judged.stamp, judged.epochs, judged.values)

    def _follow(self) -> None:
        """Let topics that did not see the clock set back follow the one that did."""
        if self._leader is None:
            return
        ends = self.guards[self._leader].ends
        for topic, guard in self.guards.items():
            waiting = self._waiting[topic]
            while topic != self._leader and len(waiting.stamp):
                late = np.zeros(len(waiting.stamp), dtype=bool)
                for epoch, end in ends.items():
                    late |= (waiting.epochs == epoch) & (waiting.stamp > end + JUMP)
                if not late.any():
                    break
                waiting.epochs = waiting.epochs.copy()
                waiting.epochs[int(np.argmax(late)):] += 1
                guard.epoch += 1

    @property
    def held(self) -> int:
        """Number of samples that wait for another topic."""
        return sum(len(waiting.stamp) for waiting in self._waiting.values())

    def _release(self) -> list[Segment]:
        self._follow()
        bound = self._bound()
        taken = {topic: waiting.take(bound) for topic, waiting in self._waiting.items()}
        segments = []
        if all((epochs == self._epoch).all() for _, epochs, _ in taken.values()):
            samples = {topic: (stamp, values) for topic, (stamp, _, values) in taken.items()
                       if len(stamp)}
            return [Segment(False, samples)] if samples else []
        for epoch in np.unique(np.concatenate([epochs for _, epochs, _ in taken.values()])):
            samples = {topic: (stamp[epochs == epoch], values[epochs == epoch])
                       for topic, (stamp, epochs, values) in taken.items()
                       if (epochs == epoch).any()}
            segments.append(Segment(bool(epoch > self._epoch), samples))
            self._epoch = max(self._epoch, int(epoch))
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


class _Waiting:
    """Samples of one topic, in order of epoch and stamp."""

    def __init__(self, width: int) -> None:
        self.stamp = np.empty(0, np.int64)
        self.epochs = np.empty(0, np.int64)
        self.values = np.empty((0, width))

    def append(self, stamp: np.ndarray, epochs: np.ndarray, values: np.ndarray) -> None:
        if not len(self.stamp):
            self.stamp, self.epochs, self.values = stamp, epochs, values
        elif len(stamp):
            self.stamp = np.concatenate([self.stamp, stamp])
            self.epochs = np.concatenate([self.epochs, epochs])
            self.values = np.concatenate([self.values, values])

    def take(self, bound: tuple[int, int] | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Remove and return (stamps, epochs, values) up to ``bound``, both parts inclusive."""
        count = len(self.stamp)
        if bound is not None:
            first, last = (int(np.searchsorted(self.epochs, bound[0], side=side))
                           for side in ("left", "right"))
            count = first + int(np.searchsorted(self.stamp[first:last], bound[1], side="right"))
        taken = self.stamp[:count], self.epochs[:count], self.values[:count]
        self.stamp, self.epochs, self.values = (self.stamp[count:], self.epochs[count:],
                                                self.values[count:])
        return taken
