"""Looks at a log before anything is learned: what can be learned, what its rows hide.

Streams are looked at one by one: their clock, their gaps, their channels
(``_channel_figures``) and delays between these (``_delays``). With a mapping, the log
is read as well: an input of which the states explain most of the variance, linearly,
teaches nothing of its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError, SettingError, check_kind, check_number
from gpmpc.logs._channel_figures import (
    ChannelFigures,
    channel_table,
    channel_warnings,
    describe_channel,
    text_warning,
)
from gpmpc.logs._columns import (
    TablesOfRun,
    check_column,
    column_number,
    named_columns,
)
from gpmpc.logs._delays import (
    MOST_CHANNELS,
    Delay,
    delay_table,
    find_delays,
    moving_channels,
)
from gpmpc.logs._file import LIST_NAMES, Tables
from gpmpc.logs._findings import Finding
from gpmpc.logs._formats import read_file
from gpmpc.logs._log import Log
from gpmpc.logs._mapping import LogMapping
from gpmpc.logs._read_log import read_log
from gpmpc.logs._regression import Standardization, fit_affine
from gpmpc.logs._row_times import (
    doubt_of_unit,
    fault_of_seconds,
    read_dates,
    row_times,
    time_column_beside_signals,
    time_unit,
    usual_time_column,
)
from gpmpc.logs._runs import split_into_runs
from gpmpc.logs._signals import holds_times, read_column
from gpmpc.logs._time_step import JITTER
from gpmpc.logs._units import TIME_UNITS

EVEN = 1e-3  # of its step: a column that rises as evenly may be the time
LEAST_RATE = 1.0  # [Hz] a single number from here on may be the rate of the rows
MANY_COLUMNS = 20  # more than the rows: these may be signals
LARGEST_JITTER = 0.5  # of the median step of what may be times
MOST_USUAL = 0.9  # least share of their steps that jitter no more
DRAWN = 3000  # points of a channel's line
MOST_DELAYS = 20  # that are listed
FOLLOWS = 0.95  # share of an input's variance that the states explain
GAP = 1.5  # time steps between two rows, from which on rows are missing


@dataclass(frozen=True)
class Inspection:
    """The content of a log file; shares lie between 0 and 1.

    See Also:
        ``inspect_log``, which returns it.
    """

    title: str  #: the file and its size in words
    #: a row a stream; its jitter is the standard deviation over the time step
    streams: pd.DataFrame
    #: a row a channel, by name; "white noise" is the standard deviation of the one
    #: that second differences hold, "repeated" the share of the rows with the value of
    #: the row before, "smoothness" the correlation of neighbouring second differences
    channels: pd.DataFrame
    #: a row a pair, the strongest first: by how many rows the later channel is late
    #: (median, with its range over the blocks), which share of the blocks agrees to a
    #: row, and the correlation of the differences
    delays: pd.DataFrame
    #: share of the variance that the states explain, by input; only with a mapping
    follows: dict[str, float]
    lines: dict[str, tuple[Array, Array]]  #: time [s] and values to draw, by channel
    gaps: tuple[tuple[float, float], ...]  #: begin and end [s] of each, of all streams
    warnings: tuple[str, ...]  #: what to beware of, in words


class _Source(NamedTuple):
    """The table of a stream."""

    title: str  # a topic, or one of the runs in a file
    topic: str
    table: pd.DataFrame


class _Times(NamedTuple):
    """The times of a stream's rows."""

    stamps: Array  # (K,) [s]; the numbers of the rows where nothing says more
    column: str = ""  # that holds them
    count_rows: bool = False
    doubt: str = ""  # about their unit, in words


class _Clock(NamedTuple):
    """The rows of a stream in the order of their stamps, one row a stamp."""

    rows: np.ndarray  # (K,) of the table
    time: Array  # (K,) [s]
    missing: int  # rows whose stamp is no finite number
    repeated: int  # rows with the stamp of another row
    backwards: int  # rows that stand behind a row with a later stamp


class _Steps(NamedTuple):
    """The time steps of a stream."""

    rate: float  # [Hz]; NaN with a single stamp
    jitter: float  # standard deviation over the time step
    gaps: list[tuple[float, float]]  # begin and end [s]
    longest_gap: float  # [s]


@dataclass(frozen=True)
class _Stream:
    """The inspection of one stream."""

    summary: dict[str, Any]
    channels: dict[str, ChannelFigures]
    lines: dict[str, tuple[Array, Array]]
    delays: list[Delay]
    gaps: list[tuple[float, float]]
    warnings: list[str]
    text_columns: list[str]


class _Reading(NamedTuple):
    """What reading the log with a mapping says."""

    warnings: list[str]
    dependence: dict[str, float]  # by input; see ``Inspection.follows``


@explains_arguments
def inspect_log(
    path: str | Path,
    mapping: LogMapping | None = None,
    time: str = "",
    time_step: float | None = None,
) -> Inspection:
    r"""Inspects a log file, however broken its rows are.

    Args:
        path: In a format of ``read_log``.
        mapping: Says which columns matter, which is the time, and what are states and
            inputs; all numbers by default.
        time: Column of the stamps, where there is no mapping, in the unit that the
            file says or in s; by default one of ``TIMES``, with a unit in its name or
            of dates, and where there is none, values stand over their rows.
        time_step: The constant step of rows without stamps [s], likewise.

    Raises:
        DataError: The file cannot be read, or a column that is named is missing.
        SettingError: ``mapping`` is of another kind, or times are said twice.

    >>> import pathlib, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder, "drive.csv")
    ...     _ = file.write_text("t,x\n0.0,0.0\n0.1,0.1\n0.2,0.2\n0.3,0.3\n")
    ...     inspection = inspect_log(file)
    >>> len(inspection.gaps)
    0

    See Also:
        ``read_log``, which reads the runs.
    """
    if mapping is not None:
        check_kind("mapping", mapping, LogMapping, "a LogMapping")
    _check_times(mapping, time, time_step)
    topics = {signal.topic for signal in mapping.signals} if mapping else ()
    stamp = mapping.stamp if mapping else ""
    file = read_file(path, topics, partial=True, stamp=stamp)
    streams = [
        _inspect_stream(
            source, _times_of(source, path, mapping, time, time_step), mapping
        )
        for source in _sources(path, file.tables, mapping)
    ]
    return _inspection_of(
        name=Path(path).name,
        streams=streams,
        findings=file.findings,
        reading=_read_with(mapping, path),
    )


def _inspection_of(
    name: str,
    streams: Sequence[_Stream],
    findings: Sequence[Finding],
    reading: _Reading,
) -> Inspection:
    """Puts together what the streams of a file and the reading of it say.

    Args:
        name: Of the file.
        streams: Inspected.
        findings: Of the file's reader.
        reading: With the mapping.
    """
    channels: dict[str, ChannelFigures] = {}
    lines: dict[str, tuple[Array, Array]] = {}
    for stream in streams:
        channels |= stream.channels
        lines |= stream.lines
    delays = [delay for stream in streams for delay in stream.delays]
    delays = sorted(delays, key=lambda delay: -abs(delay.correlation))[:MOST_DELAYS]
    text_columns = [column for stream in streams for column in stream.text_columns]
    warnings = [
        *(f"{finding.kind}: {finding.text}" for finding in findings),
        *(warning for stream in streams for warning in stream.warnings),
        *text_warning(text_columns),
        *channel_warnings(channels),
        *(delay.warning for delay in delays if delay.warning),
        *reading.warnings,
        *_dependence_warnings(reading.dependence),
    ]
    if not channels:
        warnings.append("no channel of numbers stands beside the time")
    rows = sum(stream.summary["rows"] for stream in streams)
    return Inspection(
        title=f"{name}: {rows} rows, {len(channels)} channels",
        streams=pd.DataFrame([stream.summary for stream in streams]),
        channels=channel_table(channels),
        delays=delay_table(delays),
        follows=reading.dependence,
        lines=lines,
        gaps=tuple(gap for stream in streams for gap in stream.gaps),
        warnings=tuple(dict.fromkeys(warnings)),
    )


def _read_with(mapping: LogMapping | None, path: str | Path) -> _Reading:
    """Reads a log with a mapping, if there is one."""
    if mapping is None:
        return _Reading(warnings=[], dependence={})
    try:
        log = read_log(path, mapping, partial=True)
    except (DataError, SettingError) as error:
        warning = f"with this mapping the log cannot be learned from: {error}"
        return _Reading(warnings=[warning], dependence={})
    warnings = [f"{finding.kind}: {finding.text}" for finding in log.findings]
    return _Reading(warnings=warnings, dependence=input_dependence(log))


def _check_times(
    mapping: LogMapping | None, time: str, time_step: float | None
) -> None:
    """Raises ``SettingError`` where times are said twice, or their step is none."""
    if time_step is not None:
        check_number("time-step", time_step, above=0)
    if mapping is not None and (time or time_step):
        raise SettingError("time", "must stand in the mapping where there is one")
    if time and time_step:
        raise SettingError(
            "time-step", "is for rows without stamps; got --time as well"
        )


def _sources(
    path: str | Path, tables: Tables, mapping: LogMapping | None
) -> list[_Source]:
    """Lists the tables of the streams: one for each topic, or for each run.

    A table whose runs cannot be told apart is a single stream; reading it says why.
    """
    if mapping is None:
        return [_Source(topic, topic, table) for topic, table in tables.items()]
    named = named_columns(path, tables, mapping)
    try:
        runs = list(split_into_runs(Path(path), named, mapping, findings=[]))
    except DataError:
        if not mapping.run:
            raise
        runs = [TablesOfRun("", named)]
    return [
        _Source(topic or run, topic, table)
        for run, tables_of_run in runs
        for topic, table in tables_of_run.items()
    ]


def _inspect_stream(
    source: _Source, times: _Times, mapping: LogMapping | None
) -> _Stream:
    """Inspects the rows of one table."""
    source = source._replace(table=_with_numbers(source.table))
    table = source.table
    stamps = times.stamps
    clock = _read_clock(stamps)
    steps = _measure_steps(clock.time)
    rows = clock.rows
    time = clock.time
    if len(time) < 2:  # values stand over their rows
        rows = np.arange(len(table))
        time = rows.astype(float)

    columns = _columns_of_interest(source, times.column, mapping)
    numeric = set(table.select_dtypes("number"))
    constants = _constants(table, [name for name in columns if name in numeric])
    numbers = [name for name in columns if name in numeric and name not in constants]
    titles = [_title(source.title, name) for name in numbers]
    values = table[numbers].to_numpy(float)[rows]
    stride = max(len(values) // DRAWN, 1)
    by_title = dict(zip(titles, values.T, strict=True))
    return _Stream(
        summary=_summary(source.title, len(table), clock, steps, times),
        channels={title: describe_channel(v) for title, v in by_title.items()},
        lines={
            title: (time[::stride], column[::stride])
            for title, column in by_title.items()
        },
        delays=find_delays(titles, values),
        gaps=steps.gaps,
        warnings=[
            *_stream_warnings(source.title, clock, steps, times),
            *_time_hints(source, times, constants, numbers),
            *_warn_of_width(source.title, len(moving_channels(values))),
            *_warn_of_names(source),
        ],
        text_columns=[
            _title(source.title, name) for name in columns if name not in numeric
        ],
    )


def _with_numbers(table: pd.DataFrame) -> pd.DataFrame:
    """Makes numbers of the booleans and texts that ``read_log`` takes for numbers."""
    columns = {}
    for name in table.columns:
        column = table[name]
        if column.dtype.kind in "iufmM":
            continue
        numbers = pd.to_numeric(column, errors="coerce").astype(float)
        if numbers.notna().any() and (numbers.notna() | column.isna()).all():
            columns[name] = numbers
    return table.assign(**columns)


def _warn_of_width(title: str, channels: int) -> list[str]:
    """Says that delays are not looked for between all channels of a wide stream."""
    if channels <= MOST_CHANNELS:
        return []
    of_topic = f" of {title}" if title else ""
    return [
        f"delays are looked for between the first {MOST_CHANNELS} of {channels} "
        f"channels{of_topic} that move: a mapping says which channels count"
    ]


def _warn_of_names(source: _Source) -> list[str]:
    """Says that entries of lists are not the same in all messages of a topic."""
    lists = [name for name in map(str, source.table) if name.endswith(LIST_NAMES)]
    if not lists:
        return []
    count = source.table[lists].nunique().max()
    named = ", ".join(name.removesuffix(LIST_NAMES) for name in lists)
    return [
        f"messages of {source.title} carry {count} different lists of names: entries "
        f"of {named}, [0], [1], ..., are not the same in all of them"
    ]


def _title(topic: str, column: Any) -> str:
    return f"{topic}.{column}" if topic else str(column)


def _columns_of_interest(
    source: _Source, time_name: str, mapping: LogMapping | None
) -> list[Any]:
    """Lists the columns beside the time; with a mapping, those of its signals."""
    columns = [
        name
        for name in source.table
        if name != time_name and not str(name).endswith(LIST_NAMES)
    ]
    if mapping is None:
        return columns
    signals = [signal for signal in mapping.signals if signal.topic == source.topic]
    mapped = {column for signal in signals for column in signal.columns}
    return [name for name in columns if name in mapped]


def _constants(table: pd.DataFrame, columns: Sequence[Any]) -> dict[Any, float]:
    """Returns the columns that hold a single number, with it, where others hold more.

    Such a column says something of the whole file, such as the time step.
    """
    counts = table[list(columns)].count()
    if counts.max() < 2:
        return {}
    single = [name for name in columns if counts[name] == 1]
    return {name: float(table[name].dropna().iloc[0]) for name in single}


def _times_of(
    source: _Source,
    path: str | Path,
    mapping: LogMapping | None,
    time: str,
    time_step: float | None,
) -> _Times:
    """Finds the times of a stream's rows: a column, a step, or their numbers.

    Raises:
        DataError: The column that is named is missing.
    """
    table = source.table
    if mapping is not None and not mapping.time:
        stamps = row_times(str(path), table, mapping)
        if stamps is not None:
            return _Times(stamps)
    if time_step is not None:
        return _Times(np.arange(len(table), dtype=float) * time_step)
    named = mapping.time if mapping is not None else time
    unit = mapping.time_unit if mapping is not None else ""
    number = column_number(table, named)
    if number:
        named = str(table.columns[number - 1])
    if named:
        check_column(str(path), table, named)
    else:
        named = usual_time_column(table)
        if mapping is not None:
            named = time_column_beside_signals(table, mapping)
        if named != "timestamp" or source.topic:  # the mapping's is of ``timestamp``
            unit = ""
    if not named:
        return _Times(np.arange(len(table), dtype=float), count_rows=True)
    if holds_times(table, named):
        return _Times(read_column(str(path), table, named), column=named)
    dates = read_dates(table, named)
    if dates is not None:
        return _Times(dates, column=named)
    stamps = pd.to_numeric(table[named], errors="coerce").to_numpy(float)
    doubt = ""
    try:
        unit = unit or time_unit(str(path), table, named)
    except DataError as error:
        doubt = str(error)
    times = stamps * TIME_UNITS[unit or "s"]
    if not unit and not source.topic:  # the stamps of messages are in s
        doubt = doubt or fault_of_seconds(times, named)
        doubt = doubt or doubt_of_unit(table, named, unit, times)
    is_said = mapping is not None  # by the reading with the mapping
    return _Times(times, column=named, doubt="" if is_said else doubt)


def _read_clock(stamps: Array) -> _Clock:
    """Sorts rows by their stamps (K,) [s], and counts what is wrong with these."""
    finite = np.flatnonzero(np.isfinite(stamps))
    in_file_order = stamps[finite]
    latest = np.maximum.accumulate(in_file_order)
    order = np.argsort(in_file_order, kind="stable")
    sorted_stamps = in_file_order[order]
    first_of_stamp = np.ones(len(finite), dtype=bool)
    first_of_stamp[1:] = sorted_stamps[1:] > sorted_stamps[:-1]
    return _Clock(
        rows=finite[order][first_of_stamp],
        time=sorted_stamps[first_of_stamp],
        missing=len(stamps) - len(finite),
        repeated=int((~first_of_stamp).sum()),
        backwards=int((in_file_order < latest).sum()),
    )


def _measure_steps(time: Array) -> _Steps:
    """Measures the time steps between increasing stamps (K,) [s]."""
    steps = np.diff(time)
    if not len(steps):
        return _Steps(rate=np.nan, jitter=np.nan, gaps=[], longest_gap=0.0)
    step = float(np.median(steps))
    is_gap = steps > GAP * step
    gaps = [(float(time[row]), float(time[row + 1])) for row in np.flatnonzero(is_gap)]
    return _Steps(
        rate=1 / step,
        jitter=float(steps[~is_gap].std() / step),
        gaps=gaps,
        longest_gap=float(steps[is_gap].max(initial=0)),
    )


def _summary(
    title: str, rows: int, clock: _Clock, steps: _Steps, times: _Times
) -> dict[str, Any]:
    """Makes the row of a stream in ``Inspection.streams``."""
    return {
        "stream": title,
        "rows": rows,
        "rate [Hz]": np.nan if times.count_rows else steps.rate,
        "jitter": steps.jitter,
        "gaps": len(steps.gaps),
        "longest gap [s]": steps.longest_gap,
        "missing stamps": clock.missing,
        "repeated stamps": clock.repeated,
        "backward stamps": clock.backwards,
    }


def _stream_warnings(
    title: str, clock: _Clock, steps: _Steps, times: _Times
) -> list[str]:
    """Says what is wrong with the stamps of a stream."""
    of_topic = f" of {title}" if title else ""
    if times.count_rows:
        return [
            f"no column{of_topic} is called as times are: values stand over their rows "
            "(--time COLUMN or --time-step SECONDS says more; in a mapping, time: NAME "
            "or time: {step: SECONDS})"
        ]
    warnings = [times.doubt] if times.doubt else []
    for count, kind in (
        (clock.missing, "missing stamps"),
        (clock.repeated, "repeated stamps"),
        (clock.backwards, "backward stamps"),
    ):
        if count:
            warnings.append(f"{count} {kind}{of_topic}")
    if len(clock.time) < 2:
        stamps = "a single stamp" if len(clock.time) else "no stamp"
        warnings.append(
            f"the time{of_topic} holds {stamps}: values stand over their rows"
        )
    if steps.gaps:
        warnings.append(
            f"{len(steps.gaps)} gaps{of_topic}, up to {steps.longest_gap:.3g} s"
        )
    if steps.jitter > JITTER:
        jitter = f"{steps.jitter:.0%} of the time step"
        warnings.append(f"stamps{of_topic} jitter by {jitter}: state a rate")
    return warnings


def _time_hints(
    source: _Source,
    times: _Times,
    constants: Mapping[Any, float],
    numbers: Sequence[Any],
) -> list[str]:
    """Says which columns may be the time, and which hold a single number."""
    of_title = f" of {source.title}" if source.title else ""
    hints = []
    for name, value in constants.items():
        if value <= 0:  # no time step
            continue
        text = f"{name}{of_title} holds a single number, {value:g}: if it is the "
        text += f"time step, time: {{step: {name}}}"
        if value >= LEAST_RATE:
            text += f"; if it is the rate in Hz, rate: {value:.10g}"
        hints.append(text)
    if not times.count_rows:
        return hints
    rows, columns = source.table.shape
    if columns >= MANY_COLUMNS and columns > rows:
        hints.append(
            f"{rows} rows of {columns} columns{of_title}: a row is to hold the values "
            "of one time; if its rows are signals, transpose the file"
        )
    for name in numbers:
        steps = np.diff(source.table[name].to_numpy(float))
        if len(steps) < 2 or not steps.min() > 0:
            continue
        usual = float(np.median(steps))
        is_usual = np.abs(steps - usual) < usual * LARGEST_JITTER
        if np.ptp(steps) < EVEN * usual:
            hints.append(f"{name} rises evenly, by {usual:.4g}: is it the time?")
        elif is_usual.mean() >= MOST_USUAL:
            text = f"{name} rises in every row, by about {usual:.4g}: is it the time?"
            hints.append(text)
    return hints


def _dependence_warnings(dependence: Mapping[str, float]) -> list[str]:
    return [
        f"{name} follows the states ({share:.0%} of its variance): its own effect "
        "cannot be learned"
        for name, share in dependence.items()
        if share > FOLLOWS
    ]


def input_dependence(log: Log) -> dict[str, float]:
    """Returns the share of each input's variance that the states explain.

    They explain it by a linear function of themselves and of their squares. What as
    many weights explain by chance does not count.
    """
    states = np.concatenate([run.states for run in log])
    inputs = np.concatenate([run.inputs for run in log])
    scaled = Standardization.of(states)(states)
    features = np.column_stack([scaled, scaled**2])
    weights = fit_affine(features, inputs)
    unexplained = (inputs - features @ weights[:-1]).var(axis=0)
    rows = len(features)
    unexplained *= rows / max(rows - len(weights), 1)
    return _explained_shares(log.different_input_names, unexplained, inputs.var(axis=0))


def _explained_shares(
    names: Sequence[str], unexplained: Array, variances: Array
) -> dict[str, float]:
    """Returns explained shares of variances (m,), of those that are not zero."""
    return {
        name: max(1 - float(residual / variance), 0.0)
        for name, residual, variance in zip(names, unexplained, variances, strict=True)
        if variance > 0
    }
