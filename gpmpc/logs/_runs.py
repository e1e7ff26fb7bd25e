"""Finds the runs of a log file: by a column that names them, or side by side."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gpmpc.exceptions import DataError
from gpmpc.logs._columns import TablesOfRun, check_column, runs_side_by_side
from gpmpc.logs._file import Tables, run_name
from gpmpc.logs._findings import Finding, RunFindings
from gpmpc.logs._mapping import LogMapping

MOST_RUNS = 100  # of a file, beyond which each needs ``FEWEST_ROWS`` on average
FEWEST_ROWS = 10


def split_into_runs(
    path: Path, tables: Tables, mapping: LogMapping, findings: list[Finding]
) -> Iterator[TablesOfRun]:
    """Yields the runs of a file: one without a name, or those of the mapping.

    Args:
        path: Of the file, for errors and findings.
        tables: Of the file, by topic.
        mapping: May name a column of runs, or columns of each run.
        findings: Take how many rows name no run, and are left out.

    Raises:
        DataError: A column is missing, or the one of the runs names none, or too many.
    """
    if not mapping.run:
        yield from runs_side_by_side(path, tables, mapping)
        return
    if "" not in tables:
        raise DataError(
            f"{path}: has topics, and is one run; run: {mapping.run} needs a file with "
            "a single table"
        )
    table = tables[""]
    check_column(str(path), table, mapping.run)
    names = table[mapping.run].replace(r"^\s*$", np.nan, regex=True)
    nameless = int(names.isna().sum())
    if nameless == len(names):
        raise DataError(f"{path}: column {mapping.run!r} names no run in any row")
    text = f"{nameless} rows left out: their {mapping.run} is empty"
    RunFindings(run_name(path), findings).add("no run", nameless, text)
    names = names.map(str, na_action="ignore")  # the number 1 and the text are one run
    count = names.nunique()
    if count > MOST_RUNS and count > len(table) / FEWEST_ROWS:
        raise DataError(
            f"{path}: column {mapping.run!r} names {count} runs in {len(table)} rows; "
            f"a run has {FEWEST_ROWS} at least"
        )
    for run, rows in table.groupby(names, sort=False):
        yield TablesOfRun(str(run), {"": rows})
