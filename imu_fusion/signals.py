"""SIGINT, SIGTERM and SIGHUP alike: what runs ends in order, with the code that shells expect.

kill -9 gives nobody the time to end what they have started: who starts a process of ours makes its
standard input a pipe, and :data:`LEASH` says so to it. The pipe closes with whoever holds its other
end, however that has ended, and what has been started ends as by SIGTERM.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

came: list[int] = []
"""Signals that :func:`interrupt` has raised: destructors and callbacks swallow exceptions, so who
waits in a loop looks here, too. What Python would print of that, :func:`handled` leaves out."""

#: For the environment of a process that is to end with the one that starts it.
LEASH = {"IMU_FUSION_ENDS_WITH_STDIN": "1"}

Handler = Callable[[int, FrameType | None], object]


class Interrupted(BaseException):
    """One of these signals has come. ``code``: with which the process is to end.

    No KeyboardInterrupt: libraries make of that what they think right.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.code = exit_code(number)


def end_with_parent() -> None:
    """To be called by a process as it begins: heed :data:`LEASH`."""
    if os.environ.items() >= LEASH.items():
        end_after(lambda: os.read(0, 1))    # nobody writes to it


def end_after(wait: Callable[[], object]) -> None:
    """End this process as by SIGTERM when ``wait()``, called in a thread, returns."""
    def run() -> None:
        wait()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=run, daemon=True).start()


def exit_code(number: int) -> int:
    """The code of a process that a signal has ended: 130, 143 or 129."""
    return 128 + number


def ending() -> list[signal.Signals]:
    """The signals that end a process. Under nohup SIGHUP is none of them."""
    return [number for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN]


@contextmanager
def handled(handler: Handler) -> Iterator[None]:
    """Within, these signals call ``handler``. For the main thread."""
    before = {number: signal.signal(number, handler) for number in ending()}
    hook = sys.unraisablehook
    sys.unraisablehook = lambda found: (
        None if isinstance(found.exc_value, Interrupted) else hook(found))
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number, other in before.items():
            signal.signal(number, other)


@contextmanager
def held() -> Iterator[None]:
    """Within, signals wait: for what must not be left half done."""
    came: list[int] = []
    with handled(lambda number, _: came.append(number)):
        yield
    if came:
        signal.raise_signal(came[0])


def interrupt(number: int, frame: FrameType | None = None) -> None:
    """The handler that raises :class:`Interrupted` wherever the program is."""
    came.append(number)
    raise Interrupted(number)


@contextmanager
def interruptible() -> Iterator[None]:
    """Within, these signals raise :class:`Interrupted`, and it arrives as that.

    Where one comes into an import, an extension module makes an ImportError of it, or a module
    stays half made and what uses it fails.
    """
    try:
        with handled(interrupt):
            yield
    except Exception as error:
        if came and _is_of_an_import(error):
            raise Interrupted(came[0]) from error
        raise


def _is_of_an_import(error):
    trace = error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        trace = trace.tb_next
    return False
