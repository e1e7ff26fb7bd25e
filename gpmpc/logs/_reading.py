"""Makes runs of tables: applies a mapping, resamples, and finds gaps, repeated samples and parts at rest."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.ndimage import binary_dilation, maximum_filter1d, minimum_filter1d

from gpmpc.exceptions import DataError
from gpmpc.logs._kinematics import (
    Array,
    quaternion_from_euler,
    quaternion_inverse,
    quaternion_product,
    rotate,
    rotation_quaternion,
    rotation_vector,
)
from gpmpc.logs._log import Findings, Log, LogRun, check_plausible
from gpmpc.logs._mapping import ROLES, TIME_UNITS, UNITS, LogMapping, Signal
from gpmpc.logs._readers import STAMP, Streams, read_streams

REST_TIME = 0.5  # [s] for which nothing moves at rest
REST_SHARE = 0.1  # of a state's usual spread that counts as no movement
MOST_HELD = 0.5  # of the rows; beyond, a signal has another rate than its table
MOST_OUT_OF_ORDER = 0.05  # of the rows; beyond, the file does not hold one run in the order of time
RESOLUTION = 1e-6  # [s] of stamps: float64 seconds since 1970 resolve a quarter of it


class _Table(NamedTuple):
    """The rows of one run on one grid; NaN where a value is missing."""

    name: str
    time: Array
    values: dict[str, Array]  # by role, (K, c)
    outside: np.ndarray  # (K,) rows that the mapping leaves out
    breaks: np.ndarray  # (K,) rows before which time ran backwards


def read_log(
    files: str | Path | Sequence[str | Path],
    mapping: LogMapping | Mapping[str, Any] | str | Path,
    partial: bool = False,
) -> Log:
    """Reads the runs of one file or several.

    Args:
        files: Each ends in .csv, .csv.gz, .tsv, .parquet, .npz, .mcap (of this package or of ROS 2) or .ulg.
        mapping: What the columns mean: a YAML file, plain data or a ``LogMapping``.
        partial: Takes what is whole of unfinished recordings.

    Raises:
        DataError: A file, topic or column is missing or cannot be used; the text says where and why.
        SettingError: The mapping is wrong.
    """
    if not isinstance(mapping, LogMapping):
        mapping = LogMapping.load(mapping) if isinstance(mapping, str | Path) else LogMapping.from_dict(mapping)
    files = [files] if isinstance(files, str | Path) else list(files)
    if not files:
        raise DataError("no log file was given")
    findings, tables = Findings(), []
    for file in map(Path, files):
        streams = read_streams(file, {signal.topic for signal in mapping.signals}, partial)
        name = file.name.removesuffix(".gz").rsplit(".", 1)[0]
        for run, parts in _split_runs(file, name, streams, mapping):
            tables.append(_tabulate(file, run, parts, mapping, findings))
    names = [table.name for table in tables]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DataError(f"run {twice!r} comes from two files: give the files different names")
    step = 1 / mapping.rate if mapping.rate else float(np.median(np.concatenate([np.diff(t.time) for t in tables])))
    spread = _spread(tables)
    runs = [_make_run(table, step, spread, mapping, findings) for table in tables]
    usable = tuple(run for run in runs if run is not None)
    if not usable:
        said = "; ".join(f"{f.run}: {f.text}" for f in findings[-3:])
        raise DataError(f"{files[0]}{' and others' * (len(files) > 1)}: no row can be used ({said})")
    check_plausible(usable, step, mapping)
    if mapping.model == "rigid_body":
        usable = tuple(_in_one_frame(run, mapping) for run in usable)
    return Log(mapping, step, usable, tuple(findings))


def _in_one_frame(run: LogRun, mapping: LogMapping) -> LogRun:
    """Turns a rigid body's velocity to world axes and its rate to body axes."""
    _, _, velocity, rate = mapping.of("states")
    states, q = run.states.copy(), run.states[:, 3:7]
    if velocity.frame == "body":
        states[:, 7:10] = rotate(q, states[:, 7:10])
    if rate.frame == "world":
        states[:, 10:13] = rotate(quaternion_inverse(q), states[:, 10:13])
    return replace(run, states=states)


def _split_runs(file: Path, name: str, streams: Streams, mapping: LogMapping) -> list[tuple[str, Streams]]:
    if not mapping.run:
        return [(name, streams)]
    table = streams.get("")
    if table is None or mapping.run not in table:
        raise DataError(f"{file}: column {mapping.run!r} of the runs is missing")
    return [(f"{name}:{run}", {"": part}) for run, part in table.groupby(mapping.run, sort=False)]


def _tabulate(file: Path, name: str, streams: Streams, mapping: LogMapping, findings: Findings) -> _Table:
    """Puts the signals of a run on one grid of times, in the units and conventions of ``gpmpc.logs``."""
    stamps, tables = {}, {}
    for topic in dict.fromkeys(signal.topic for signal in mapping.signals):
        table = streams[topic]
        label = f"{file}{f', {topic}' if topic else ''}{f', run {name}' if mapping.run else ''}"
        stamps[topic] = found = ordered_stamps(_time(label, table, mapping), label)
        tables[topic] = table.iloc[found.rows]
        for kind, count in (("repeated stamp", found.repeated), ("stamp runs backwards", found.backwards)):
            findings.note(kind, name, count, f"{count} rows{f' of {topic}' if topic else ''}: left out")
    samples = {s.role + s.name: _values(file, tables[s.topic], s, name, findings) for s in mapping.signals}
    outside = {topic: _outside(file, table, mapping) for topic, table in tables.items()}
    if mapping.rate is None:
        ((grid, breaks),) = ((found.time, found.after_reversal) for found in stamps.values())
    else:
        begin = max(found.time[0] for found in stamps.values())
        end = min(found.time[-1] for found in stamps.values())
        if not end > begin:
            raise DataError(f"{file}: the topics {', '.join(stamps)} have no time in common")
        grid = begin + np.arange(int(np.floor((end - begin) * mapping.rate * (1 + 1e-12))) + 1) / mapping.rate
        breaks = np.zeros(len(grid), dtype=bool)

    def on_grid(topic: str, values: Array, rule: str, max_gap: float | None) -> Array:
        if mapping.rate is None:
            return values
        time = stamps[topic].time
        usual = max(float(np.median(np.diff(time))), 1 / mapping.rate)
        return resample(time, values, grid, rule, max_gap or 1.5 * usual)

    values: dict[str, Array] = {}
    for role in ROLES:
        parts = [on_grid(s.topic, samples[s.role + s.name], s.rule, mapping.max_gap) for s in mapping.of(role)]
        values[role] = np.concatenate([np.empty((len(grid), 0)), *parts], axis=1)
    left_out = np.zeros(len(grid), dtype=bool)
    for topic, rows in outside.items():
        left_out |= on_grid(topic, rows[:, None].astype(float), "hold", np.inf)[:, 0] > 0
    return _Table(name, grid, values, left_out, breaks)


def _time(label: str, table: pd.DataFrame, mapping: LogMapping) -> Array:
    column = mapping.time or STAMP
    if column not in table:
        if not mapping.time and mapping.rate:  # rows without stamps, at a rate that is declared
            return np.arange(len(table)) / mapping.rate
        raise DataError(f"{label}: column {column!r} of the time is missing; there are {_some(table)}")
    scale = TIME_UNITS[mapping.time_unit] if mapping.time else 1.0
    return _numbers(label, table, column) * scale


def _some(table: pd.DataFrame) -> str:
    names = [str(name) for name in table.columns]
    return ", ".join(names[:12]) + (f" and {len(names) - 12} others" if len(names) > 12 else "")


def _numbers(label: str, table: pd.DataFrame, column: str) -> Array:
    values = table[column]
    numbers = pd.to_numeric(values, errors="coerce").to_numpy(dtype=float)
    wrong = np.isnan(numbers) & ~values.isna().to_numpy()
    if wrong.any():
        row = int(np.argmax(wrong))
        raise DataError(f"{label}: row {row + 1}, column {column!r} is {values.iloc[row]!r}; expected a number")
    return numbers


def _values(file: Path, table: pd.DataFrame, signal: Signal, run: str, findings: Findings) -> Array:
    """A signal (K, c) in the units and conventions of ``gpmpc.logs``; NaN where it is missing."""
    missing = [column for column in signal.columns if column not in table]
    if missing:
        where = f" of {signal.topic}" if signal.topic else ""
        raise DataError(f"{file}: column {missing[0]!r}{where} is missing; there are {_some(table)}")
    values = np.column_stack([_numbers(str(file), table, column) for column in signal.columns]) * signal.scale
    values[~np.isfinite(values)] = np.nan
    absent = np.isnan(values).any(axis=1).sum()
    findings.note("missing value", run, absent, f"{absent} rows of {signal.name} without a value: left out")
    if signal.kind == "quaternion":
        return _quaternions(file, values, signal, run, findings)
    values *= UNITS.get(signal.unit, ("", 1.0))[1]
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    if signal.kind in ("angle", "euler") and signal.unit == "rad" and largest > 4 * np.pi:
        raise DataError(f"{file}: {signal.name} reaches {largest:.4g} rad: are these degrees? (unit: deg)")
    return quaternion_from_euler(values) if signal.kind == "euler" else values


def _quaternions(file: Path, values: Array, signal: Signal, run: str, findings: Findings) -> Array:
    """Unit quaternions (x, y, z, w) whose sign does not flip."""
    if signal.order == "wxyz":
        values = values[:, [1, 2, 3, 0]]
    norms = np.linalg.norm(values, axis=1)
    off = np.abs(norms - 1) > 0.05
    if off.any():
        row = int(np.argmax(off))
        raise DataError(f"{file}: {signal.name} in row {row + 1} has norm {norms[row]:.4g}; expected unit quaternions")
    values = values / norms[:, None]
    present = np.flatnonzero(np.isfinite(norms))
    flips = np.einsum("ij,ij->i", values[present[1:]], values[present[:-1]]) < 0
    findings.note("quaternion flips its sign", run, flips.sum(), f"{flips.sum()} times: turned back")
    values[present[1:]] *= np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
    return values


def _outside(file: Path, table: pd.DataFrame, mapping: LogMapping) -> np.ndarray:
    outside = np.zeros(len(table), dtype=bool)
    for column, (low, high) in mapping.keep.items():
        if column in table:
            values = _numbers(str(file), table, column)
            outside |= ~((values >= low) & (values <= high))
        elif not any(signal.topic for signal in mapping.signals):
            raise DataError(f"{file}: column {column!r} of keep is missing; there are {_some(table)}")
    return outside


def _spread(tables: Sequence[_Table]) -> Array:
    """Usual spread of each state (n,) over all runs: half of the range of 80 % of the rows."""
    states = np.concatenate([table.values["states"] for table in tables])
    present = states[np.isfinite(states).all(axis=1)]
    if not len(present):
        raise DataError("no row has a value of every state")
    low, high = np.quantile(present, [0.1, 0.9], axis=0)
    return (high - low) / 2


def _make_run(table: _Table, step: float, spread: Array, mapping: LogMapping, findings: Findings) -> LogRun | None:
    """Leaves out what cannot be used, and marks where a new piece begins; None where nothing is left."""
    states, inputs, context = (table.values[role] for role in ROLES)
    usable = np.ones(len(table.time), dtype=bool)

    def leave_out(rows: np.ndarray, kind: str, text: str) -> None:
        count = (rows & usable).sum()
        findings.note(kind, table.name, count, f"{count} of {len(rows)} rows {text}: left out")
        usable[rows] = False

    leave_out(table.outside, "outside of keep", "outside the ranges of keep")
    if mapping.rest == "drop":
        leave_out(_at_rest(states, inputs, spread, step), "at rest", "where nothing moves")
    absent = np.asarray(np.isnan(np.concatenate([states, inputs, context], axis=1)).any(axis=1))
    leave_out(absent, "missing value", "in a gap or without a value")
    if mapping.held == "drop":
        for signal, at in zip(mapping.of("states"), mapping.space.columns, strict=True):
            if len(signal.columns) < 2:  # a single one may repeat by its resolution
                continue
            same = np.r_[False, (states[1:, at] == states[:-1, at]).all(axis=1)] & usable
            if same.sum() > MOST_HELD * max(usable.sum(), 1):
                raise DataError(
                    f"run {table.name}: {signal.name} changes in {(usable & ~same).sum()} of {usable.sum()} rows only: "
                    "its own rate is lower; state a lower rate, or held: use"
                )
            leave_out(same, "held value", f"where {signal.name} repeats the row before")
    rows = np.flatnonzero(usable)
    if len(rows) < 2:
        findings.note("nothing left", table.name, len(table.time), "no row can be used: the run is left out")
        return None
    times = np.diff(table.time[rows])
    gaps = times > (mapping.max_gap if mapping.max_gap and not mapping.rate else 1.5 * step)
    inner = gaps & (np.diff(rows) == 1)
    longest = float(times[inner].max(initial=0))
    findings.note("gap", table.name, inner.sum(), f"{inner.sum()} gaps, up to {longest:.3g} s: boundaries")
    early = times < 0.5 * step
    text = f"{early.sum()} rows less than half a time step after the row before: boundaries (state a rate)"
    findings.note("jitter", table.name, early.sum(), text)
    breaks = gaps | (np.diff(rows) > 1) | table.breaks[rows[1:]] | early
    begins = (0, *(np.flatnonzero(breaks) + 1).tolist())
    return LogRun(table.name, table.time[rows], states[rows], inputs[rows], context[rows], begins)


def _at_rest(states: Array, inputs: Array, spread: Array, step: float) -> np.ndarray:
    """Rows (K,) of stretches in which the inputs stay and no state moves by more than a tenth of its usual spread."""
    size = max(round(REST_TIME / step), 3)
    if len(states) < size or not inputs.shape[1]:
        return np.zeros(len(states), dtype=bool)
    limit = np.concatenate([REST_SHARE * spread, np.zeros(inputs.shape[1])])
    both = np.nan_to_num(np.concatenate([states, inputs], axis=1))
    moved = maximum_filter1d(both, size, axis=0) - minimum_filter1d(both, size, axis=0)
    still = (moved <= limit).all(axis=1)
    return binary_dilation(still, np.ones(2 * (size // 2) + 1))


class Stamps(NamedTuple):
    """Stamps (K,) [s] that only increase, with what was wrong with them."""

    rows: np.ndarray  # (K,) of the table, those that are used
    time: Array  # (K,) [s]
    after_reversal: np.ndarray  # (K,) whether rows with earlier stamps stood before this one
    repeated: int
    backwards: int


def ordered_stamps(stamps: Array, where: str) -> Stamps:
    """Leaves out rows whose stamp is not the latest; ``DataError`` where it is not finite, or 5 % run backwards."""
    if not np.isfinite(stamps).all():
        row = int(np.argmin(np.isfinite(stamps)))
        raise DataError(f"{where}: the time in row {row + 1} is {stamps[row]}; expected a number")
    latest = np.maximum.accumulate(stamps)
    rises = np.r_[True, stamps[1:] > latest[:-1]]
    repeated = np.r_[False, stamps[1:] == stamps[:-1]] & ~rises
    backwards = ~rises & ~repeated
    if backwards.sum() > MOST_OUT_OF_ORDER * len(stamps):
        row = int(np.argmax(backwards))
        raise DataError(
            f"{where}: time runs backwards in row {row + 1} (from {stamps[row - 1]:g} to {stamps[row]:g} s), and "
            f"{int(backwards.sum())} rows come before the latest stamp: name the column of the runs, or order the rows"
        )
    rows = np.flatnonzero(rises)
    reversed_before = np.diff(np.cumsum(backwards)[rows], prepend=0) > 0
    return Stamps(rows, stamps[rows], reversed_before, int(repeated.sum()), int(backwards.sum()))


def resample(time: Array, values: Array, grid: Array, rule: str, max_gap: float) -> Array:
    """Computes values (G, c) at the times of a grid (G,) [s] from samples (K, c) at increasing times (K,) [s].

    The rule "hold" takes the last sample, "linear" interpolates, "spherical" interpolates quaternions. Values are NaN
    beyond the samples and where two of them are farther apart than ``max_gap`` [s]; samples with a NaN are left out.
    """
    present = np.isfinite(values).all(axis=1)
    time, values = time[present], values[present]
    if not len(time):
        return np.full((len(grid), values.shape[1]), np.nan)
    at = np.searchsorted(time, grid + RESOLUTION, side="right") - 1
    before, after = np.clip(at, 0, None), np.clip(at + 1, None, len(time) - 1)
    lag, span = grid - time[before], time[after] - time[before]
    if rule == "hold":
        usable, found = (at >= 0) & (lag <= max_gap), values[before]
    else:
        share = np.divide(lag, span, out=np.zeros_like(lag), where=span > 0)[:, None]
        one, other = values[before], values[after]
        if rule == "spherical":
            turn = rotation_vector(quaternion_product(quaternion_inverse(one), other))
            found = quaternion_product(one, rotation_quaternion(share * turn))
        else:
            found = one + share * (other - one)
        usable = (at >= 0) & ((lag <= RESOLUTION) | ((at < len(time) - 1) & (span <= max_gap)))
    return np.where(usable[:, None], found, np.nan)
