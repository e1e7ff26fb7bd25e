"""Makes runs of tables: applies a mapping, resamples, and leaves out what is no measurement of a moving system.

What is wrong with a file is found, counted and named.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.ndimage import binary_dilation, maximum_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation

from gpmpc._bounds import Room
from gpmpc.exceptions import DataError
from gpmpc.logs._clocks import (
    JUMP,
    ORDER_ROWS,
    ORDER_TOPICS,
    RESOLUTION,
    Stamps,
    count_rows_alone,
    cut_pieces,
    find_jumps,
    intersect_pieces,
    ordered_stamps,
    resample,
)
from gpmpc.logs._conventions import read_rigid_bodies
from gpmpc.logs._dropouts import (
    changes_rarely,
    frozen_rows,
    sentinels,
    zero_dropouts,
)
from gpmpc.logs._file import NUMBER, STAMP, Streams, run_name
from gpmpc.logs._frames import with_frame_of_files
from gpmpc.logs._kinematics import (
    Array,
)
from gpmpc.logs._log import Finding, Log, LogRun
from gpmpc.logs._mapping import TIME_UNITS, LogMapping, Signal
from gpmpc.logs._readers import read_file

SHORTEST_STEP = 1e-5  # [s] of rows that are measured one by one
LONGEST_STEP = 3600.0  # [s] likewise
REST_TIME = 0.5  # [s] for which nothing moves at rest
REST_SHARE = 0.1  # of a state's usual spread that counts as no movement
MOST_HELD = 0.5  # of the rows; beyond, a signal has another rate than its table
MOST_RUNS = 100  # in a file, unless each has
FEWEST_ROWS = 10
COPIES = 2  # of a grid's values, while signals are put on it
_Note = Callable[
    [str, Any, str], None
]  # takes the kind, the count and the text of a finding


class _Table(NamedTuple):
    """The rows of one run on one grid; NaN where a value is missing."""

    name: str
    time: Array
    values: Array  # states, inputs and context (K, n + m + c)
    outside: np.ndarray  # (K,) rows that the mapping leaves out
    breaks: np.ndarray  # (K,) rows before which time ran backwards, or jumped
    note: _Note


def read_log(
    files: str | Path | Sequence[str | Path],
    mapping: LogMapping | Mapping[str, Any] | str | Path,
    partial: bool = False,
) -> Log:
    """Reads the runs of one file or several.

    Args:
        files: Each ends in .csv, .csv.gz, .tsv, .parquet, .npz, .mcap (of this package or of ROS 2) or .ulg.
        mapping: What the columns mean: a YAML file, plain data or a ``LogMapping``.
        partial: Takes what is whole of unfinished or damaged files; findings say what is lost.

    Raises:
        DataError: A file, topic or column is missing or cannot be used; the text says where and why.
        SettingError: The mapping is wrong.
    """
    if not isinstance(mapping, LogMapping):
        mapping = (
            LogMapping.load(mapping)
            if isinstance(mapping, str | Path)
            else LogMapping.from_dict(mapping)
        )
    files = [files] if isinstance(files, str | Path) else list(files)
    mapping = with_frame_of_files(mapping, [Path(file) for file in files])
    findings: list[Finding] = []
    tables: list[_Table] = []
    names: set[str] = set()
    topics = {signal.topic for signal in mapping.signals}
    for path in map(Path, files):
        file = read_file(path, topics, partial, mapping.stamp)
        findings.extend(file.findings)
        room = Room(path)
        for name, streams in _runs(path, file.streams, mapping):
            if name in names:
                raise DataError(
                    f"run {name!r} comes from two files: give the files different names"
                )
            names.add(name)

            def note(kind: str, count: Any, text: str, name: str = name) -> None:
                if count:
                    findings.append(Finding(kind, name, int(count), text))

            where = f"{path}, run {name}" if mapping.run else str(path)
            tables.append(_tabulate(where, name, streams, mapping, note, room))
    if not tables:
        raise DataError("no log file was given")
    steps = np.concatenate([np.diff(table.time) for table in tables])
    if not len(steps):
        reason = "no two rows have different stamps"
        if mapping.rate:
            reason = f"a rate of {mapping.rate:g} Hz leaves a single row"
        raise DataError(f"{files[0]}: {reason}")
    step = 1 / mapping.rate if mapping.rate else float(np.median(steps))
    if not mapping.rate and not SHORTEST_STEP <= step <= LONGEST_STEP:
        text = f"rows are {step:.3g} s apart: is the unit of the time right?"
        findings.append(Finding("time step", tables[0].name, 1, text))
    spread = _spread([mapping.split(table.values)[0] for table in tables])
    usable = [
        run
        for table in tables
        if (run := _make_run(table, step, spread, mapping)) is not None
    ]
    if not usable:
        said = "; ".join(f"{f.run}: {f.text}" for f in findings[-3:])
        raise DataError(
            f"{files[0]}{' and others' * (len(files) > 1)}: no row can be used ({said})"
        )
    inputs = [run.inputs for run in usable]
    if inputs[0].shape[1] and all(np.ptp(u, axis=0).max() == 0 for u in inputs):
        raise DataError(
            "no input changes in any row: the system is at rest, and nothing can be learned of it"
        )
    if mapping.model == "rigid_body":
        usable, remarks = read_rigid_bodies(usable, step, mapping)
        findings += remarks
    return Log(mapping, step, tuple(usable), tuple(findings))


def _runs(
    path: Path, streams: Streams, mapping: LogMapping
) -> Iterator[tuple[str, Streams]]:
    """Yields the runs of a file with their names: one, or those that a column names."""
    if not mapping.run:
        yield run_name(path), streams
        return
    table = streams.get("", pd.DataFrame())
    _check_column(str(path), table, mapping.run)
    count = table[mapping.run].nunique()
    if count > MOST_RUNS and count > len(table) / FEWEST_ROWS:
        raise DataError(
            f"{path}: column {mapping.run!r} names {count} runs in {len(table)} rows; "
            f"a run has {FEWEST_ROWS} at least"
        )
    for run, part in table.groupby(mapping.run, sort=False):
        yield f"{run_name(path)}:{run}", {"": part}


def _tabulate(
    where: str,
    name: str,
    streams: Streams,
    mapping: LogMapping,
    note: _Note,
    room: Room,
) -> _Table:
    """Puts the signals of a run on one grid of times, in the units and conventions of ``gpmpc.logs``."""
    stamps: dict[str, Stamps] = {}
    tables: dict[str, pd.DataFrame] = {}
    labels = {
        signal.topic: f"{where}, {signal.topic}" if signal.topic else where
        for signal in mapping.signals
    }
    for topic, label in labels.items():
        table = _stamped_rows(topic, streams[topic], note)
        hint = ORDER_TOPICS if topic else ORDER_ROWS
        stamps[topic] = ordered_stamps(_time(label, table, mapping), label, hint)
        signals = [signal for signal in mapping.signals if signal.topic == topic]
        ordered = table.iloc[stamps[topic].rows]
        tables[topic] = _without_zero_dropouts(label, ordered, signals, note)
        _note_stamps(topic, stamps[topic], mapping, note)
    columns = sum(len(signal.group.entries) for signal in mapping.signals)
    if mapping.rate is None:
        (found,) = stamps.values()
        grid = found.time
        room.take(_memory(len(grid), columns), f"{len(grid)} rows of {columns} columns")
        breaks = found.after_reversal.copy()
        breaks[find_jumps(found.time, mapping.max_gap) + 1] = True
    else:
        grid, breaks = _grid(where, stamps, mapping, columns, note, room)

    def on_grid(
        topic: str,
        values: Array,
        rule: str,
        max_gap: float | None,
        angles: bool = False,
        delay: float = 0.0,
    ) -> Array:
        if mapping.rate is None and delay == 0:
            return values
        time = stamps[topic].time
        usual = float(np.median(np.diff(time)))
        if mapping.rate is not None:
            usual = max(usual, 1 / mapping.rate)
        return resample(
            time, values, grid + delay, rule, max_gap or 1.5 * usual, angles
        )

    parts = []
    for s in mapping.signals:
        parts.append(
            on_grid(
                s.topic,
                _values(labels[s.topic], tables[s.topic], s, note),
                s.rule,
                mapping.max_gap,
                angles=s.kind == "angle",
                delay=s.delay,
            )
        )
    outside = np.zeros(len(grid), dtype=bool)
    for column, (low, high) in mapping.keep.items():
        for topic, table in tables.items():
            if column in table or topic == "":
                kept = _numbers(labels[topic], table, column)[:, None]
                left_out = np.where((kept >= low) & (kept <= high), 0.0, 1.0)
                outside |= on_grid(topic, left_out, "hold", np.inf)[:, 0] > 0
    return _Table(name, grid, np.concatenate(parts, axis=1), outside, breaks, note)


def _stamped_rows(topic: str, table: pd.DataFrame, note: _Note) -> pd.DataFrame:
    """The rows of a topic whose message carries a stamp; all of other tables."""
    if STAMP not in table:
        return table
    stamped = np.isfinite(table[STAMP].to_numpy(dtype=float))
    count = int((~stamped).sum())
    note("no stamp", count, f"{count} messages of {topic} without a stamp: left out")
    if not stamped.any():
        raise DataError(f"{topic}: no message carries a stamp")
    return table[stamped]


def _note_stamps(topic: str, found: Stamps, mapping: LogMapping, note: _Note) -> None:
    """Notes what was wrong with the stamps of a topic."""
    of_topic = f" of {topic}" if topic else ""
    for kind, count, what in (
        ("repeated stamp", found.repeated, "left out"),
        ("stamp runs backwards", found.backwards, "left out"),
        ("rows out of order", found.disordered, "sorted by their stamps"),
    ):
        note(kind, count, f"{count} rows{of_topic}: {what}")
    jumps = find_jumps(found.time, mapping.max_gap)
    if len(jumps):
        longest = float(np.diff(found.time)[jumps].max())
        text = (
            f"{len(jumps)} jumps of the stamps{of_topic} by up to {longest:.6g} s, the "
            f"first behind row {jumps[0] + 1} of {len(found.time)}: boundaries, the rows"
            " on both sides are used"
        )
        note("jump", len(jumps), text)


def _memory(rows: float, columns: int) -> float:
    """What a run's rows of all signals take while they are worked on [bytes]."""
    return rows * columns * COPIES * NUMBER


class _Grid(NamedTuple):
    """Times (G,) [s] in equal steps, in pieces that all topics have in common."""

    time: Array
    breaks: np.ndarray  # (G,) whether a piece begins


def _grid(
    where: str,
    stamps: Mapping[str, Stamps],
    mapping: LogMapping,
    columns: int,
    note: _Note,
    room: Room,
) -> _Grid:
    """Makes the grid of a run, piece by piece; nothing of it stands over a jump.

    Raises:
        DataError: The topics have no time in common, or the grid would be too large.
    """
    assert mapping.rate is not None
    pieces = {
        topic: cut_pieces(found.time, mapping.max_gap)
        for topic, found in stamps.items()
    }
    common = reduce(intersect_pieces, pieces.values())
    if not len(common):
        hint = ": stamp: log takes the times of the log" if any(stamps) else ""
        raise DataError(
            f"{where}: the topics {', '.join(stamps)} have no time in common{hint}"
        )
    for topic, of_topic in pieces.items():
        count = count_rows_alone(stamps[topic].time, of_topic, common)
        text = f"{count} rows of {topic} have no time in common with others: left out"
        note("no time in common", count, text)
    steps = (common[:, 1] - common[:, 0]) * mapping.rate * (1 + 1e-12)
    resolution = min(RESOLUTION * mapping.rate, 0.1)  # of the stamps, in steps
    lengths = np.floor(steps + resolution) + 1
    rows = float(lengths.sum())
    what = f"{rows:.6g} rows of {columns} columns at a rate of {mapping.rate:g} Hz"
    if (mapping.max_gap or 0.0) > JUMP:
        what += f", with gaps of up to {mapping.max_gap:g} s (max_gap),"
    room.take(_memory(rows, columns), what)
    begins = np.repeat(common[:, 0], lengths.astype(int))
    firsts = np.r_[0, np.cumsum(lengths)[:-1]].astype(int)
    numbers = np.arange(len(begins)) - np.repeat(firsts, lengths.astype(int))
    breaks = np.zeros(len(begins), dtype=bool)
    breaks[firsts[1:]] = True
    return _Grid(begins + numbers / mapping.rate, breaks)


def _time(label: str, table: pd.DataFrame, mapping: LogMapping) -> Array:
    column = mapping.time or (STAMP if STAMP in table else "timestamp")
    if not mapping.time and column not in table and mapping.rate:
        return np.arange(len(table)) / mapping.rate  # rows at a rate that is declared
    unit = TIME_UNITS[mapping.time_unit] if mapping.time else 1.0
    return _numbers(label, table, column) * unit


def _without_zero_dropouts(
    label: str, table: pd.DataFrame, signals: Sequence[Signal], note: _Note
) -> pd.DataFrame:
    """Empties the rows in which all states are zero, because no sensor was read."""
    columns = [
        column
        for signal in signals
        if signal.role == "states"
        for column in signal.columns
    ]
    states = [_numbers(label, table, column) for column in columns]
    if not states:
        return table
    dropouts = zero_dropouts(np.column_stack(states))
    if not dropouts.any():
        return table
    count = dropouts.sum()
    note("all zero", count, f"{count} rows with zeros for all states: left out")
    emptied = table.astype(dict.fromkeys(columns, float))
    emptied.loc[dropouts, columns] = np.nan
    return emptied


def _check_column(label: str, table: pd.DataFrame, column: str) -> None:
    if column not in table:
        known = ", ".join(map(str, table.columns[:12]))
        raise DataError(
            f"{label}: column {column!r} is missing; it has {known}{', ...' * (len(table.columns) > 12)}"
        )


def _numbers(label: str, table: pd.DataFrame, column: str) -> Array:
    _check_column(label, table, column)
    values = table[column]
    numbers = pd.to_numeric(values, errors="coerce").to_numpy(dtype=float)
    wrong = np.isnan(numbers) & ~values.isna().to_numpy()
    if wrong.any():
        row = int(np.argmax(wrong))
        raise DataError(
            f"{label}: row {row + 1}, column {column!r} is {values.iloc[row]!r}; expected a number"
        )
    return numbers


def _values(label: str, table: pd.DataFrame, signal: Signal, note: _Note) -> Array:
    """A signal (K, c) in the units and conventions of ``gpmpc.logs``; NaN where it is missing."""
    columns = []
    for column in signal.columns:
        numbers = _numbers(label, table, column)
        holds_sentinel = sentinels(numbers)
        if holds_sentinel.any():
            listed = ", ".join(f"{n:g}" for n in np.unique(numbers[holds_sentinel])[:3])
            text = f"{holds_sentinel.sum()} rows of {column} hold {listed}"
            note("sentinel", holds_sentinel.sum(), f"{text}, no measurement: left out")
        columns.append(np.where(holds_sentinel, np.nan, numbers))
    values = np.column_stack(columns) * signal.factors
    values[~np.isfinite(values)] = np.nan
    absent = np.isnan(values).any(axis=1)
    note(
        "missing value",
        absent.sum(),
        f"{absent.sum()} rows of {signal.name} without a value: left out",
    )
    if signal.kind == "quaternion":
        return _quaternions(label, values, signal, note)
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    if (
        signal.kind in ("angle", "euler")
        and signal.unit == "rad"
        and largest > 4 * np.pi
    ):
        raise DataError(
            f"{label}: {signal.name} reaches {largest:.4g} rad: are these degrees? (unit: deg)"
        )
    if signal.kind == "euler":
        turned = np.full((len(values), 4), np.nan)
        turned[~absent] = Rotation.from_euler("ZYX", values[~absent, ::-1]).as_quat()
        return turned
    return values


def _quaternions(label: str, values: Array, signal: Signal, note: _Note) -> Array:
    """Unit quaternions (x, y, z, w) whose sign does not flip."""
    if signal.order == "wxyz":
        values = values[:, [1, 2, 3, 0]]
    norms = np.linalg.norm(values, axis=1)
    off = np.abs(norms - 1) > 0.05
    if off.any():
        row = int(np.argmax(off))
        raise DataError(
            f"{label}: {signal.name} in row {row + 1} has norm {norms[row]:.4g}; expected unit quaternions"
        )
    values = values / norms[:, None]
    present = np.flatnonzero(np.isfinite(norms))
    flips = np.einsum("ij,ij->i", values[present[1:]], values[present[:-1]]) < 0
    note("quaternion flips its sign", flips.sum(), f"{flips.sum()} times: turned back")
    values[present[1:]] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
    return values


def _spread(states: Sequence[Array]) -> Array:
    """Usual spread of each state (n,) over all runs: half of the range of 80 % of the rows."""
    present = np.concatenate([rows[np.isfinite(rows).all(axis=1)] for rows in states])
    if not len(present):
        raise DataError("no row has a value of every state")
    low, high = np.quantile(present, [0.1, 0.9], axis=0)
    return (high - low) / 2


def _make_run(
    table: _Table, step: float, spread: Array, mapping: LogMapping
) -> LogRun | None:
    """Leaves out what cannot be used, and marks where a new piece begins; None where nothing is left."""
    states, inputs, _ = mapping.split(table.values)
    usable = np.ones(len(table.time), dtype=bool)
    note = table.note

    def leave_out(rows: Any, kind: str, text: str) -> None:
        count = (rows & usable).sum()
        note(kind, count, f"{count} of {len(rows)} rows {text}: left out")
        usable[rows] = False

    leave_out(table.outside, "outside of keep", "outside the ranges of keep")
    if mapping.rest == "drop":
        leave_out(
            _at_rest(states, inputs, spread, step), "at rest", "where nothing moves"
        )
    leave_out(
        np.isnan(table.values).any(axis=1),
        "missing value",
        "in a gap or without a value",
    )
    for signal, at in zip(mapping.of("states"), mapping.space.columns, strict=True):
        if (
            mapping.held == "use" or len(signal.columns) < 2
        ):  # a single one may repeat by its resolution
            continue
        same = np.r_[False, (states[1:, at] == states[:-1, at]).all(axis=1)] & usable
        if same.sum() >= max(usable.sum() - 1, 1):
            raise DataError(
                f"run {table.name}: {signal.name} never changes: its sensor was silent; "
                "leave it out, or held: use"
            )
        if same.sum() > MOST_HELD * max(usable.sum(), 1):
            raise DataError(
                f"run {table.name}: {signal.name} changes in {(usable & ~same).sum()} of {usable.sum()} rows only: "
                "its own rate is lower; state a lower rate, or held: use"
            )
        leave_out(same, "held value", f"where {signal.name} repeats the row before")
    if mapping.held == "drop":
        _note_held_sensors(table, states, _motion(states, spread, step), mapping)
    rows = np.flatnonzero(usable)
    if len(rows) < 2:
        note("nothing left", len(table.time), "no row can be used: the run is left out")
        return None
    times = np.diff(table.time[rows])
    uneven = (
        times
        > (mapping.max_gap if mapping.max_gap and not mapping.rate else 1.5 * step)
    ) | (times < 0.5 * step)
    is_jump = table.breaks[rows[1:]] & (times > JUMP)  # which has its own finding
    inner = times[uneven & (np.diff(rows) == 1) & ~is_jump]
    if len(inner):
        shortest = inner.min()
        longest = inner.max()
        text = (
            f"gaps, up to {longest:.3g} s"
            if shortest > step
            else f"steps of {shortest:.3g} to {longest:.3g} s"
        )
        note(
            "gap",
            len(inner),
            f"{len(inner)} {text}: boundaries"
            + ("" if shortest > step else " (a rate resamples)"),
        )
    breaks = uneven | (np.diff(rows) > 1) | table.breaks[rows[1:]]
    begins = (0, *(np.flatnonzero(breaks) + 1).tolist())
    states, inputs, context = mapping.split(table.values[rows])
    return LogRun(table.name, table.time[rows], states, inputs, context, begins)


def _note_held_sensors(
    table: _Table, states: Array, motion: np.ndarray, mapping: LogMapping
) -> None:
    """Notes single columns that repeat while others move.

    They stay in: a wheel at rest repeats its speed, too, and then starts with a jump.
    """
    for signal, columns in zip(
        mapping.of("states"), mapping.space.columns, strict=True
    ):
        if signal.turns:
            continue
        for index, name in enumerate(signal.columns, start=columns.start):
            others_move = np.any(np.delete(motion, index, axis=1), axis=1)
            column = states[:, index]
            frozen = frozen_rows(column, others_move)
            if frozen.any():
                table.note(
                    "held sensor",
                    frozen.sum(),
                    f"{frozen.sum()} rows in which {name} stays at its value, and then "
                    "jumps or ends, while others move: was the sensor silent? left in",
                )
            elif changes_rarely(column, others_move):
                changes = int((np.diff(column) != 0).sum())
                table.note(
                    "held sensor",
                    len(column) - 1 - changes,
                    f"{name} changes in {changes} of {len(column)} rows only, while "
                    "others move: is its own rate lower? state a lower rate; left in",
                )


def _motion(states: Array, spread: Array, step: float) -> np.ndarray:
    """Whether each state moves by a tenth of its usual spread around a row (K, n)."""
    size = min(max(round(REST_TIME / step), 3), len(states))
    values = np.nan_to_num(states)
    highest = maximum_filter1d(values, size, axis=0)
    lowest = minimum_filter1d(values, size, axis=0)
    return highest - lowest > REST_SHARE * spread


def _at_rest(states: Array, inputs: Array, spread: Array, step: float) -> np.ndarray:
    """Rows (K,) of stretches in which the inputs stay and no state moves by more than a tenth of its usual spread."""
    size = max(round(REST_TIME / step), 3)
    if len(states) < size or not inputs.shape[1]:
        return np.zeros(len(states), dtype=bool)
    limit = np.concatenate([REST_SHARE * spread, np.zeros(inputs.shape[1])])
    both = np.nan_to_num(np.concatenate([states, inputs], axis=1))
    moved = maximum_filter1d(both, size, axis=0) - minimum_filter1d(both, size, axis=0)
    return binary_dilation((moved <= limit).all(axis=1), np.ones(2 * (size // 2) + 1))
