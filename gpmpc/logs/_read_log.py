"""Reads log files as a ``Log``: files to tables, to runs, to usable rows."""

import hashlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from gpmpc._bounds import MemoryBudget
from gpmpc._calls import explains_arguments
from gpmpc.exceptions import DataError, check_kind
from gpmpc.logs._columns import named_columns
from gpmpc.logs._conventions import read_rigid_bodies
from gpmpc.logs._file import run_name
from gpmpc.logs._findings import Finding, RunFindings
from gpmpc.logs._formats import read_file
from gpmpc.logs._frames import with_axes_of_files
from gpmpc.logs._log import Log, LogRun
from gpmpc.logs._mapping import LogMapping
from gpmpc.logs._run_tables import RunTable, tabulate
from gpmpc.logs._runs import split_into_runs
from gpmpc.logs._time_step import find_time_step
from gpmpc.logs._usable_rows import (
    UNCHANGING,
    is_settled_at_rest,
    least_motion,
    select_rows,
)

MOST_UNLIKE_SPREAD = 30.0  # of two entries of one signal
FEWEST_SHARED = 20  # rows: a few begin alike by chance
LARGEST_ROUNDING = 1e-4  # of an input that is a state in other units


@explains_arguments
def read_log(
    files: str | Path | Sequence[str | Path],
    mapping: LogMapping | Mapping[str, Any] | str | Path,
    partial: bool = False,
) -> Log:
    r"""Reads the runs of one file or several.

    Args:
        files: Of the kinds in docs/log_files.md.
        mapping: What the columns mean: a YAML file, plain data or a ``LogMapping``.
        partial: Takes what is whole of unfinished or damaged files; findings say what
            is lost.

    Raises:
        DataError: A file, topic or column is missing or cannot be used; the text says
            where and why.
        SettingError: The mapping is wrong.

    >>> import pathlib, tempfile
    >>> mapping = {
    ...     "time": {"column": "t", "unit": "s"},
    ...     "states": {"x": {"columns": ["x"]}},
    ...     "inputs": {"u": {"columns": ["u"]}},
    ... }
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder, "drive.csv")
    ...     _ = file.write_text("t,x,u\n0.0,0.0,1.0\n0.1,0.1,1.0\n0.2,0.2,0.5\n")
    ...     log = read_log(file, mapping)
    >>> log.time_step, len(log.runs)
    (0.1, 1)

    See Also:
        ``inspect_log``, which says what a file holds; ``learn``.
    """
    paths = _as_paths(files)
    mapping = with_axes_of_files(_as_mapping(mapping), paths)
    findings: list[Finding] = []
    tables = _read_run_tables(paths, mapping, partial, findings)
    _check_common_rows(paths[0], tables, mapping)
    step = find_time_step(tables, paths[0], mapping, findings)
    rest_ranges = least_motion(
        [mapping.split(table.values).states for table in tables], step
    )
    keep_rest = is_settled_at_rest(tables, step, rest_ranges, mapping)
    runs = []
    for table in tables:
        run_findings = RunFindings(table.name, findings)
        run = select_rows(table, step, rest_ranges, keep_rest, mapping, run_findings)
        if run is not None:
            runs.append(run)
    _check_unchanging(runs, findings)
    _check_content(runs, paths, findings)
    _check_neighbours(paths[0], runs, tables, mapping)
    _note_unlike_entries(runs, mapping, findings)
    _note_copied_states(runs, mapping, findings)
    equal_runs = _note_equal_runs(runs, findings)
    _note_shared_rows(runs, equal_runs, findings)
    _note_opposite_signs(runs, mapping, findings)
    if mapping.model == "rigid_body":
        runs, remarks = read_rigid_bodies(runs, step, mapping)
        findings += remarks
    return Log(
        mapping=mapping, time_step=step, runs=tuple(runs), findings=tuple(findings)
    )


def _as_paths(files: str | Path | Sequence[str | Path]) -> list[Path]:
    if isinstance(files, str | PathLike):
        return [Path(files)]
    check_kind("files", files, Iterable, "the name of a file, or several")
    paths = []
    for file in files:
        check_kind("files", file, (str, PathLike), "names of files")
        paths.append(Path(file))
    return paths


def _as_mapping(mapping: LogMapping | Mapping[str, Any] | str | Path) -> LogMapping:
    if isinstance(mapping, LogMapping):
        return mapping
    if isinstance(mapping, str | Path):
        return LogMapping.load(mapping)
    return LogMapping.from_dict(mapping)


def _read_run_tables(
    paths: Sequence[Path], mapping: LogMapping, partial: bool, findings: list[Finding]
) -> list[RunTable]:
    """Reads all files, and makes one table of each run in them."""
    topics = {signal.topic for signal in mapping.signals}
    tables: dict[str, RunTable] = {}  # by run
    for path, name in zip(paths, _run_names(paths), strict=True):
        file = read_file(path, topics, partial=partial, stamp=mapping.stamp)
        findings_of_file = [*file.findings]
        findings_of_runs: list[Finding] = []
        budget = MemoryBudget(path)  # of the rows; the reader had one of its own
        named = named_columns(path, file.tables, mapping)
        runs = split_into_runs(path, named, mapping, findings_of_file)
        for label, tables_of_run in runs:
            run = f"{name}:{label}" if label else name
            if run in tables:
                raise DataError(
                    f"run {run!r} comes from two files: give the files different names"
                )
            in_file = mapping.run or mapping.runs
            where = f"{path}, run {run}" if in_file else str(path)
            run_findings = RunFindings(run, findings_of_runs)
            tables[run] = tabulate(where, tables_of_run, mapping, run_findings, budget)
        # A reader calls a run by the name of its file alone.
        findings += [replace(finding, run=name) for finding in findings_of_file]
        findings += findings_of_runs
    if not tables:
        raise DataError("no log file was given")
    return list(tables.values())


def _run_names(paths: Sequence[Path]) -> list[str]:
    """Returns the names of files without their endings, which are different ones.

    Files of one name have those of their folders before it, as many as tell them
    apart. In one folder it is their endings that do.

    Raises:
        DataError: A file is given twice.
    """
    files = [path.absolute() for path in paths]
    files_by_name: dict[str, list[Path]] = {}
    for file in files:
        if files.count(file) > 1:
            raise DataError(f"{file} is given twice")
        files_by_name.setdefault(run_name(file), []).append(file)
    names: dict[Path, str] = {}
    for equal in files_by_name.values():
        names |= zip(equal, _different_names(equal), strict=True)
    return [names[file] for file in files]


def _different_names(files: Sequence[Path]) -> list[str]:
    """Returns different names of different files whose own names are equal."""
    own_names = [run_name(file) for file in files]
    full_names = [file.name for file in files]
    folders = [file.parts[-2:0:-1] for file in files]  # the innermost first
    candidates = (
        [
            "/".join((*reversed(parts[:depth]), name))
            for parts, name in zip(folders, names, strict=True)
        ]
        for names in (own_names, full_names)
        for depth in range(1 + max(map(len, folders)))
    )
    return next(names for names in candidates if len(set(names)) == len(files))


def _check_common_rows(
    first_path: Path, tables: Sequence[RunTable], mapping: LogMapping
) -> None:
    """Raises ``DataError`` where no row has a value of every signal.

    So it is where each stream has rows of its own, or one has longer gaps.
    """
    if any((~np.isnan(table.values)).all(axis=1).any() for table in tables):
        return
    _refuse_sparse_signals(
        first_path, "no row has a value of every signal", tables, mapping
    )


def _check_neighbours(
    first_path: Path,
    runs: Sequence[LogRun],
    tables: Sequence[RunTable],
    mapping: LogMapping,
) -> None:
    """Raises ``DataError`` where no row with all values follows another one.

    So it is where a signal of fewer rows is written into the table of a faster one.
    """
    longest = max(end - begin for run in runs for begin, end in run.pieces)
    is_complete = all(not np.isnan(table.values).any() for table in tables)
    if longest > 1 or is_complete:
        return
    _refuse_sparse_signals(
        first_path,
        "no two rows with a value of every signal follow each other",
        tables,
        mapping,
    )


def _refuse_sparse_signals(
    first_path: Path, fault: str, tables: Sequence[RunTable], mapping: LogMapping
) -> None:
    """Raises ``DataError`` with the rows that each signal has, and what to do."""
    has_value = ~np.isnan(np.concatenate([table.values for table in tables]))
    counts: dict[str, int] = {}  # of rows with a value, by signal
    first = 0
    for signal in mapping.signals:
        behind = first + len(signal.group.entries)
        counts[signal.name] = int(has_value[:, first:behind].all(axis=1).sum())
        first = behind
    if mapping.rate:
        remedy = "state a longer max_gap, over which values are carried"
    elif all(counts.values()):
        remedy = "state a rate (rate: 50), which brings the signals to common rows"
    else:
        remedy = "name columns that hold values"
    listed = ", ".join(f"{name} in {count}" for name, count in counts.items())
    raise DataError(
        f"{first_path}: {fault}: of {len(has_value)} rows, {listed}; {remedy}"
    )


def _note_unlike_entries(
    runs: Sequence[LogRun], mapping: LogMapping, findings: list[Finding]
) -> None:
    """Notes signals of the states that hold quantities of unlike size.

    The error of a signal is the length of the errors of its entries, so that the small
    ones do not count.
    """
    if mapping.model != "none":
        return
    states = np.concatenate([run.states for run in runs])
    spreads = states.std(axis=0)
    for signal, columns in zip(
        mapping.of("states"), mapping.space.columns, strict=True
    ):
        spread = spreads[columns]
        moving = spread[spread > 0]
        if signal.is_attitude or len(moving) < 2:
            continue
        if moving.max() <= MOST_UNLIKE_SPREAD * moving.min():
            continue
        small = signal.columns[int(np.where(spread > 0, spread, np.inf).argmin())]
        large = signal.columns[int(spread.argmax())]
        text = (
            f"{signal.name}: {large} varies by {spread.max():.3g}, {small} by "
            f"{moving.min():.3g}, and the errors of a signal count together: {small} "
            "hardly counts; name a signal for each quantity"
        )
        findings.append(Finding("unlike entries", runs[0].name, len(states), text))


def _note_copied_states(
    runs: Sequence[LogRun], mapping: LogMapping, findings: list[Finding]
) -> None:
    """Notes inputs that are a state in other units: a rollout is given what it seeks.

    So is the output of a feedback without noise of one state alone.
    """
    states = np.concatenate([run.states for run in runs])
    inputs = np.concatenate([run.inputs for run in runs])
    moving_states = np.ptp(states, axis=0) > 0.0  # before what the mean rounds
    moving_inputs = np.ptp(inputs, axis=0) > 0.0
    states = states - states.mean(axis=0)
    inputs = inputs - inputs.mean(axis=0)
    state_names = mapping.column_names("states")
    input_names = mapping.column_names("inputs")
    for j in np.flatnonzero(moving_inputs):
        for i in np.flatnonzero(moving_states):
            name = input_names[j]
            state_name = state_names[i]
            column = inputs[:, j]
            state = states[:, i]
            factor = (state @ column) / (state @ state)
            remainder = np.abs(column - factor * state).max()
            if remainder > LARGEST_ROUNDING * np.abs(column).max():
                continue
            text = (
                f"{name} is {state_name} times {factor:.4g}, plus a constant: "
                "predictions that are given the inputs to come are given this state; "
                "is it the right column?"
            )
            findings.append(Finding("copied state", runs[0].name, len(column), text))


def _note_equal_runs(runs: Sequence[LogRun], findings: list[Finding]) -> set[str]:
    """Notes runs with the rows of another: one that is held out is no new one.

    Returns their names.
    """
    equal_runs = set()
    first_of_content: dict[bytes, str] = {}
    for run in runs:
        digest = hashlib.sha256()
        for values in (run.states, run.inputs, run.context):
            digest.update(np.ascontiguousarray(values).tobytes())
        first = first_of_content.setdefault(digest.digest(), run.name)
        if first != run.name:
            text = (
                f"has the rows of run {first}: held out from it, it shows nothing; "
                "leave one of them out"
            )
            findings.append(Finding("equal runs", run.name, len(run), text))
            equal_runs.add(run.name)
    return equal_runs


def _note_shared_rows(
    runs: Sequence[LogRun], equal_runs: Collection[str], findings: list[Finding]
) -> None:
    """Notes runs of which rows are in an earlier one, as in files that overlap.

    Rows are the same where their times and all values are. Runs that equal another have
    a finding of their own.
    """
    keys = np.concatenate([_row_keys(run) for run in runs])
    numbers = np.repeat(np.arange(len(runs)), [len(run) for run in runs])
    _, first_rows, indices = np.unique(keys, return_index=True, return_inverse=True)
    first_runs = numbers[first_rows][indices]
    for number, run in enumerate(runs):
        of_others = first_runs[(numbers == number) & (first_runs < number)]
        if len(of_others) < FEWEST_SHARED or run.name in equal_runs:
            continue
        other = runs[int(np.bincount(of_others).argmax())].name
        text = (
            f"{len(of_others)} of {len(run)} rows are in earlier runs, such as "
            f"{other}: held out from these, they show nothing; leave them out of one"
        )
        findings.append(Finding("shared rows", run.name, len(of_others), text))


def _row_keys(run: LogRun) -> np.ndarray:
    """Returns numbers (K,) that are equal where the times and values of rows are."""
    values = np.column_stack([run.time, run.states, run.inputs, run.context])
    return pd.util.hash_pandas_object(pd.DataFrame(values), index=False).to_numpy()


def _note_opposite_signs(
    runs: Sequence[LogRun], mapping: LogMapping, findings: list[Finding]
) -> None:
    """Notes quaternions of both signs, where models take them as four numbers.

    Signs are steady within a run. So a body that goes on turning has opposite numbers
    for one attitude. The features of a rigid body do not depend on the sign.
    """
    if mapping.model == "rigid_body":
        return
    for signal, columns in zip(
        mapping.of("states"), mapping.space.columns, strict=True
    ):
        if not signal.is_attitude:
            continue
        scalars = np.concatenate([run.states[:, columns.stop - 1] for run in runs])
        count = int((scalars < 0).sum())
        if not count:
            continue
        text = (
            f"{signal.name} turns by more than half a turn: {count} of {len(scalars)} "
            "rows have a negative scalar, and q and -q, which are one attitude, are "
            "different numbers to a model other than model: rigid_body"
        )
        findings.append(Finding("opposite quaternions", runs[0].name, count, text))


def _check_unchanging(runs: Sequence[LogRun], findings: Sequence[Finding]) -> None:
    """Raises ``DataError`` where runs left out for a signal have most of the rows.

    A short one, as of a system that was switched on and did nothing, refuses no log.
    """
    left_out = [finding for finding in findings if finding.kind == UNCHANGING]
    rows_left_out = sum(finding.count for finding in left_out)
    if left_out and rows_left_out >= sum(map(len, runs)):
        first = left_out[0]
        raise DataError(f"few rows can be used: run {first.run} {first.text}")


def _check_content(
    runs: Sequence[LogRun], paths: Sequence[Path], findings: list[Finding]
) -> None:
    """Raises ``DataError`` where nothing can be learned from the usable rows.

    Inputs may stay within a run, as in step tests. Where they never change, a finding
    says so: the states of a free decay move all the same.
    """
    if not runs:
        others = " and others" if len(paths) > 1 else ""
        reasons = "; ".join(f"{f.run}: {f.text}" for f in findings[-3:])
        raise DataError(f"{paths[0]}{others}: no row can be used ({reasons})")
    inputs = np.concatenate([run.inputs for run in runs])
    if not inputs.shape[1] or np.ptp(inputs, axis=0).max() > 0:
        return
    if not any(np.ptp(run.states, axis=0).max() > 0 for run in runs):
        raise DataError(
            "no input changes in any row, nor does a state: the system is at rest, and "
            "nothing can be learned of it"
        )
    text = "no input changes in any row: what inputs do cannot be learned"
    findings.append(Finding("constant inputs", runs[0].name, len(inputs), text))
