"""``gpmpc status``: how far the runs of a sweep are, and why those failed that did."""

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

from gpmpc.cli._commands import Result
from gpmpc.studies._sweep_status import SweepStatus, SweepWatch

if TYPE_CHECKING:
    from rich.console import Group

_INTERVAL = 2.0  # between two looks [s]


def status(arguments: argparse.Namespace) -> Result:
    """Shows the runs until all have ended; where nobody looks on, in one line.

    As JSON, too, it is one look: what asks for data waits for them.
    """
    from rich.console import Console
    from rich.live import Live

    console = Console()
    watch = SweepWatch(arguments.tree, has_jobs=_has_jobs)
    now = watch.look()
    if console.is_terminal and not arguments.as_json:
        with Live(_view(now), console=console, auto_refresh=False) as live:
            while now.left and now.active:
                time.sleep(_INTERVAL)
                now = watch.look()
                live.update(_view(now), refresh=True)
    else:
        console.out(now.line(), highlight=False)
    return Result(_data(now))


def _has_jobs(tree: Path) -> bool:
    """Whether jobs of a sweep's folder are in a cluster's queue."""
    if not (tree / ".slurm").is_dir():
        return False
    from gpmpc.cli._slurm import has_jobs

    return has_jobs(tree)


def _data(status: SweepStatus) -> dict:
    """Returns a status as plain data."""
    counts = {state.name.lower(): count for state, count in status.counts.items()}
    return {
        "runs": status.total,
        **counts,
        "failures": status.failures,
        "rate": status.rate,
        "seconds_left": status.seconds_left,
    }


def _view(status: SweepStatus) -> "Group":
    """Returns a bar over the line, and every reason of a failure below it."""
    from rich.console import Group
    from rich.progress_bar import ProgressBar
    from rich.text import Text

    ended = status.total - status.left
    lines = [Text(status.line(with_reasons=False))]
    for reason, count in status.failures.items():
        lines.append(
            Text(f"{count} failed: {reason}", style="red", overflow="ellipsis")
        )
    return Group(ProgressBar(total=status.total, completed=ended, width=60), *lines)
