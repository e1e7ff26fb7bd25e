"""Reports on the terminal that kernels are being compiled.

They are at their first use on a machine.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def report_compilation() -> Iterator[None]:
    """Prints that kernels are being compiled, and in the end how long it took.

    It prints nothing where all are loaded from the cache.
    """
    from numba.core import event as events

    class Stopwatch(events.TimingListener):
        """Times the compilation, and says when it starts."""

        started = False

        def on_start(self, event: Any) -> None:
            if not self.started:
                self.started = True
                print(
                    "compiling numerical kernels for up to a minute, once on "
                    "this machine for this kind of controller and model",
                    flush=True,
                )
            super().on_start(event)

    with events.install_listener("numba:compile", Stopwatch()) as stopwatch:
        try:
            yield
        finally:
            if stopwatch.done:
                print(f"compiled in {stopwatch.duration:.1f} s", flush=True)
