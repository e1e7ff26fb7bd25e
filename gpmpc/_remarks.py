"""Hands what the package remarks, such as on few rows, to whoever shows it."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class _Remarks(logging.Handler):
    """Hands warnings on, each text once.

    Args:
        receive: Called with a text in one line.
    """

    def __init__(self, receive: Callable[[str], object]):
        super().__init__(logging.WARNING)
        self._receive = receive
        self._received: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        text = " ".join(record.getMessage().split())
        if text not in self._received:
            self._received.add(text)
            self._receive(text)


@contextmanager
def remarks_to(receive: Callable[[str], object]) -> Iterator[None]:
    """Hands the package's warnings on, each text once, instead of showing them."""
    log = logging.getLogger("gpmpc")
    remarks = _Remarks(receive)
    propagate = log.propagate
    log.addHandler(remarks)
    log.propagate = False
    try:
        yield
    finally:
        log.propagate = propagate
        log.removeHandler(remarks)
