"""Looks at a log before anything is learned from it: what can be learned, and what its rows hide.

White noise is found by second differences, whose variance is six times that of the noise, and smoothing by their
correlation with the ones before: -2/3 for white noise, positive for a smoothed signal. Delays between channels are
found block by block, so that clocks that wander are seen. An input of which the states explain most of the variance,
linearly, teaches nothing of its own.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from gpmpc.exceptions import DataError
from gpmpc.logs._file import STAMP
from gpmpc.logs._kinematics import Array
from gpmpc.logs._log import Log
from gpmpc.logs._mapping import TIME_UNITS, LogMapping
from gpmpc.logs._readers import read_file
from gpmpc.logs._reading import read_log

# columns that hold the time where nobody says which
TIMES = (STAMP, "timestamp", "t", "time", "stamp", "Time", "seconds")
DRAWN = 3000  # points of a channel's line
# rows in which delays are sought, and how far
BLOCKS = 16
BLOCK = 4096
REACH = 50
SHARP = 10  # rows within which a peak falls by a fifth
CORRELATED = 0.5  # from which a delay says something
PAIRS = 20  # most delays that are listed
_DELAYS = [
    "channel",
    "later channel",
    "rows",
    "lowest",
    "highest",
    "agreement",
    "correlation",
]
FOLLOWS = 0.95  # share of an input's variance that the states explain
GAP = 1.5  # time steps between two rows, from which on rows are missing
JITTER = 0.1  # of the time step, from which on a rate should be stated
NAMED = 3  # channels that are named where many have the same remark


@dataclass(frozen=True)
class Inspection:
    """What is in a log file; shares lie between 0 and 1."""

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


class _Remark(NamedTuple):
    """What to beware of in one channel."""

    subject: str  # the channel
    text: str  # of this channel
    kind: str  # of all channels that it is said of with other numbers


class _Clock(NamedTuple):
    """The rows of a stream in the order of their stamps, one row a stamp."""

    rows: np.ndarray  # (K,) of the table
    time: Array  # (K,) [s]
    missing: int  # rows whose stamp is no finite number
    repeated: int  # rows with the stamp of another row
    backwards: int  # rows that stand behind a row with a later stamp


@dataclass(frozen=True)
class _Stream:
    """What was found in one stream."""

    summary: dict[str, Any]
    channels: dict[str, dict[str, float]]
    lines: dict[str, tuple[Array, Array]]
    delays: list[tuple[Any, ...]]
    gaps: list[tuple[float, float]]
    warnings: list[str]
    text_columns: list[str]


def inspect_log(path: str | Path, mapping: LogMapping | None = None) -> Inspection:
    """Inspects a log file, however broken its rows are.

    Args:
        path: In a format of ``read_log``.
        mapping: Says which columns matter, which is the time, and what are states and
            inputs; all numbers by default.

    Raises:
        DataError: The file cannot be read, or no column holds the time.
    """
    topics = {signal.topic for signal in mapping.signals} if mapping else ()
    stamp = mapping.stamp if mapping else ""
    file = read_file(path, topics, partial=True, stamp=stamp)
    streams = [
        _inspect_stream(path, topic, table, mapping)
        for topic, table in file.streams.items()
    ]
    channels = {
        name: numbers for stream in streams for name, numbers in stream.channels.items()
    }
    delays = [delay for stream in streams for delay in stream.delays]
    delays = sorted(delays, key=lambda delay: -abs(delay[-1]))[:PAIRS]
    follows: dict[str, float] = {}
    reading: list[str] = []
    if mapping is not None:
        try:
            log = read_log(path, mapping, partial=True)
        except DataError as error:
            reading = [f"with this mapping the log cannot be learned from: {error}"]
        else:
            reading = [f"{finding.kind}: {finding.text}" for finding in log.findings]
            follows = _dependence(log)
    warnings = [
        *(f"{finding.kind}: {finding.text}" for finding in file.findings),
        *(warning for stream in streams for warning in stream.warnings),
        *_text_warning([name for stream in streams for name in stream.text_columns]),
        *_channel_warnings(channels),
        *_delay_warnings(delays),
        *reading,
        *_dependence_warnings(follows),
    ]
    rows = sum(stream.summary["rows"] for stream in streams)
    if not channels:
        warnings.append("no channel of numbers stands beside the time")
    return Inspection(
        title=f"{Path(path).name}: {rows} rows, {len(channels)} channels",
        streams=pd.DataFrame([stream.summary for stream in streams]),
        channels=_channel_table(channels),
        delays=pd.DataFrame(delays, columns=_DELAYS),
        follows=follows,
        lines={name: line for stream in streams for name, line in stream.lines.items()},
        gaps=tuple(gap for stream in streams for gap in stream.gaps),
        warnings=tuple(dict.fromkeys(warnings)),
    )


def _inspect_stream(
    path: str | Path, topic: str, table: pd.DataFrame, mapping: LogMapping | None
) -> _Stream:
    """Inspects the rows of one table."""
    time_name = _time_column(path, table, mapping)
    stamps = pd.to_numeric(table[time_name], errors="coerce").to_numpy(float)
    if mapping is not None:
        stamps = stamps * TIME_UNITS[mapping.time_unit]
    clock = _read_clock(stamps)
    of_topic = f" of {topic}" if topic else ""
    warnings = _clock_warnings(clock, of_topic)
    steps = np.diff(clock.time)
    summary = {"stream": topic, "rows": len(table)}
    gaps: list[tuple[float, float]] = []
    if len(steps):
        step = float(np.median(steps))
        is_gap = steps > GAP * step
        gaps = [
            (float(clock.time[row]), float(clock.time[row + 1]))
            for row in np.flatnonzero(is_gap)
        ]
        longest = float(steps[is_gap].max(initial=0))
        jitter = float(steps[~is_gap].std() / step)
        summary |= {
            "rate [Hz]": 1 / step,
            "jitter": jitter,
            "gaps": len(gaps),
            "longest gap [s]": longest,
        }
        if gaps:
            warnings.append(f"{len(gaps)} gaps{of_topic}, up to {longest:.3g} s")
        if jitter > JITTER:
            share = f"{jitter:.0%} of the time step"
            warnings.append(f"stamps{of_topic} jitter by {share}: state a rate")
        rows = clock.rows
        time = clock.time
    else:
        summary |= {
            "rate [Hz]": np.nan,
            "jitter": np.nan,
            "gaps": 0,
            "longest gap [s]": 0.0,
        }
        warnings.append(
            f"the time{of_topic} holds a single stamp: values stand over their rows"
        )
        rows = np.arange(len(table))
        time = rows.astype(float)
    summary |= {
        "missing stamps": clock.missing,
        "repeated stamps": clock.repeated,
        "backward stamps": clock.backwards,
    }
    columns = [name for name in table if name != time_name]
    if mapping is not None:
        signals = [signal for signal in mapping.signals if signal.topic == topic]
        mapped = {column for signal in signals for column in signal.columns}
        columns = [name for name in columns if name in mapped]
    numeric = set(table.select_dtypes("number"))
    titles = {
        name: f"{topic}.{name}" if topic else str(name)
        for name in columns
        if name in numeric
    }
    values = table[list(titles)].to_numpy(float)[rows]
    stride = max(len(values) // DRAWN, 1)
    return _Stream(
        summary=summary,
        channels={
            title: _channel(column)
            for title, column in zip(titles.values(), values.T, strict=True)
        },
        lines={
            title: (time[::stride], column[::stride])
            for title, column in zip(titles.values(), values.T, strict=True)
        },
        delays=_delays(list(titles.values()), values),
        gaps=gaps,
        warnings=warnings,
        text_columns=[
            f"{topic}.{name}" if topic else str(name)
            for name in columns
            if name not in numeric
        ],
    )


def _time_column(
    path: str | Path, table: pd.DataFrame, mapping: LogMapping | None
) -> str:
    """Finds the column of the time; ``DataError`` where there is none."""
    if mapping is not None and mapping.time:
        candidates = [mapping.time]
        expected = repr(mapping.time)
    else:
        candidates = list(TIMES)
        expected = "of the time, such as " + ", ".join(TIMES)
    for name in candidates:
        if name in table:
            return name
    columns = ", ".join(map(str, table.columns[:12]))
    raise DataError(f"{path}: no column {expected}; there are {columns}")


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


def _clock_warnings(clock: _Clock, of_topic: str) -> list[str]:
    counts = {
        "missing stamps": clock.missing,
        "repeated stamps": clock.repeated,
        "backward stamps": clock.backwards,
    }
    return [f"{count} {kind}{of_topic}" for kind, count in counts.items() if count]


def _channel(values: Array) -> dict[str, float]:
    """The numbers of one channel (K,); NaN where no row tells."""
    finite = values[np.isfinite(values)]
    numbers = dict.fromkeys(
        [
            "lowest",
            "highest",
            "std",
            "white noise",
            "missing",
            "repeated",
            "longest [rows]",
            "smoothness",
        ],
        np.nan,
    )
    numbers["missing"] = 1 - len(finite) / len(values) if len(values) else 1.0
    if not len(finite):
        return numbers
    numbers["lowest"] = float(finite.min())
    numbers["highest"] = float(finite.max())
    repeats = np.diff(finite) == 0
    changes = np.flatnonzero(np.concatenate([[True], ~repeats, [True]]))
    numbers["repeated"] = float(repeats.mean()) if len(repeats) else 0.0
    numbers["longest [rows]"] = int(np.diff(changes).max())
    # Values of 1e200 have no square: what they spread by is computed in their units.
    scale = max(float(np.abs(finite).max()), np.finfo(float).tiny)
    scaled = finite / scale
    numbers["std"] = float(scaled.std()) * scale
    curvature = np.diff(scaled, 2)
    if not len(curvature):
        return numbers
    # The median is deaf to manoeuvres; 1.4826 makes it the standard deviation of a
    # normal distribution.
    deviation = float(np.median(np.abs(curvature - np.median(curvature))))
    numbers["white noise"] = 1.4826 * deviation / float(np.sqrt(6)) * scale
    power = float(curvature @ curvature)
    if power > 0:
        numbers["smoothness"] = float(curvature[1:] @ curvature[:-1]) / power
    return numbers


def _channel_table(channels: Mapping[str, dict[str, float]]) -> pd.DataFrame:
    """A row a channel, by name."""
    table = pd.DataFrame.from_dict(dict(channels), orient="index")
    return table.rename_axis("channel")


def _channel_warnings(channels: Mapping[str, dict[str, float]]) -> list[str]:
    """What to beware of in the channels, in words; one line where many share it."""
    by_kind: dict[str, list[_Remark]] = {}
    for name, numbers in channels.items():
        for remark in _remarks(name, numbers):
            by_kind.setdefault(remark.kind, []).append(remark)
    return [line for remarks in by_kind.values() for line in _said_once(remarks)]


def _remarks(name: str, channel: Mapping[str, float]) -> list[_Remark]:
    """What to beware of in one channel."""
    remarks = []
    if channel["lowest"] == channel["highest"]:
        remarks.append(_Remark(name, "never changes", "never changes"))
    elif channel["repeated"] > 0.5:
        rows = 1 / max(1 - channel["repeated"], 1e-9)
        text = f"a new value every {rows:.1f} rows"
        remarks.append(_Remark(name, text, "a new value every few rows only"))
    elif channel["smoothness"] > 0.3:
        text = "smoothed: its errors hang together over rows"
        remarks.append(_Remark(name, text, text))
    if channel["missing"] == 1:
        remarks.append(_Remark(name, "holds no value", "holds no value"))
    elif channel["missing"]:
        text = f"{channel['missing']:.1%} of the values are missing"
        remarks.append(_Remark(name, text, "values are missing"))
    return remarks


def _said_once(remarks: list[_Remark]) -> list[str]:
    """Remarks of one kind: a line each, or one line for many."""
    if len(remarks) <= NAMED:
        return [f"{remark.subject}: {remark.text}" for remark in remarks]
    named = ", ".join(remark.subject for remark in remarks[:NAMED])
    others = len(remarks) - NAMED
    channels = "channel" if others == 1 else "channels"
    return [f"{named} and {others} more {channels}: {remarks[0].kind}"]


def _text_warning(names: list[str]) -> list[str]:
    if not names:
        return []
    listed = ", ".join(names[:NAMED]) + ", ..." * (len(names) > NAMED)
    return [f"{len(names)} columns hold no numbers: {listed}"]


def _delay_warnings(delays: list[tuple[Any, ...]]) -> list[str]:
    warnings = []
    for first, second, rows, low, high, agreement, _ in delays:
        if abs(rows) >= 1 or high - low > 2:
            agree = f"{low:g} to {high:g}; {agreement:.0%} of the blocks agree"
            warnings.append(f"{second} comes {rows:g} rows after {first} ({agree})")
    return warnings


def _dependence_warnings(follows: Mapping[str, float]) -> list[str]:
    return [
        f"{name} follows the states ({share:.0%} of its variance): its own effect "
        "cannot be learned"
        for name, share in follows.items()
        if share > FOLLOWS
    ]


def _delays(names: list[str], values: Array) -> list[tuple[Any, ...]]:
    """Rows of ``_DELAYS`` for all pairs whose differences are correlated, from blocks spread over the rows."""
    length = min(BLOCK, len(values) // 8)
    if length < 4 * REACH:
        return []
    finite = np.isfinite(values)
    largest = np.abs(np.where(finite, values, 0.0)).max(axis=0)
    # Correlations have no unit; of values such as 1e200 the squares would overflow.
    values = np.where(finite, values, np.nan) / np.where(largest > 0, largest, 1.0)
    starts = np.unique(np.linspace(0, len(values) - length, BLOCKS).astype(int))
    steps = np.nan_to_num(
        np.diff([values[a : a + length] for a in starts], axis=1)
    )  # (b, rows, c)
    steps = steps - steps.mean(axis=1, keepdims=True)
    norms = np.linalg.norm(steps, axis=1)
    usable = np.flatnonzero((norms > 0).all(axis=0))
    size = 1 << int(np.ceil(np.log2(steps.shape[1] + REACH)))
    spectra = np.fft.rfft(steps[:, :, usable] / norms[:, None, usable], size, axis=1)
    found = []
    for i in range(len(usable)):
        cross = np.fft.irfft(
            spectra[:, :, i + 1 :] * np.conj(spectra[:, :, i : i + 1]), size, axis=1
        )
        cross = np.concatenate(
            [cross[:, -REACH:], cross[:, : REACH + 1]], axis=1
        )  # lags -REACH .. REACH
        peak = np.abs(cross).argmax(axis=1)  # (b, others)
        height = np.take_along_axis(cross, peak[:, None], axis=1)[:, 0]
        for j in range(peak.shape[1]):
            correlation = float(np.median(height[:, j]))
            middle = int(np.clip(np.median(peak[:, j]), SHARP, 2 * REACH - SHARP))
            around = np.median(
                np.abs(cross[:, [middle - SHARP, middle + SHARP], j]), axis=0
            )
            # A slow oscillation is correlated with any other at some delay; a delay has a sharp peak.
            if abs(correlation) >= CORRELATED and around.max() < 0.8 * abs(correlation):
                lags = peak[:, j] - REACH
                delay = float(np.median(lags))
                agreement = float((np.abs(lags - np.median(lags)) <= 1).mean())
                pair = names[usable[i]], names[usable[i + 1 + j]]
                found.append(
                    (
                        *pair,
                        delay,
                        float(lags.min()),
                        float(lags.max()),
                        agreement,
                        correlation,
                    )
                )
    return found


def _dependence(log: Log) -> dict[str, float]:
    """Share of each input's variance that the states and their products with themselves explain."""
    x = np.concatenate([run.states for run in log])
    u = np.concatenate([run.inputs for run in log])
    z = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-12)
    z = np.column_stack([np.ones(len(z)), z, z**2])
    left = u - z @ np.linalg.lstsq(z, u, rcond=1e-8)[0]
    spread = u.var(axis=0)
    return {
        n: 1 - float(v / s)
        for n, v, s in zip(log.input_names, left.var(axis=0), spread, strict=True)
        if s > 0
    }
