"""Says why nothing seems to happen at the first start: numba compiles, and keeps the result."""

from contextlib import contextmanager

from numba.core import event

NOTICE = "compiling for this machine: about a minute, once after an installation"


class _Notice(event.Listener):
    def __init__(self, say):
        self._say = say
        self._said = False

    def on_start(self, event):
        if not self._said:
            self._said = True
            self._say(NOTICE)

    def on_end(self, event):
        pass


@contextmanager
def announced_compiling(say):
    """Within, the first kernel that has to be compiled calls ``say`` with one line of text; kernels
    from the cache do not."""
    with event.install_listener("numba:compile", _Notice(say)):
        yield
