"""Problem: what a long command tells its user while it works looks the same everywhere."""

import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress


SEARCH = "gpmpc.gp._search"  # tells of single evaluations, where a bar says how far the work is


def told_console() -> "Console":
    """A console that the package's own log lines go to as well, each text once, without a search's evaluations."""
    from rich.console import Console
    from rich.logging import RichHandler

    console, told = Console(), set()
    handler = RichHandler(console=console, show_path=False, show_time=False, show_level=False)
    handler.addFilter(lambda record: record.name != SEARCH)
    handler.addFilter(lambda record: not (record.getMessage() in told or told.add(record.getMessage())))
    log = logging.getLogger("gpmpc")
    log.setLevel(logging.INFO)
    log.handlers, log.propagate = [handler], False
    return console


def progress_bar(console: "Console") -> "Progress":
    """What is done, how much of it, for how long, and how long it will still take."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = [TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()]
    return Progress(*columns, TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(), console=console)
