"""Guards the standard streams, and makes the console and bar of long commands.

The streams may be closed, full, or left by their reader.
"""

import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

# Logs single evaluations, where a bar says how far the work is.
_SEARCH = "gpmpc.gp._search"


class OutputEnded(SystemExit):
    """The standard output takes nothing any more, and the command ends.

    It is no error: nothing on the way may take it for one of a file.
    """


class Output:
    """A stream that ends the command where nothing can be written to it any more."""

    def __init__(self, stream: TextIO):
        self._stream = stream
        self.broken = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        return self._try("write", text)

    def flush(self) -> None:
        self._try("flush")

    def _try(self, act: str, *arguments: str) -> Any:
        try:
            return getattr(self._stream, act)(*arguments)
        except OSError as error:
            if not self.broken:
                self.broken = True
                # For what is still in its buffer.
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                # The reader of a pipe, such as head, may have seen enough.
                if not isinstance(error, BrokenPipeError):
                    print_error(
                        f"cannot write to the standard output: {error.strerror}"
                    )
            raise OutputEnded(1) from None


@contextmanager
def usable_streams() -> Iterator[None]:
    """Makes both streams exist and take every letter.

    Where the standard output takes nothing, the command ends.
    """
    for name in ("stdout", "stderr"):
        # The next file that is opened would take the place of a closed one.
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        with suppress(AttributeError):  # not of a file
            getattr(sys, name).reconfigure(errors="backslashreplace")
    usual = sys.stdout
    output = Output(sys.stdout)
    sys.stdout = output
    try:
        yield
    finally:
        with suppress(SystemExit):
            output.flush()
        sys.stdout = usual
        if output.broken:
            sys.exit(1)


@contextmanager
def redirected_output(to: str) -> Iterator[None]:
    """Sends the standard output to "output", "error" or "nowhere".

    Likewise that of the processes that are started inside.
    """
    if to == "output":
        yield
        return
    sys.stdout.flush()
    before = os.dup(1)
    target = 2 if to == "error" else os.open(os.devnull, os.O_WRONLY)
    os.dup2(target, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(before, 1)


def print_error(line: str) -> None:
    """Writes a line to the standard error, where that is possible."""
    with suppress(OSError):
        print(f"gpmpc: {line}", file=sys.stderr)


def logging_console() -> "Console":
    """Returns a console that the log lines of the package go to as well.

    Each text goes there once, and a search's evaluations do not.
    """
    from rich.console import Console
    from rich.logging import RichHandler

    console = Console()
    shown: set[str] = set()

    def is_new(record: logging.LogRecord) -> bool:
        text = record.getMessage()
        is_repeated = text in shown
        shown.add(text)
        return not is_repeated and record.name != _SEARCH

    handler = RichHandler(
        console=console, show_path=False, show_time=False, show_level=False
    )
    handler.addFilter(is_new)
    log = logging.getLogger("gpmpc")
    log.setLevel(logging.INFO)
    log.handlers = [handler]
    log.propagate = False
    return console


def progress_bar(
    console: "Console", completed: Callable[[], int] | None = None
) -> "Progress":
    """Returns a bar with how much is done, since when, and how long it will take.

    ``completed`` says how much is done, whenever the bar is drawn; by default its task
    is told.
    """
    from rich import progress

    class Bar(progress.Progress):
        def get_renderables(self) -> Iterator[Any]:
            if completed is not None:
                for task in self.task_ids:
                    self.update(task, completed=completed())
            yield from super().get_renderables()

    columns = [
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
    ]
    times = [
        progress.TimeElapsedColumn(),
        progress.TextColumn("left"),
        progress.TimeRemainingColumn(),
    ]
    return Bar(*columns, *times, console=console, refresh_per_second=2)
