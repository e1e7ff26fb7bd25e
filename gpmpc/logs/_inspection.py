"""Looks at a log before anything is learned from it: what can be learned, and what its rows hide.

White noise is found by second differences, whose variance is six times that of the noise, and smoothing by their
correlation with the ones before: -2/3 for white noise, positive for a smoothed signal. Delays between channels are
found block by block, so that clocks that wander are seen. An input of which the states explain most of the variance,
linearly, teaches nothing of its own.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from gpmpc.exceptions import DataError
from gpmpc.logs._file import STAMP
from gpmpc.logs._kinematics import Array
from gpmpc.logs._log import Log
from gpmpc.logs._mapping import TIME_UNITS, LogMapping
from gpmpc.logs._readers import read_file
from gpmpc.logs._reading import ordered_stamps, read_log

TIMES = (
    STAMP,
    "timestamp",
    "t",
    "time",
    "stamp",
    "Time",
    "seconds",
)  # columns that hold the time where nobody says which
DRAWN = 3000  # points of a channel's line
BLOCKS, BLOCK, REACH = 16, 4096, 50  # rows in which delays are sought, and how far
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


@dataclass(frozen=True)
class Inspection:
    """What is in a log file; shares lie between 0 and 1."""

    title: str  #: the file and its size in words
    streams: (
        pd.DataFrame
    )  #: a row a stream; its jitter is the standard deviation over the time step
    #: a row a channel, by name; "white noise" is the standard deviation of the one that second differences hold,
    #: "repeated" the share of the rows with the value of the row before, "smoothness" the correlation of neighbouring
    #: second differences
    channels: pd.DataFrame
    #: a row a pair, the strongest first: by how many rows the later channel is late (median, with its range over the
    #: blocks), which share of the blocks agrees to a row, and the correlation of the differences
    delays: pd.DataFrame
    follows: dict[
        str, float
    ]  #: share of the variance that the states explain, by input; only with a mapping
    lines: dict[str, tuple[Array, Array]]  #: time [s] and values to draw, by channel
    gaps: tuple[tuple[float, float], ...]  #: begin and end [s] of each, of all streams
    warnings: tuple[str, ...]  #: what to beware of, in words


def inspect_log(path: str | Path, mapping: LogMapping | None = None) -> Inspection:
    """Inspects a log file.

    Args:
        path: In a format of ``read_log``.
        mapping: Says which columns matter, which is the time, and what are states and inputs; all numbers by default.

    Raises:
        DataError: The file cannot be read, or no column holds the time.
    """
    topics = {signal.topic for signal in mapping.signals} if mapping else ()
    stamp = mapping.stamp if mapping else ""
    file = read_file(path, topics, partial=True, stamp=stamp)
    tables: list[dict[str, Any]] = []
    channels: dict[str, Any] = {}
    lines: dict[str, Any] = {}
    delays, gaps = [], []
    warnings = [f"{finding.kind}: {finding.text}" for finding in file.findings]
    for topic, table in file.streams.items():
        time_name, time = _time(path, table, mapping)
        stamps = ordered_stamps(time, f"{path}{f', {topic}' if topic else ''}")
        steps = np.diff(stamps.time)
        if not len(steps):
            continue
        step, where = float(np.median(steps)), f" of {topic}" if topic else ""
        wide = np.flatnonzero(steps > 1.5 * step)
        gaps += [(float(stamps.time[i]), float(stamps.time[i + 1])) for i in wide]
        longest, jitter = (
            float(steps[wide].max(initial=0)),
            float(steps[steps <= 1.5 * step].std() / step),
        )
        counts = {
            "repeated stamps": stamps.repeated,
            "backward stamps": stamps.backwards,
        }
        row = {
            "stream": topic,
            "rows": len(table),
            "rate [Hz]": 1 / step,
            "jitter": jitter,
            "gaps": len(wide),
        }
        tables.append(row | {"longest gap [s]": longest} | counts)
        warnings += (
            [f"{len(wide)} gaps{where}, up to {longest:.3g} s"] if len(wide) else []
        )
        warnings += [
            f"{count} {what}{where}" for what, count in counts.items() if count
        ]
        warnings += (
            [f"stamps{where} jitter by {jitter:.0%} of the time step: state a rate"]
            if jitter > 0.1
            else []
        )
        wanted = (
            {c for s in mapping.signals if s.topic == topic for c in s.columns}
            if mapping
            else set(table)
        )
        names = [
            c for c in table.select_dtypes("number") if c != time_name and c in wanted
        ]
        values = table[names].to_numpy(float)[stamps.rows]
        titles = [f"{topic}.{name}" if topic else str(name) for name in names]
        channels |= {
            name: _channel(column)
            for name, column in zip(titles, values.T, strict=True)
        }
        stride = max(len(values) // DRAWN, 1)
        lines |= {
            name: (stamps.time[::stride], v[::stride])
            for name, v in zip(titles, values.T, strict=True)
        }
        delays += _delays(titles, values)
    warnings += [
        f"{name}: {remark}"
        for name, numbers in channels.items()
        if (remark := _remark(numbers))
    ]
    delays = sorted(delays, key=lambda delay: -abs(delay[-1]))[:PAIRS]
    for first, second, rows, low, high, agreement, _ in delays:
        if abs(rows) >= 1 or high - low > 2:
            agree = f"{low:g} to {high:g}; {agreement:.0%} of the blocks agree"
            warnings.append(f"{second} comes {rows:g} rows after {first} ({agree})")
    follows = _dependence(read_log(path, mapping, partial=True)) if mapping else {}
    warnings += [
        f"{name} follows the states ({share:.0%} of its variance): its own effect cannot be learned"
        for name, share in follows.items()
        if share > FOLLOWS
    ]
    size = f"{Path(path).name}: {sum(row['rows'] for row in tables)} rows, {len(channels)} channels"
    table = pd.DataFrame.from_dict(channels, orient="index").rename_axis("channel")
    frames = pd.DataFrame(tables), table, pd.DataFrame(delays, columns=_DELAYS)
    return Inspection(size, *frames, follows, lines, tuple(gaps), tuple(warnings))


def _time(
    path: str | Path, table: pd.DataFrame, mapping: LogMapping | None
) -> tuple[str, Array]:
    names = (
        [mapping.time]
        if mapping and mapping.time
        else [name for name in TIMES if name in table]
    )
    if not names or names[0] not in table:
        wanted = repr(names[0]) if names else "of the time, such as " + ", ".join(TIMES)
        raise DataError(
            f"{path}: no column {wanted}; there are {', '.join(map(str, table.columns[:12]))}"
        )
    return names[0], table[names[0]].to_numpy(float) * (
        TIME_UNITS[mapping.time_unit] if mapping else 1.0
    )


def _channel(values: Array) -> dict[str, float]:
    known = values[np.isfinite(values)]
    low, high, std = (
        float(f(known)) if len(known) else np.nan for f in (np.min, np.max, np.std)
    )
    same, second = np.diff(known) == 0, np.diff(known, 2)
    # The median is deaf to manoeuvres; 1.4826 makes it the standard deviation of a normal distribution.
    noise = (
        1.4826 * float(np.median(np.abs(second - np.median(second)))) / np.sqrt(6)
        if len(second)
        else 0.0
    )
    power = float(second @ second)
    return {
        "lowest": low,
        "highest": high,
        "std": std,
        "white noise": noise,
        "missing": 1 - len(known) / len(values),
        "repeated": float(same.mean()) if len(same) else 0.0,
        "longest [rows]": int(np.diff(np.flatnonzero(np.r_[True, ~same, True])).max()),
        "smoothness": float(second[1:] @ second[:-1]) / power if power > 0 else 0.0,
    }


def _remark(channel: dict[str, float]) -> str:
    """What to beware of, in words."""
    remarks = [f"{channel['missing']:.1%} missing"] if channel["missing"] else []
    if channel["std"] == 0:
        remarks.insert(0, "never changes")
    elif channel["repeated"] > 0.5:
        remarks.insert(
            0, f"a new value every {1 / max(1 - channel['repeated'], 1e-9):.1f} rows"
        )
    elif channel["smoothness"] > 0.3:
        remarks.insert(0, "smoothed: its errors hang together over rows")
    return ", ".join(remarks)


def _delays(names: list[str], values: Array) -> list[tuple[Any, ...]]:
    """Rows of ``_DELAYS`` for all pairs whose differences are correlated, from blocks spread over the rows."""
    length = min(BLOCK, len(values) // 8)
    if length < 4 * REACH:
        return []
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
                delay, agreement = (
                    float(np.median(lags)),
                    float((np.abs(lags - np.median(lags)) <= 1).mean()),
                )
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
