"""Reports on the terminal that kernels are being compiled, as they are at their first use on a machine."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def report_compilation() -> Iterator[None]:
    """Prints that kernels are being compiled, and in the end how long it took; nothing where all are loaded."""
    from numba.core import event as events

    class Clock(events.Listener):
        """Adds up the time of compilations; one inside another counts once."""

        seconds, began, depth = 0.0, 0.0, 0

        def on_start(self, event: Any) -> None:
            if self.depth == 0:
                self.began = time.perf_counter()
                if not self.seconds:
                    print("compiling numerical kernels: once on this machine, about half a minute", flush=True)
            self.depth += 1

        def on_end(self, event: Any) -> None:
            self.depth -= 1
            if self.depth == 0:
                self.seconds += time.perf_counter() - self.began

    with events.install_listener("numba:compile", Clock()) as clock:
        try:
            yield
        finally:
            if clock.seconds:
                print(f"compiled in {clock.seconds:.1f} s", flush=True)
