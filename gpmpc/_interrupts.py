"""Delays Ctrl-C until a solve of CasADi has ended.

CasADi does not pass a Ctrl-C during a solve on: IPOPT stops, and its caller goes on with the last iterate, so that a
flight would continue with a failed solve and a measurement with a time that was cut short.
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
