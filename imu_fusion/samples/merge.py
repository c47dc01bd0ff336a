"""Merging topics by stamp: in replay and batch strictly, live without waiting.

Strict merging releases a sample once every topic of the session has passed its
stamp or has ended. The order depends on stamps alone, never on arrival; that is
what makes nodes and batch equal. Samples of one stamp come in the order in which
the topics are listed.
"""

import heapq
from collections.abc import Callable, Container, Iterable, Sequence
from typing import Any

import numpy as np

from imu_fusion.samples.guard import Guard, Verdict

RESTART = "restart"
"""Event between two epochs: the clock was set back."""

Event = tuple[str, int | None, Any]
"""Topic, stamp, item; or RESTART, None, None."""


def merge_order(stamps: Sequence[np.ndarray],
                epochs: Sequence[np.ndarray] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The order in which strict merging releases the samples of several topics.

    Args:
        stamps: list of (n_i,) int64 arrays, one per topic, topics in order of rank.
        epochs: list of (n_i,) int64 arrays, or None.

    Returns:
        (topic index (n,), sample index within its topic (n,))
    """
    topic = np.concatenate([np.full(len(s), i) for i, s in enumerate(stamps)]).astype(np.int64)
    index = np.concatenate([np.arange(len(s)) for s in stamps]).astype(np.int64)
    keys = [topic, np.concatenate(stamps)]
    if epochs is not None:
        keys.append(np.concatenate(epochs))
    order = np.lexsort(keys)
    return topic[order], index[order]


class SampleStream:
    """Samples of several topics as one stream of events, guarded and merged.

    Args:
        topics: names, in order of rank at equal stamps.

    Events are tuples ``(topic, stamp, item)``; ``(RESTART, None, None)`` marks
    that the clock was set back. ``refused`` is called with (topic, stamp,
    Verdict) for every sample that the guard refuses.
    """

    def __init__(self, topics: Iterable[str],
                 refused: Callable[[str, int, Verdict], object] | None = None) -> None:
        self._topics = list(topics)
        self._refused = refused
        self.begin(None)

    def begin(self, session_topics: Container[str] | None) -> None:
        """Start over: strict merging of the topics named, or live (None).

        Topics of ours that are not named count as ended.
        """
        self.strict = session_topics is not None
        named = session_topics or ()
        self.guards = {topic: Guard() for topic in self._topics}
        self._heap: list[Any] = []
        self._count = 0
        self._epoch = 0
        self._passed = {topic: (-1, 0) for topic in self._topics
                        if topic in named}

    def add(self, topic: str, stamp: int, values: np.ndarray, item: Any = None) -> list[Event]:
        """Take one sample; return the list of events that may happen now.

        Args:
            values: float64 array that the guard judges; also the event's item unless
                ``item`` is given.
        """
        guard = self.guards[topic]
        verdict = guard.check(stamp, values)
        if verdict is not Verdict.OK:
            if self._refused is not None:
                self._refused(topic, stamp, verdict)
            return []
        item = values if item is None else item
        if not self.strict:
            if guard.epoch > self._epoch:
                self._restart_all(guard.epoch)
                return [(RESTART, None, None), (topic, stamp, item)]
            return [(topic, stamp, item)]
        key = (guard.epoch, stamp)
        # the running number keeps heapq from comparing items
        heapq.heappush(self._heap, (*key, self._topics.index(topic), self._count, item))
        self._count += 1
        if topic in self._passed:
            self._passed[topic] = key
        return self._release()

    def end(self, topic: str) -> list[Event]:
        """No more samples of ``topic`` will come; return the events that this releases."""
        self._passed.pop(topic, None)
        return self._release()

    @property
    def open_topics(self) -> list[str]:
        """Topics of the session that have not ended."""
        return list(self._passed)

    @property
    def held(self) -> int:
        """Number of samples that wait for another topic."""
        return len(self._heap)

    def _restart_all(self, epoch: int) -> None:
        # Live, the other topics' clocks were set back too, seen yet or not.
        for guard in self.guards.values():
            if guard.epoch < epoch:
                guard.epoch, guard.last = epoch, None
        self._epoch = epoch

    def _release(self) -> list[Event]:
        bound = min(self._passed.values(), default=None)
        events: list[Event] = []
        while self._heap and (bound is None or self._heap[0][:2] <= bound):
            epoch, stamp, rank, _, item = heapq.heappop(self._heap)
            if epoch > self._epoch:
                self._epoch = epoch
                events.append((RESTART, None, None))
            events.append((self._topics[rank], stamp, item))
        return events
