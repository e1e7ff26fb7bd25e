"""Makes one table of a run: the signals of all its topics on one grid of times."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd

from gpmpc._bounds import Room
from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError
from gpmpc.logs._clocks import (
    ORDER_ROWS,
    ORDER_TOPICS,
    Stamps,
    find_jumps,
    ordered_stamps,
)
from gpmpc.logs._file import STAMP, Tables
from gpmpc.logs._findings import RunFindings
from gpmpc.logs._mapping import TIME_UNITS, LogMapping
from gpmpc.logs._resampling import Grid, grid_at_rate, grid_of_rows, resample
from gpmpc.logs._signals import empty_zero_dropouts, read_column, read_signal

USUAL_GAP = 1.5  # time steps; a longer one is a gap where the mapping names none


class RunTable(NamedTuple):
    """The rows of one run on one grid; NaN where a value is missing."""

    name: str
    time: Array  # (K,) [s]
    values: Array  # states, inputs and context (K, n + m + c)
    outside: np.ndarray  # (K,) rows that the mapping leaves out
    breaks: np.ndarray  # (K,) rows before which time ran backwards, or jumped


class _Topic(NamedTuple):
    """The rows of a topic in the order of their stamps."""

    label: str  # names the table, for errors
    table: pd.DataFrame
    stamps: Stamps


def tabulate(
    where: str,
    tables: Tables,
    mapping: LogMapping,
    findings: RunFindings,
    room: Room,
) -> RunTable:
    """Puts the signals of a run on one grid, in the units of ``gpmpc.logs``.

    Args:
        where: Names the file and the run, for errors.
        tables: Of the run, by topic.
        mapping: Says what their columns mean.
        findings: Of the run, which takes what is wrong.
        room: What the rows will take is taken from it.

    Raises:
        DataError: A column, the stamps or the values of a signal cannot be used.
    """
    topics = {
        topic: _read_topic(topic, where, tables[topic], mapping, findings)
        for topic in dict.fromkeys(signal.topic for signal in mapping.signals)
    }
    grid = _make_grid(where, topics, mapping, findings, room)
    columns = []
    for signal in mapping.signals:
        topic = topics[signal.topic]
        columns.append(
            _put_on_grid(
                read_signal(topic.label, topic.table, signal, findings),
                time=topic.stamps.time,
                grid=grid.time,
                rate=mapping.rate,
                rule=signal.rule,
                max_gap=mapping.max_gap,
                angles=signal.kind == "angle",
                delay=signal.delay,
            )
        )
    return RunTable(
        name=findings.run,
        time=grid.time,
        values=np.concatenate(columns, axis=1),
        outside=_rows_outside(topics, grid, mapping),
        breaks=grid.breaks,
    )


def _read_topic(
    topic: str,
    where: str,
    table: pd.DataFrame,
    mapping: LogMapping,
    findings: RunFindings,
) -> _Topic:
    """Orders the rows of a topic, and empties those in which nothing was measured."""
    label = f"{where}, {topic}" if topic else where
    table = _stamped_rows(topic, table, findings)
    hint = ORDER_TOPICS if topic else ORDER_ROWS
    stamps = ordered_stamps(_read_time(label, table, mapping), label, hint)
    signals = [signal for signal in mapping.signals if signal.topic == topic]
    ordered = table.iloc[stamps.rows]
    measured = empty_zero_dropouts(label, ordered, signals, findings)
    _note_stamps(topic, stamps, mapping, findings)
    return _Topic(label=label, table=measured, stamps=stamps)


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


def _read_time(label: str, table: pd.DataFrame, mapping: LogMapping) -> Array:
    """Reads the stamps (K,) [s] of a table, in the order of the file."""
    if mapping.time:
        unit = TIME_UNITS[mapping.time_unit]
        return read_column(label, table, mapping.time) * unit
    column = STAMP if STAMP in table else "timestamp"
    if column not in table and mapping.rate:
        return np.arange(len(table)) / mapping.rate  # rows at a rate that is declared
    return read_column(label, table, column)


def _note_stamps(
    topic: str, stamps: Stamps, mapping: LogMapping, findings: RunFindings
) -> None:
    """Notes what was wrong with the stamps of a topic."""
    of_topic = f" of {topic}" if topic else ""
    for kind, count, remedy in (
        ("repeated stamp", stamps.repeated, "left out"),
        ("stamp runs backwards", stamps.backwards, "left out"),
        ("rows out of order", stamps.disordered, "sorted by their stamps"),
    ):
        findings.add(kind, count, f"{count} rows{of_topic}: {remedy}")
    jumps = find_jumps(stamps.time, mapping.max_gap)
    if len(jumps):
        longest = float(np.diff(stamps.time)[jumps].max())
        text = (
            f"{len(jumps)} jumps of the stamps{of_topic} by up to {longest:.6g} s, the "
            f"first behind row {jumps[0] + 1} of {len(stamps.time)}: boundaries, the "
            "rows on both sides are used"
        )
        findings.add("jump", len(jumps), text)


def _make_grid(
    where: str,
    topics: Mapping[str, _Topic],
    mapping: LogMapping,
    findings: RunFindings,
    room: Room,
) -> Grid:
    """Makes the times of a run's rows: those of its one table, or at a rate."""
    columns = sum(len(signal.group.entries) for signal in mapping.signals)
    if mapping.rate is None:
        (topic,) = topics.values()
        return grid_of_rows(topic.stamps, columns, mapping.max_gap, room)
    return grid_at_rate(
        stamps={name: topic.stamps for name, topic in topics.items()},
        rate=mapping.rate,
        columns=columns,
        max_gap=mapping.max_gap,
        where=where,
        findings=findings,
        room=room,
    )


def _put_on_grid(
    values: Array,
    *,
    time: Array,
    grid: Array,
    rate: float | None,
    rule: str,
    max_gap: float | None,
    angles: bool = False,
    delay: float = 0.0,
) -> Array:
    """Resamples values (K, c) at times (K,) [s] to a grid (G,) [s], if there is need.

    Args:
        values: Of a signal.
        time: At which they are stamped.
        grid: Times of the rows.
        rate: Of the grid [Hz]; None where its times are those of the values.
        rule: See ``resample``.
        max_gap: [s]; None takes ``USUAL_GAP``.
        angles: See ``resample``.
        delay: [s] by which the values come later than their stamps say.
    """
    if rate is None and delay == 0:
        return values
    usual_step = float(np.median(np.diff(time)))
    if rate is not None:
        usual_step = max(usual_step, 1 / rate)
    return resample(
        time=time,
        values=values,
        grid=grid + delay,
        rule=rule,
        max_gap=max_gap or USUAL_GAP * usual_step,
        angles=angles,
    )


def _rows_outside(
    topics: Mapping[str, _Topic], grid: Grid, mapping: LogMapping
) -> np.ndarray:
    """Finds the rows (G,) that lie outside the ranges of the mapping's ``keep``."""
    outside = np.zeros(len(grid.time), dtype=bool)
    for column, (low, high) in mapping.keep.items():
        for name, topic in topics.items():
            if column not in topic.table and name != "":
                continue
            values = read_column(topic.label, topic.table, column)[:, None]
            is_outside = np.where((values >= low) & (values <= high), 0.0, 1.0)
            on_grid = _put_on_grid(
                is_outside,
                time=topic.stamps.time,
                grid=grid.time,
                rate=mapping.rate,
                rule="hold",
                max_gap=np.inf,
            )
            outside |= on_grid[:, 0] > 0
    return outside
