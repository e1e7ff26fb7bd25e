"""Makes one table of a run: the signals of all its topics on one grid of times."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from gpmpc._bounds import MemoryBudget
from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError, SettingError
from gpmpc.logs._clocks import (
    ORDER_ROWS,
    ORDER_TOPICS,
    Stamps,
    find_jumps,
    ordered_stamps,
)
from gpmpc.logs._decimation import changes_between_rows, held_means
from gpmpc.logs._equal_stamps import TimedRows, merge_rows
from gpmpc.logs._file import STAMP, Tables, begins_block, names_of_list
from gpmpc.logs._findings import RunFindings
from gpmpc.logs._mapping import LogMapping, Signal
from gpmpc.logs._resampling import (
    Grid,
    Interpolation,
    Samples,
    common_pieces,
    grid_at_rate,
    grid_of_rows,
    resample,
)
from gpmpc.logs._row_times import (
    counts_rows,
    doubt_of_unit,
    read_times,
    row_times,
    time_column_beside_signals,
    unit_of_clock,
    unit_text,
)
from gpmpc.logs._signals import nan_zero_dropouts, read_column, read_signal
from gpmpc.logs._units import conversion, is_known, unit_said_of_time, units_of

MANY_REPEATS = 0.2  # of the rows that stay: stamps that are rounded repeat as often
USUAL_GAP = 1.5  # time steps; a longer one is a gap where the mapping names none


class RunTable(NamedTuple):
    """The rows of one run on one grid; NaN where a value is missing."""

    name: str
    time: Array  # (K,) [s]
    values: Array  # states, inputs and context (K, n + m + c)
    outside_keep: np.ndarray  # (K,) rows outside the ranges of the mapping's ``keep``
    breaks: np.ndarray  # (K,) rows before which time ran backwards, or jumped


class _Topic(NamedTuple):
    """The rows of a topic in the order of their stamps."""

    where: str  # names the table, for errors
    table: pd.DataFrame
    stamps: Stamps


def tabulate(
    where: str,
    tables: Tables,
    mapping: LogMapping,
    findings: RunFindings,
    budget: MemoryBudget,
) -> RunTable:
    """Puts the signals of a run on one grid, in the units of ``gpmpc.logs``.

    Args:
        where: Names the file and the run, for errors.
        tables: Of the run, by topic.
        mapping: Says what their columns mean.
        findings: Of the run, which takes what is wrong.
        budget: What the rows will take is taken from it.

    Raises:
        DataError: A column, the stamps or the values of a signal cannot be used.
    """
    topics = {
        topic: _read_topic(topic, where, tables[topic], mapping, findings)
        for topic in dict.fromkeys(signal.topic for signal in mapping.signals)
    }
    for topic in topics.values():
        _note_units(units_of(topic.table), mapping, findings)
    grid = _make_grid(where, topics, mapping, findings, budget)
    columns = []
    for signal in mapping.signals:
        topic = topics[signal.topic]
        is_kept = _kept_rows(topic, mapping)
        values = read_signal(
            topic.where,
            topic.table,
            signal,
            findings,
            is_kept=is_kept,
            is_next_step=_are_next_steps(topic.stamps),
        )
        samples = Samples(topic.stamps.time, values)
        columns.append(_signal_on_grid(samples, grid, signal, mapping, findings))
        _note_own_rate(samples, grid, signal, mapping, findings)
    return RunTable(
        name=findings.run,
        time=grid.time,
        values=np.concatenate(columns, axis=1),
        outside_keep=_rows_outside(where, topics, grid, mapping),
        breaks=grid.breaks,
    )


def _read_topic(
    topic: str,
    where: str,
    table: pd.DataFrame,
    mapping: LogMapping,
    findings: RunFindings,
) -> _Topic:
    """Orders the rows of a topic, and puts NaN where no sensor was read."""
    if topic:
        where = f"{where}, {topic}"
    table = _stamped_rows(topic, table, findings)
    hint = ORDER_TOPICS if topic else ORDER_ROWS
    times = _read_time(topic, where, table, mapping, findings)
    has_time = np.isfinite(times)
    if has_time.any() and not has_time.all():
        count = int((~has_time).sum())
        findings.add("no stamp", count, f"{count} rows without a time: left out")
        table = table[has_time]
        times = times[has_time]
    signals = [signal for signal in mapping.signals if signal.topic == topic]
    _check_names(where, table, signals)
    columns = [column for signal in signals for column in signal.columns]
    rows = TimedRows(table, times)
    table, times = merge_rows(rows, [*columns, *mapping.keep], findings)
    is_only_table = not topic  # topics have their clock in common with others
    stamps = ordered_stamps(
        times, where, hint, may_restart=is_only_table, max_gap=mapping.max_gap
    )
    ordered = table.iloc[stamps.rows]
    if counts_rows(table, mapping):
        starts_piece = stamps.starts_piece | begins_block(ordered)
        stamps = stamps._replace(starts_piece=starts_piece)
    measured = ordered
    if any((signal.held or mapping.held) != "use" for signal in signals):
        measured = nan_zero_dropouts(where, ordered, signals, findings)
    _note_stamps(topic, stamps, mapping, findings)
    return _Topic(where=where, table=measured, stamps=stamps)


def _check_names(where: str, table: pd.DataFrame, signals: Sequence[Signal]) -> None:
    """Raises ``DataError`` where entries of lists are not the same in all messages.

    Two nodes that publish on one topic, such as the drivers of an arm and of its
    gripper, have joints of their own.
    """
    entries = [c for signal in signals for c in signal.columns if c.endswith("]")]
    for entry in entries:
        names = names_of_list(entry)
        if names in table:
            raise DataError(
                f"{where}: its messages carry {table[names].nunique()} different lists "
                f"of names, so that {entry} is not the same in all of them: does more "
                "than one node publish on the topic? record a topic for each"
            )


def _note_units(
    units: Mapping[str, str], mapping: LogMapping, findings: RunFindings
) -> None:
    """Notes columns of which the file says another unit than the mapping.

    Args:
        units: That the file says, by column.
        mapping: One that scales a signal knows better.
        findings: Of the run.
    """
    texts = []
    for signal in mapping.signals:
        taken = conversion("unit", signal.unit)
        for column, scale in zip(signal.columns, signal.scales, strict=True):
            unit = units.get(column, "")
            if scale != 1 or not unit or not is_known(unit):
                continue
            if not np.isclose(conversion("unit", unit).factor, taken.factor, rtol=1e-9):
                texts.append(
                    f"{column} in {unit} (taken as {signal.unit or 'no unit'})"
                )
    text = f"the file says other units than the mapping: {', '.join(texts)}"
    findings.add("unit", len(texts), text)


def _stamped_rows(
    topic: str, table: pd.DataFrame, findings: RunFindings
) -> pd.DataFrame:
    """Returns the rows of a topic whose message has a stamp; all of other tables."""
    if STAMP not in table:
        return table
    is_stamped = np.isfinite(table[STAMP].to_numpy(dtype=float))
    count = int((~is_stamped).sum())
    text = f"{count} messages of {topic} without a stamp: left out"
    findings.add("no stamp", count, text)
    if not is_stamped.any():
        raise DataError(f"{topic}: no message carries a stamp")
    return table[is_stamped]


def _read_time(
    topic: str,
    where: str,
    table: pd.DataFrame,
    mapping: LogMapping,
    findings: RunFindings,
) -> Array:
    """Reads the stamps (K,) [s] of a table, in the order of the file."""
    column = mapping.time
    if not column:
        counted = row_times(where, table, mapping)
        if counted is not None:
            _note_counted_rows(len(counted), mapping, findings)
            return counted
        column = STAMP if STAMP in table else "timestamp"
        if column not in table:
            raise DataError(f"{where}: {_without_times(table, mapping)}")
        if topic and mapping.time_unit not in ("", "s"):
            raise SettingError(
                "time.unit",
                "needs the column that it is of: the stamps of messages are in s; got "
                f"{mapping.time_unit!r} alone",
            )
        if topic and not mapping.stamp:
            _note_clock_of_messages(topic, table, findings)
    times = read_times(where, table, column, mapping.time_unit)
    if mapping.time or not topic:  # the stamps of messages are in s
        _note_unit_of_time(table, column, mapping.time_unit, times, findings)
    return times


def _note_counted_rows(rows: int, mapping: LogMapping, findings: RunFindings) -> None:
    """Notes rows whose step nobody stated but by the rate."""
    if mapping.time_step is not None or not mapping.rate:
        return
    text = (
        f"no column is called as times are, or holds dates: {rows} rows are taken as "
        f"{1 / mapping.rate:.3g} s apart, by the rate (time: {{column: NAME}} names "
        "one)"
    )
    findings.add("no times", rows, text)


def _note_clock_of_messages(
    topic: str, table: pd.DataFrame, findings: RunFindings
) -> None:
    """Notes messages with times of the log that carry a clock without a header.

    So do PX4's topics in bags: they came to the log later, and not evenly.
    """
    unit = unit_of_clock(table, "timestamp")
    if unit:
        text = (
            f"{topic} has the times of the log, and its column timestamp goes on as a "
            f"clock in {unit}: time: {{column: timestamp, unit: {unit}}} takes it, "
            "where all topics have it"
        )
        findings.add("times of the log", len(table), text)


def _note_unit_of_time(
    table: pd.DataFrame, column: str, unit: str, times: Array, findings: RunFindings
) -> None:
    """Notes a unit of the time that nobody stated, or of which the file says another.

    Args:
        table: With K rows.
        column: That holds their times.
        unit: That the mapping states; may be empty.
        times: As they were read (K,) [s].
        findings: Of the run.
    """
    doubt = doubt_of_unit(table, column, unit, times)
    findings.add("unit of the time", len(times) if doubt else 0, doubt)
    said = unit_said_of_time(unit_text(table, column))
    is_other = bool(unit and said and said != unit)
    text = f"the file says other units than the mapping: {column} in {said} (taken as "
    findings.add("unit", int(is_other), f"{text}{unit})")


def _without_times(table: pd.DataFrame, mapping: LogMapping) -> str:
    """Says that a mapping says no times, and what it may say."""
    column = time_column_beside_signals(table, mapping)
    if not column:
        return (
            "the mapping names no column of stamps (time: NAME) and no constant step "
            "of the rows (time: {step: 0.1})"
        )
    step = 1 / mapping.rate if mapping.rate else 0.1
    return (
        f"column {column!r} is called as times are, or holds them, and the mapping "
        f"names no column of stamps: time: {{column: {column!r}}} takes it; time: "
        f"{{step: {step:.6g}}} counts the rows instead"
    )


def _note_stamps(
    topic: str, stamps: Stamps, mapping: LogMapping, findings: RunFindings
) -> None:
    """Notes what was wrong with the stamps of a topic."""
    of_topic = f" of {topic}" if topic else ""
    for kind, count, remedy in (
        ("repeated stamp", stamps.repeated, _remedy_of_repeats(stamps)),
        ("stamp runs backwards", stamps.backwards, "left out"),
        ("rows out of order", stamps.disordered, "sorted by their stamps"),
    ):
        findings.add(kind, count, f"{count} rows{of_topic}: {remedy}")
    text = (
        "the clock began anew: the rows on both sides are used, as pieces of their "
        "own, and their times go on behind a pause"
    )
    findings.add("clock began anew", stamps.restarts, text)
    jumps = find_jumps(stamps.time, mapping.max_gap)
    jumps = jumps[~stamps.starts_piece[jumps + 1]]
    if len(jumps):
        longest = float(np.diff(stamps.time)[jumps].max())
        text = (
            f"{len(jumps)} jumps of the stamps{of_topic} by up to {longest:.6g} s, the "
            f"first behind row {jumps[0] + 1} of {len(stamps.time)}: boundaries, the "
            "rows on both sides are used"
        )
        findings.add("jump", len(jumps), text)


def _remedy_of_repeats(stamps: Stamps) -> str:
    """Says what becomes of rows whose stamps repeat, and what to do of many."""
    if stamps.repeated < MANY_REPEATS * len(stamps.time):
        return "left out"
    return (
        "left out; are the stamps rounded? Of rows at equal steps, "
        "time: {step: SECONDS} in place of the column takes all"
    )


def _make_grid(
    where: str,
    topics: Mapping[str, _Topic],
    mapping: LogMapping,
    findings: RunFindings,
    budget: MemoryBudget,
) -> Grid:
    """Makes the times of a run's rows: those of its one table, or at a rate."""
    columns = sum(len(signal.group.entries) for signal in mapping.signals)
    if mapping.rate is None:
        (topic,) = topics.values()  # of several, the mapping would ask for a rate
        return grid_of_rows(topic.stamps, columns, mapping.max_gap, budget)
    stamps = {name: topic.stamps for name, topic in topics.items()}
    pieces = common_pieces(stamps, mapping.max_gap, where, findings)
    return grid_at_rate(pieces, mapping.rate, columns, mapping.max_gap, budget)


def _signal_on_grid(
    samples: Samples,
    grid: Grid,
    signal: Signal,
    mapping: LogMapping,
    findings: RunFindings,
) -> Array:
    """Resamples a signal to the rows of a grid (G, c), if there is need."""
    if mapping.rate is None and not any(signal.delays):
        return samples.values  # the rows of the grid are those of the table
    usual_step = samples.usual_step
    if mapping.rate is not None:
        usual_step = max(usual_step, 1 / mapping.rate)
    interpolation = Interpolation(
        rule=signal.rule,
        max_gap=mapping.max_gap or USUAL_GAP * usual_step,
        angles=signal.group.kind == "angle",
    )
    # What was measured at a time has a stamp that is later by the delay.
    delays = signal.delays
    parts = [samples.column(i) for i in range(len(delays))]
    if len(set(delays)) == 1:
        delays = delays[:1]
        parts = [samples]
    is_plain_input = signal.role == "inputs" and signal.kind == "vector"
    may_average = is_plain_input and not signal.resample
    step = 1 / mapping.rate if mapping.rate else 0.0
    columns = []
    for part, delay in zip(parts, delays, strict=True):
        times = grid.time + delay
        values = resample(part, times, interpolation)
        if may_average and changes_between_rows(part, Samples(times, values), step):
            values = held_means(part, times, step, interpolation.max_gap)
            text = (
                f"{signal.name} changes between rows, {step / part.usual_step:.3g} "
                "samples to each: a row has the mean over its step (resample: hold "
                "takes the last sample)"
            )
            findings.add("averaged input", len(times), text)
        columns.append(values)
    return np.concatenate(columns, axis=1)


def _note_own_rate(
    samples: Samples,
    grid: Grid,
    signal: Signal,
    mapping: LogMapping,
    findings: RunFindings,
) -> None:
    """Notes a state that is measured less often than rows are made of it."""
    if mapping.rate is None or signal.role != "states":
        return
    own_step = samples.usual_step
    if own_step * mapping.rate < USUAL_GAP or signal.rule == "hold":
        return
    interpolated = 1 - 1 / (own_step * mapping.rate)  # of the rows
    text = (
        f"{signal.name} is measured at {1 / own_step:.3g} Hz: about "
        f"{interpolated:.0%} of its rows lie between two measurements, and hold "
        "something of the later one, so predictions look better than they are; state "
        "a lower rate"
    )
    findings.add("interpolated", int(interpolated * len(grid.time)), text)


def _rows_outside(
    where: str, topics: Mapping[str, _Topic], grid: Grid, mapping: LogMapping
) -> np.ndarray:
    """Finds the rows (G,) that lie outside the ranges of the mapping's ``keep``.

    Raises:
        DataError: A single table lacks a column of ``keep``.
        SettingError: No topic has a column of ``keep``.
    """
    outside = np.zeros(len(grid.time), dtype=bool)
    for column, limits in mapping.keep.items():
        topics_with_column = [
            topic
            for name, topic in topics.items()
            if column in topic.table or name == ""
        ]
        if not topics_with_column:
            raise SettingError(
                f"keep.{column}",
                f"no topic of the mapping has such a column in {where}; they are "
                f"{', '.join(topics)}",
            )
        for topic in topics_with_column:
            outside |= _rows_outside_of(topic, column, limits, grid, mapping)
    return outside


def _kept_rows(topic: _Topic, mapping: LogMapping) -> np.ndarray:
    """Finds the rows (K,) of a topic inside the ranges of ``keep`` that it holds.

    The others are left out of checks here, and of the log by ``_rows_outside``, once
    all signals are on one grid.
    """
    is_kept = np.ones(len(topic.table), dtype=bool)
    for column, (low, high) in mapping.keep.items():
        if column in topic.table:
            values = read_column(topic.where, topic.table, column)
            is_kept &= (values >= low) & (values <= high)
    return is_kept


def _are_next_steps(stamps: Stamps) -> np.ndarray:
    """Finds the rows (K,) that stand a usual time step behind the row before."""
    steps = np.diff(stamps.time)
    if not len(steps):
        return np.zeros(len(stamps.time), dtype=bool)
    is_usual = steps <= USUAL_GAP * np.median(steps)
    return np.r_[False, is_usual] & ~stamps.starts_piece


def _rows_outside_of(
    topic: _Topic,
    column: str,
    limits: tuple[float, float],
    grid: Grid,
    mapping: LogMapping,
) -> np.ndarray:
    """Finds the rows (G,) in which the last value of a column lies outside of limits.

    A missing value does so, too.
    """
    low, high = limits
    values = read_column(topic.where, topic.table, column)[:, None]
    is_outside = np.where((values >= low) & (values <= high), 0.0, 1.0)
    if mapping.rate is not None:
        samples = Samples(topic.stamps.time, is_outside)
        hold = Interpolation(rule="hold", max_gap=np.inf)
        is_outside = resample(samples, grid.time, hold)
    return is_outside[:, 0] > 0
