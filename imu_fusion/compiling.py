"""Says why nothing seems to happen at the first start: numba compiles, and keeps the result."""

from contextlib import contextmanager

NOTICE = "compiling for this machine: about a minute, once after an installation"


@contextmanager
def announced_compiling(say):
    """Within, the first kernel that has to be compiled calls ``say`` with one line of text; kernels
    from the cache do not."""
    from numba.core import event    # takes a while, and who only waits for others needs it not

    class Notice(event.Listener):
        said = False

        def on_start(self, event):
            if not self.said:
                self.said = True
                say(NOTICE)

        def on_end(self, event):
            pass

    with event.install_listener("numba:compile", Notice()):
        yield
