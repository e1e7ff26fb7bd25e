"""Problem: CasADi keeps a Ctrl-C during a solve to itself: IPOPT stops, and whoever asked goes on with its iterate.

A flight would be flown on with a failed solve, a measurement with a time that was cut short. So a solve is not
interrupted: it ends, and then the interrupt is raised.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interrupts_after() -> Iterator[None]:
    """A Ctrl-C inside is raised at the end of the block; the second one at once.

    Raises:
        KeyboardInterrupt: Or what else the process does about the signal.
    """
    usual = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(usual):
        yield  # nothing is raised here, or the signal is ignored
        return
    waiting: list[tuple[int, FrameType | None]] = []

    def listen(number: int, frame: FrameType | None) -> None:
        waiting.append((number, frame))
        if len(waiting) > 1:
            usual(number, frame)

    signal.signal(signal.SIGINT, listen)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)
    if waiting:
        usual(*waiting[0])
