"""Delays Ctrl-C until a solve of CasADi, or the writing of a chunk, has ended.

CasADi does not pass a Ctrl-C during a solve on: IPOPT stops, and its caller goes on
with the last iterate, so that a flight would continue with a failed solve and a
measurement with a time that was cut short.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def interrupts_after() -> Iterator[None]:
    """Raises a Ctrl-C inside at the end of the block, and the second one at once.

    Raises:
        KeyboardInterrupt: Or what else the process does about the signal.
    """
    usual = signal.getsignal(signal.SIGINT)
    received: list[tuple[Any, ...]] = []
    if threading.current_thread() is not threading.main_thread() or not callable(usual):
        yield  # nothing is raised here, or the signal is ignored
        return

    def listen(*signal_and_frame: Any) -> None:
        received.append(signal_and_frame)
        signal.signal(signal.SIGINT, usual)

    signal.signal(signal.SIGINT, listen)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)
    if received:
        usual(*received[0])
