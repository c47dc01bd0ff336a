"""An end to a process that native code would keep for ever.

Fast DDS 2.14 has a deadlock: a participant that is destroyed while it handles the departure of
another one spins, with the lock that this needs (https://github.com/eProsima/Fast-DDS/issues/6513:
the deadline of its wait overflows, which makes the wait fail at once, its mutex still locked).
Nodes that end together, as ours do at the end of a session, meet it one time in some tens to
hundreds. rclpy calls it with the interpreter locked: neither threads nor handlers of signals run.
"""

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_MONOTONIC, _IN_A_THREAD = 1, 2    # CLOCK_MONOTONIC, SIGEV_THREAD


class _Event(ctypes.Structure):
    """struct sigevent of Linux, with its padding."""

    _fields_ = (("value", ctypes.c_longlong), ("signo", ctypes.c_int), ("notify", ctypes.c_int),
                ("function", ctypes.c_void_p), ("rest", ctypes.c_longlong * 8))


class _Times(ctypes.Structure):
    """struct itimerspec."""

    _fields_ = tuple((name, ctypes.c_long) for name in (
        "interval", "interval_ns", "seconds", "nanoseconds"))


@contextmanager
def ends_within(seconds: int, code: int) -> Iterator[None]:
    """Should what stands within take longer, the process ends with that exit code.

    The timer is libc's: it calls ``_exit`` in a thread that Python knows nothing of.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    event = _Event(value=code, notify=_IN_A_THREAD,
                   function=ctypes.cast(libc._exit, ctypes.c_void_p).value)
    timer = ctypes.c_void_p()
    sys.stdout.flush()
    sys.stderr.flush()
    if libc.timer_create(_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)):
        raise OSError(ctypes.get_errno(), "timer_create")
    libc.timer_settime(timer, 0, ctypes.byref(_Times(seconds=seconds)), None)
    try:
        yield
    finally:
        libc.timer_delete(timer)
