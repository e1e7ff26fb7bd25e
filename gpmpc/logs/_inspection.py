"""Looks at a log before anything is learned from it: what can be learned, and what its rows hide.

For each stream: rate, jitter, gaps, stamps that repeat or run backwards. For each channel: missing and repeated values,
the floor of white noise (second differences; their variance is six times that of the noise), and smoothing (second
differences of white noise have a correlation of -2/3 with the ones before, those of a smoothed signal a positive one).
For pairs of channels: the delay, block by block, so that clocks that wander are seen. With a mapping, for each input:
the share of its variance that the states explain linearly; what only follows the states teaches nothing of its own.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from gpmpc.exceptions import DataError
from gpmpc.logs._kinematics import Array
from gpmpc.logs._log import Log
from gpmpc.logs._mapping import TIME_UNITS, LogMapping
from gpmpc.logs._readers import STAMP, read_streams
from gpmpc.logs._reading import ordered_stamps, read_log

TIMES = (STAMP, "t", "time", "stamp", "Time", "seconds")  # columns that hold the time where nobody says which
DRAWN = 3000  # points of a channel's line
BLOCKS, BLOCK, REACH = 16, 4096, 50  # rows in which delays are sought, and how far
SHARP = 10  # rows within which a peak falls by a fifth
CORRELATED = 0.5  # from which a delay says something
PAIRS = 20  # most delays that are listed
FOLLOWS = 0.95  # share of an input's variance that the states explain


@dataclass(frozen=True)
class Channel:
    """One channel: its numbers, and a line to draw."""

    name: str  #: with its topic
    time: Array  #: [s] (P,)
    values: Array  #: (P,)
    missing: float  #: share of the rows without a value
    repeated: float  #: share of the rows whose value is that of the row before
    longest: int  #: rows of the longest stretch of one value
    low: float  #: smallest value
    high: float  #: largest value
    std: float  #: standard deviation
    noise: float  #: standard deviation of white noise that the second differences hold
    smoothness: float  #: correlation of neighbouring second differences

    @property
    def remark(self) -> str:
        """What to beware of, in words."""
        remark = ""
        if self.std == 0:
            remark = "never changes"
        elif self.repeated > 0.5:
            remark = f"a new value every {1 / max(1 - self.repeated, 1e-9):.1f} rows"
        elif self.smoothness > 0.3:
            remark = "smoothed: its errors hang together over rows"
        missing = f"{self.missing:.1%} missing" if self.missing else ""
        return ", ".join(filter(None, (remark, missing)))


@dataclass(frozen=True)
class Delay:
    """How many rows one channel comes after another."""

    first: str  #: name of the channel that comes first where ``rows`` is positive
    second: str  #: name of the other
    rows: float  #: median over the blocks
    range: tuple[float, float]  #: lowest and highest of the blocks
    agreement: float  #: share of the blocks within a row of the median
    correlation: float  #: median, of the channels' differences


@dataclass(frozen=True)
class Inspection:
    """What is in a log file."""

    title: str  #: the file and its size in words
    #: name, rows, rate [Hz], jitter (standard deviation over the time step), gaps, longest gap [s], repeated and
    #: backward stamps of each
    streams: tuple[tuple[str, int, float, float, int, float, int, int], ...]
    channels: tuple[Channel, ...]  #: of all streams
    gaps: tuple[tuple[float, float], ...]  #: begin and end [s] of each, of all streams
    delays: tuple[Delay, ...]  #: the strongest pairs first
    follows: dict[str, float]  #: share of the variance that the states explain, by input; only with a mapping

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to beware of, in words."""
        found = []
        for name, _, _, jitter, gaps, longest, repeated, backwards in self.streams:
            where = f" of {name}" if name else ""
            found += [f"{gaps} gaps{where}, up to {longest:.3g} s"] if gaps else []
            found += [f"{repeated} stamps{where} repeat"] if repeated else []
            found += [f"{backwards} stamps{where} run backwards"] if backwards else []
            found += [f"stamps{where} jitter by {jitter:.0%} of the time step: state a rate"] if jitter > 0.1 else []
        found += [f"{channel.name}: {channel.remark}" for channel in self.channels if channel.remark]
        for delay in self.delays:
            low, high = delay.range
            if abs(delay.rows) >= 1 or high - low > 2:
                agree = f"{low:g} to {high:g}; {delay.agreement:.0%} of the blocks agree"
                found.append(f"{delay.second} comes {delay.rows:g} rows after {delay.first} ({agree})")
        found += [
            f"{name} follows the states ({share:.0%} of its variance): its own effect cannot be learned"
            for name, share in self.follows.items()
            if share > FOLLOWS
        ]
        return tuple(found)


def inspect_log(path: str | Path, mapping: LogMapping | None = None) -> Inspection:
    """Inspects a log file.

    Args:
        path: In a format of ``read_log``.
        mapping: Says which columns matter, which is the time, and what are states and inputs; all numbers by default.

    Raises:
        DataError: The file cannot be read, or no column holds the time.
    """
    topics = {signal.topic for signal in mapping.signals} if mapping else ()
    streams = read_streams(path, topics)
    channels, gaps, delays, tables, rows = [], [], [], [], 0
    for topic, table in streams.items():
        time_name, time = _time(path, table, mapping)
        stamps = ordered_stamps(time, f"{path}{f', {topic}' if topic else ''}")
        steps = np.diff(stamps.time)
        if not len(steps):
            continue
        step = float(np.median(steps))
        wide = np.flatnonzero(steps > 1.5 * step)
        gaps += [(float(stamps.time[i]), float(stamps.time[i + 1])) for i in wide]
        longest = float(steps[wide].max(initial=0))
        jitter = float(steps[steps <= 1.5 * step].std() / step)
        tables.append((topic, len(table), 1 / step, jitter, len(wide), longest, stamps.repeated, stamps.backwards))
        wanted = {c for s in mapping.signals if s.topic == topic for c in s.columns} if mapping else None
        names = [c for c in table.select_dtypes("number").columns if c != time_name and (wanted is None or c in wanted)]
        titles, values = [f"{topic}.{n}" if topic else str(n) for n in names], table[names].to_numpy(float)[stamps.rows]
        channels += [_channel(name, stamps.time, column) for name, column in zip(titles, values.T, strict=True)]
        delays += _delays(titles, values)
        rows += len(table)
    size = f"{Path(path).name}: {rows} rows, {len(channels)} channels"
    delays = sorted(delays, key=lambda delay: -abs(delay.correlation))[:PAIRS]
    follows = _dependence(read_log(path, mapping)) if mapping else {}
    return Inspection(size, tuple(tables), tuple(channels), tuple(gaps), tuple(delays), follows)


def _time(path: str | Path, table: pd.DataFrame, mapping: LogMapping | None) -> tuple[str, Array]:
    names = [mapping.time] if mapping and mapping.time else [name for name in TIMES if name in table]
    if not names or names[0] not in table:
        wanted = repr(names[0]) if names else "of the time, such as " + ", ".join(TIMES)
        raise DataError(f"{path}: no column {wanted}; there are {', '.join(map(str, table.columns[:12]))}")
    return names[0], table[names[0]].to_numpy(float) * (TIME_UNITS[mapping.time_unit] if mapping else 1.0)


def _channel(name: str, time: Array, values: Array) -> Channel:
    known = values[np.isfinite(values)]
    stride = max(len(values) // DRAWN, 1)
    line, missing = (time[::stride], values[::stride]), 1 - len(known) / len(values)
    if not len(known):
        return Channel(name, *line, missing, 0.0, 0, np.nan, np.nan, 0.0, 0.0, 0.0)
    same = np.diff(known) == 0
    changes = np.flatnonzero(np.r_[True, ~same, True])
    second = np.diff(known, 2)
    # The median is deaf to manoeuvres; 1.4826 makes it the standard deviation of a normal distribution.
    noise = 1.4826 * float(np.median(np.abs(second - np.median(second)))) / np.sqrt(6) if len(second) else 0.0
    power = float(second @ second)
    smoothness = float(second[1:] @ second[:-1]) / power if power > 0 else 0.0
    repeated, longest = float(same.mean()) if len(same) else 0.0, int(np.diff(changes).max())
    low, high, std = float(known.min()), float(known.max()), float(known.std())
    return Channel(name, *line, missing, repeated, longest, low, high, std, noise, smoothness)


def _delays(names: list[str], values: Array) -> list[Delay]:
    """Delays of all pairs whose differences are correlated, from blocks spread over the rows."""
    length = min(BLOCK, len(values) // 8)
    if length < 4 * REACH:
        return []
    starts = np.unique(np.linspace(0, len(values) - length, BLOCKS).astype(int))
    steps = np.nan_to_num(np.diff([values[a : a + length] for a in starts], axis=1))  # (b, rows, c)
    steps = steps - steps.mean(axis=1, keepdims=True)
    norms = np.linalg.norm(steps, axis=1)
    usable = np.flatnonzero((norms > 0).all(axis=0))
    size = 1 << int(np.ceil(np.log2(steps.shape[1] + REACH)))
    spectra = np.fft.rfft(steps[:, :, usable] / norms[:, None, usable], size, axis=1)
    found = []
    for i in range(len(usable)):
        cross = np.fft.irfft(spectra[:, :, i + 1 :] * np.conj(spectra[:, :, i : i + 1]), size, axis=1)
        cross = np.concatenate([cross[:, -REACH:], cross[:, : REACH + 1]], axis=1)  # lags -REACH .. REACH
        peak = np.abs(cross).argmax(axis=1)  # (b, others)
        height = np.take_along_axis(cross, peak[:, None], axis=1)[:, 0]
        for j in range(peak.shape[1]):
            correlation = float(np.median(height[:, j]))
            middle = int(np.clip(np.median(peak[:, j]), SHARP, 2 * REACH - SHARP))
            around = np.median(np.abs(cross[:, [middle - SHARP, middle + SHARP], j]), axis=0)
            # A slow oscillation is correlated with any other at some delay; a delay has a sharp peak.
            if abs(correlation) >= CORRELATED and around.max() < 0.8 * abs(correlation):
                lags = peak[:, j] - REACH
                delay, reach = float(np.median(lags)), (float(lags.min()), float(lags.max()))
                agreement = float((np.abs(lags - delay) <= 1).mean())
                found.append(Delay(names[usable[i]], names[usable[i + 1 + j]], delay, reach, agreement, correlation))
    return found


def _dependence(log: Log) -> dict[str, float]:
    """Share of each input's variance that the states and their products with themselves explain."""
    x = np.concatenate([run.states for run in log])
    u = np.concatenate([run.inputs for run in log])
    z = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-12)
    z = np.column_stack([np.ones(len(z)), z, z**2])
    left = u - z @ np.linalg.lstsq(z, u, rcond=1e-8)[0]
    spread = u.var(axis=0)
    return {n: 1 - float(v / s) for n, v, s in zip(log.input_names, left.var(axis=0), spread, strict=True) if s > 0}
