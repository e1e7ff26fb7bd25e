"""Problem: kernels are compiled at their first use on a machine: up to a minute in which nothing is seen."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def tell_of_compiling() -> Iterator[None]:
    """Prints that kernels are being compiled, and in the end how long it took; nothing where all are loaded."""
    from numba.core import event

    class Clock(event.Listener):
        """Adds up the time of compilations; one inside another counts once."""

        seconds, began, depth = 0.0, 0.0, 0

        def on_start(self, _: Any) -> None:
            if self.depth == 0:
                self.began = time.perf_counter()
                if not self.seconds:
                    print("compiling numerical kernels: once on this machine, up to a minute", flush=True)
            self.depth += 1

        def on_end(self, _: Any) -> None:
            self.depth -= 1
            if self.depth == 0:
                self.seconds += time.perf_counter() - self.began

    with event.install_listener("numba:compile", Clock()) as clock:
        try:
            yield
        finally:
            if clock.seconds:
                print(f"compiled in {clock.seconds:.1f} s", flush=True)
