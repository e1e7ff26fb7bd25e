"""Problem: what a command prints goes to a pipe whose reader has left, a full disk, a closed or an ASCII stream."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO


class Output:
    """A stream that ends the command where nothing can be written to it any more.

    Args:
        stream: What is written to.
    """

    def __init__(self, stream: TextIO):
        self._stream = stream
        self.broken = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """As any stream."""
        return self._tried(self._stream.write, text)

    def flush(self) -> None:
        """As any stream."""
        self._tried(self._stream.flush)

    def _tried(self, act: Callable, *arguments: str) -> Any:
        try:
            return act(*arguments)
        except OSError as error:
            if not self.broken:
                self.broken = True
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())  # for what is still in its buffer
                if not isinstance(error, BrokenPipeError):  # the reader of a pipe, such as head, has seen enough
                    tell(f"gpmpc: cannot write to the standard output: {error.strerror}")
            sys.exit(1)  # no error: nothing on the way may take it for one of a file


@contextmanager
def usable_streams() -> Iterator[None]:
    """Inside, both streams exist and take every letter; where the standard output takes nothing, the command ends."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed; else the next file that is opened would take its place
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        with suppress(AttributeError):  # not of a file
            getattr(sys, name).reconfigure(errors="backslashreplace")
    usual, sys.stdout = sys.stdout, Output(sys.stdout)
    output = sys.stdout
    try:
        yield
    finally:
        with suppress(SystemExit):
            output.flush()
        sys.stdout = usual
        if output.broken:
            sys.exit(1)


def tell(line: str) -> None:
    """Writes a line to the standard error, where that is possible."""
    with suppress(OSError):
        print(line, file=sys.stderr)
