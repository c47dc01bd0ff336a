"""A device that may come and go: its transport kept open in a thread of its own."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from imu_fusion.errors import DeviceError
from imu_fusion.sources.transports.live import Transport

_WAIT = 0.1              # s, how soon a thread notices that it is to stop
_WAITING = 1 << 25       # bytes that wait to be taken; the device waits then
_FIRST_PAUSE = 0.2       # s before the second attempt; doubled up to the longest


class Chunk(NamedTuple):
    """Bytes of one ``part``, and when they came, int ns since 1970; ``begins``: they are the first
    after a connection was made."""

    arrival: int
    part: str
    data: bytes
    begins: bool = False


class Connection:
    """Opens a transport again and again.

    Args:
        transport: see there.
        wake: called from the thread when there is something to take or to say.
        silence: s without bytes after which a connection is taken for dead; None: never.
        longest_pause: s between two attempts at most.
        retries: whether a lost device is waited for.

    ``problem`` says what is wrong now, empty if nothing is: one that a device has which can be
    opened stands until bytes come. ``connections``: how often it was opened; ``ended``: there will
    be no more.
    """

    def __init__(self, transport: Transport, wake: Callable[[], object], silence: float | None,
                 longest_pause: float, retries: bool) -> None:
        self.problem, self.connections, self.ended = "", 0, False
        self._transport, self._wake = transport, wake
        self._silence = None if transport.is_open_ended else silence
        self._longest_pause, self._retries = longest_pause, retries
        self._failures = 0    # since bytes came
        self._opens_in_vain = False
        self._chunks: deque[Chunk] = deque()
        self._size = 0
        self._lock = threading.Condition()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="device", daemon=True)

    def start(self) -> None:
        """Begin to connect."""
        self._thread.start()

    def take(self) -> list[Chunk]:
        """All that has come."""
        with self._lock:
            chunks = list(self._chunks)
            self._chunks.clear()
            self._size = 0
            self._lock.notify()
        return chunks

    def stop(self) -> None:
        """Let go of the device."""
        self._stopping.set()
        with self._lock:
            self._lock.notify()
        if self._thread.is_alive():
            self._thread.join(2.0)    # a name server may keep it longer
        self._wake = lambda: None     # whom it would wake may be gone then

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self._transport.open()
                self.connections += 1
                if not self._opens_in_vain:
                    self._say("")
                self._opens_in_vain = True
                self._listen()
            except DeviceError as error:
                self._say(str(error))
            finally:
                self._transport.close()
            if not self._retries:
                break
            self._stopping.wait(min(_FIRST_PAUSE * 2.0 ** min(self._failures, 20),
                                    self._longest_pause))
            self._failures += 1
        self.ended = True
        self._wake()

    def _listen(self) -> None:
        begins, heard = True, time.monotonic()
        while not self._stopping.is_set():
            parts = self._transport.read(_WAIT)
            arrival = time.time_ns()
            if parts:
                heard, self._failures, self._opens_in_vain = time.monotonic(), 0, False
                self._say("")
            elif self._silence is not None and time.monotonic() - heard > self._silence:
                raise DeviceError(f"{self._transport.address}: silent for {self._silence:g} s")
            for part, data in parts:
                self._put(Chunk(arrival, part, data, begins))
                begins = False

    def _put(self, chunk: Chunk) -> None:
        with self._lock:
            while self._size > _WAITING and not self._stopping.is_set():
                self._lock.wait(_WAIT)
            self._chunks.append(chunk)
            self._size += len(chunk.data)
        self._wake()

    def _say(self, problem: str) -> None:
        if problem != self.problem:
            self.problem = problem
            self._wake()
