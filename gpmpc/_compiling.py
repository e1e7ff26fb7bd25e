"""Reports on the terminal that kernels are being compiled, as they are at their first use on a machine."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def report_compilation() -> Iterator[None]:
    """Prints that kernels are being compiled, and in the end how long it took; nothing where all are loaded."""
    from numba.core import event as events

    class Clock(events.TimingListener):
        """Tells when the first compilation starts."""

        began = False

        def on_start(self, event: Any) -> None:
            if not self.began:
                self.began = True
                print(
                    "compiling numerical kernels: once on this machine, about half a minute",
                    flush=True,
                )
            super().on_start(event)

    with events.install_listener("numba:compile", Clock()) as clock:
        try:
            yield
        finally:
            if clock.done:
                print(f"compiled in {clock.duration:.1f} s", flush=True)
