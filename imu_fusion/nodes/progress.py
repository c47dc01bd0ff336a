"""Progress of a long run: a bar on a terminal, a line now and then elsewhere."""

import sys
import time

import rich.console
import rich.progress


class Progress:
    """Progress towards ``total`` seconds of recorded time, on standard error."""

    def __init__(self, label: str, total: float):
        self._label, self._total = label, max(total, 1e-9)
        self._looked = self._printed = time.monotonic()
        console = rich.console.Console(stderr=True)
        self._bar: rich.progress.Progress | None = None
        if console.is_terminal:
            self._bar = rich.progress.Progress(console=console, transient=True)
            self._task = self._bar.add_task(label, total=self._total)
            self._bar.start()

    def update(self, done: float) -> None:
        """``done`` seconds are behind us; cheap enough for every message."""
        now = time.monotonic()
        if now - self._looked < 0.1:
            return
        self._looked = now
        if self._bar is not None:
            self._bar.update(self._task, completed=done)
        elif now - self._printed > 5.0:
            self._printed = now
            print(f"{self._label}: {done:.1f} of {self._total:.1f} s "
                  f"({100 * done / self._total:.0f} %)", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.stop()
