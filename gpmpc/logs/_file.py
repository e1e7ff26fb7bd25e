"""Defines readers of log formats: options in, tables of numbers out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import pandas as pd

from gpmpc.exceptions import DataError
from gpmpc.logs._findings import Finding
from gpmpc.recording import Flaw

#: column of the times [s] that a message carries or was logged at; no field of a
#: message has this name
STAMP = "(stamp)"
#: end of the columns of numbers that tell lists of names from each other, such as
#: "position(names)" of the joints whose positions a message lists; there are some only
#: where names are not the same in all messages
LIST_NAMES = "(names)"
NUMBER_BYTES = 32  # of a number in a table, and of its copies on the way there
TEXT_BYTES = 64  # of a short text in a table, or of another Python object
MOST_COLUMNS = 4096  # of a table; with many more, pandas takes seconds for any

FEWEST_IN_BLOCK = 5  # rows on average: blank lines part blocks of as many
_BLOCKS_KEY = "blocks"  # in the ``attrs`` of a table
_DOUBTS_KEY = "doubts"

Tables = dict[str, pd.DataFrame]  # by topic; "" where a file has a single table


def are_names(path: str) -> bool:
    """Tells whether a list of texts is called as names are, such as ``joint_names``."""
    return "name" in path.rpartition(".")[2].lower()


def names_of_list(path: str) -> str:
    """Returns the column that tells apart the names of a list's entries.

    ``path`` is that of the list or of an entry: ``position`` or ``position[0]``.
    """
    return path.partition("[")[0] + LIST_NAMES


@dataclass(frozen=True)
class ReadOptions:
    """Says which part of a file is read, and whether damage is an error."""

    topics: tuple[str, ...] = ()  # that are read; none for all
    partial: bool = False  # take what is whole of an unfinished or damaged file
    stamp: str = ""  # times of a bag's messages: "header", "log", or "" (see ``_bag``)


def blocks_of(rows_behind_blank: Sequence[int], rows: int) -> tuple[int, ...]:
    """Returns the rows with which blocks of rows begin behind blank lines.

    None where blank lines stand between most rows, as a program's ends of lines.
    """
    begins = tuple(sorted(set(rows_behind_blank)))
    return begins if FEWEST_IN_BLOCK * len(begins) <= rows else ()


def with_blocks(table: pd.DataFrame, begins: tuple[int, ...]) -> pd.DataFrame:
    """Returns a table that knows with which of its rows blocks begin.

    Rows are numbered by the table's index, as in the file.
    """
    table = table.copy(deep=False)
    table.attrs = {**table.attrs, _BLOCKS_KEY: begins}
    return table


def begins_block(table: pd.DataFrame) -> np.ndarray:
    """Tells which rows (K,) of a run begin a block of their file."""
    begins = table.attrs.get(_BLOCKS_KEY, ())
    blocks = np.searchsorted(begins, table.index.to_numpy(), side="right")
    return np.diff(blocks, prepend=blocks[:1]) > 0


def with_doubts(table: pd.DataFrame, doubts: Mapping[str, str]) -> pd.DataFrame:
    """Returns a table that knows why columns, by their names, are not to be read."""
    table = table.copy(deep=False)
    table.attrs = {**table.attrs, _DOUBTS_KEY: dict(doubts)}
    return table


def doubts_of(table: pd.DataFrame) -> dict[str, str]:
    """Returns why columns of a table, by their names, are not to be read."""
    return dict(table.attrs.get(_DOUBTS_KEY, {}))


class LogFile(NamedTuple):
    """The content of a log file, as it was written: nothing is interpreted yet."""

    tables: Tables
    findings: tuple[Finding, ...] = ()  # what was left out


class LogReader(Protocol):
    """Reads files of one format.

    The time of a row is in seconds: in the column ``STAMP`` of a message, or else in
    the column "timestamp"; another column is the mapping's to name, with its unit.
    What the file itself says of units goes with the table (``_units.with_units``).

    A reader counts what it will allocate (``gpmpc._bounds.MemoryBudget``) before it
    does, and may raise whatever its library raises: ``read_file`` makes a ``DataError``
    of it.
    """

    def __call__(self, path: Path, options: ReadOptions) -> LogFile:
        """Reads the tables of a file; those of ``options.topics`` if there are any."""
        ...


def run_name(path: Path) -> str:
    """Returns the name of the run that a file holds: the file's, without its ending.

    A folder keeps its whole name.
    """
    if path.is_dir():
        return path.name
    return path.name.removesuffix(".gz").rsplit(".", 1)[0]


def check_column_count(path: Path, count: int, what: str = "it") -> None:
    """Raises ``DataError`` where a table is wider than any log."""
    if count > MOST_COLUMNS:
        raise DataError(
            f"{path}: {what} has {count} columns; a log has {MOST_COLUMNS} at most"
        )


def first_line(error: Exception) -> str:
    """Returns the text of an error on one line, or its class where it has no text."""
    return " ".join(str(error).split()) or type(error).__name__


def needs_extra(error: ImportError) -> str:
    """Says which extra of the package brings the library that is missing."""
    return f"needs pip install 'gpmpc[logs]' ({error})"


def flaw_findings(path: Path, flaws: Sequence[Flaw]) -> list[Finding]:
    """Returns what is wrong with a recording or a bag, as findings."""
    return [Finding(flaw.kind, run_name(path), flaw.count, flaw.text) for flaw in flaws]


def unread_columns(path: Path, names: Sequence[str]) -> tuple[Finding, ...]:
    """Returns the finding of columns that hold no numbers; none where all do."""
    if not names:
        return ()
    text = f"{', '.join(names[:5])}: no columns of numbers, left out"
    return (Finding("not read", run_name(path), len(names), text),)
