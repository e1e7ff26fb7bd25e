"""What a log file holds: tables of numbers, one a stream, and what was noticed."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from gpmpc.exceptions import DataError
from gpmpc.logs._log import Finding
from gpmpc.recording import Flaw

#: column of the times [s] that a message carries or was logged at; no field of a
#: message has this name
STAMP = "(stamp)"
NUMBER = 32  # of a number in a table, and of its copies on the way there [bytes]
TEXT = 64  # of a short text in a table, or of another Python object [bytes]
MOST_COLUMNS = 4096  # of a table; with many more, pandas takes seconds for any

Streams = dict[str, pd.DataFrame]


class LogFile(NamedTuple):
    """The content of a log file."""

    streams: Streams  # a table a topic, or a single one under the empty name
    findings: tuple[Finding, ...] = ()  # what was left out


def run_name(path: Path) -> str:
    """The name of the run that a file holds: the file's, without its ending."""
    return path.name.removesuffix(".gz").rsplit(".", 1)[0]


def check_column_count(path: Path, count: int, what: str = "it") -> None:
    """Raises ``DataError`` where a table is wider than any log."""
    if count > MOST_COLUMNS:
        raise DataError(
            f"{path}: {what} has {count} columns; a log has {MOST_COLUMNS} at most"
        )


def flaw_findings(path: Path, flaws: Sequence[Flaw]) -> list[Finding]:
    """What is wrong with a recording or a bag, as findings."""
    return [Finding(flaw.kind, run_name(path), flaw.count, flaw.text) for flaw in flaws]
