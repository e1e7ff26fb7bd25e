"""Makes runs of tables: applies a mapping, resamples, and leaves out what is no measurement of a moving system.

What is wrong with a file is found, counted and named.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.ndimage import binary_dilation, maximum_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation

from gpmpc.exceptions import DataError
from gpmpc.logs._conventions import read_rigid_bodies
from gpmpc.logs._frames import with_frame_of_files
from gpmpc.logs._kinematics import (
    Array,
    quaternion_inverse,
    quaternion_product,
    rotation_quaternion,
    rotation_vector,
)
from gpmpc.logs._log import Finding, Log, LogRun
from gpmpc.logs._mapping import TIME_UNITS, LogMapping, Signal
from gpmpc.logs._readers import STAMP, Streams, read_streams

REST_TIME = 0.5  # [s] for which nothing moves at rest
REST_SHARE = 0.1  # of a state's usual spread that counts as no movement
MOST_HELD = 0.5  # of the rows; beyond, a signal has another rate than its table
MOST_OUT_OF_ORDER = (
    0.05  # of the rows; beyond, the file does not hold one run in the order of time
)
RESOLUTION = 1e-6  # [s] of stamps: float64 seconds since 1970 resolve a quarter of it
_Note = Callable[
    [str, Any, str], None
]  # takes the kind, the count and the text of a finding


class _Table(NamedTuple):
    """The rows of one run on one grid; NaN where a value is missing."""

    name: str
    time: Array
    values: Array  # states, inputs and context (K, n + m + c)
    outside: np.ndarray  # (K,) rows that the mapping leaves out
    breaks: np.ndarray  # (K,) rows before which time ran backwards
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
        partial: Takes what is whole of unfinished recordings.

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
    for file in map(Path, files):
        streams = read_streams(
            file, {signal.topic for signal in mapping.signals}, partial
        )
        runs = [(file.name.removesuffix(".gz").rsplit(".", 1)[0], streams)]
        if mapping.run:
            table = streams.get("", pd.DataFrame())
            _check_column(str(file), table, mapping.run)
            runs = [
                (f"{runs[0][0]}:{run}", {"": part})
                for run, part in table.groupby(mapping.run, sort=False)
            ]
        for name, parts in runs:
            if name in {table.name for table in tables}:
                raise DataError(
                    f"run {name!r} comes from two files: give the files different names"
                )

            def note(kind: str, count: Any, text: str, name: str = name) -> None:
                if count:
                    findings.append(Finding(kind, name, int(count), text))

            tables.append(
                _tabulate(
                    f"{file}, run {name}" if mapping.run else str(file),
                    name,
                    parts,
                    mapping,
                    note,
                )
            )
    if not tables:
        raise DataError("no log file was given")
    step = (
        1 / mapping.rate
        if mapping.rate
        else float(np.median(np.concatenate([np.diff(t.time) for t in tables])))
    )
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


def _tabulate(
    where: str, name: str, streams: Streams, mapping: LogMapping, note: _Note
) -> _Table:
    """Puts the signals of a run on one grid of times, in the units and conventions of ``gpmpc.logs``."""
    stamps, tables = {}, {}
    labels = {
        signal.topic: f"{where}, {signal.topic}" if signal.topic else where
        for signal in mapping.signals
    }
    for topic, label in labels.items():
        stamps[topic] = found = ordered_stamps(
            _time(label, streams[topic], mapping), label
        )
        tables[topic], of_topic = (
            streams[topic].iloc[found.rows],
            f" of {topic}" if topic else "",
        )
        note(
            "repeated stamp",
            found.repeated,
            f"{found.repeated} rows{of_topic}: left out",
        )
        note(
            "stamp runs backwards",
            found.backwards,
            f"{found.backwards} rows{of_topic}: left out",
        )
    if mapping.rate is None:
        ((grid, breaks),) = (
            (found.time, found.after_reversal) for found in stamps.values()
        )
    else:
        begin = max(found.time[0] for found in stamps.values())
        end = min(found.time[-1] for found in stamps.values())
        if not end > begin:
            raise DataError(
                f"{where}: the topics {', '.join(stamps)} have no time in common"
            )
        grid = (
            begin
            + np.arange(int(np.floor((end - begin) * mapping.rate * (1 + 1e-12))) + 1)
            / mapping.rate
        )
        breaks = np.zeros(len(grid), dtype=bool)

    def on_grid(
        topic: str,
        values: Array,
        rule: str,
        max_gap: float | None,
        delay: float = 0.0,
    ) -> Array:
        if mapping.rate is None and delay == 0:
            return values
        time = stamps[topic].time
        usual = float(np.median(np.diff(time)))
        if mapping.rate is not None:
            usual = max(usual, 1 / mapping.rate)
        return resample(time, values, grid + delay, rule, max_gap or 1.5 * usual)

    parts = []
    for s in mapping.signals:
        parts.append(
            on_grid(
                s.topic,
                _values(labels[s.topic], tables[s.topic], s, note),
                s.rule,
                mapping.max_gap,
                s.delay,
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


def _time(label: str, table: pd.DataFrame, mapping: LogMapping) -> Array:
    if (
        not mapping.time and STAMP not in table and mapping.rate
    ):  # rows without stamps, at a rate that is declared
        return np.arange(len(table)) / mapping.rate
    return _numbers(label, table, mapping.time or STAMP) * (
        TIME_UNITS[mapping.time_unit] if mapping.time else 1.0
    )


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
    values = (
        np.column_stack([_numbers(label, table, column) for column in signal.columns])
        * signal.factors
    )
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
    usable, note = np.ones(len(table.time), dtype=bool), table.note

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
        if same.sum() > MOST_HELD * max(usable.sum(), 1):
            raise DataError(
                f"run {table.name}: {signal.name} changes in {(usable & ~same).sum()} of {usable.sum()} rows only: "
                "its own rate is lower; state a lower rate, or held: use"
            )
        leave_out(same, "held value", f"where {signal.name} repeats the row before")
    rows = np.flatnonzero(usable)
    if len(rows) < 2:
        note("nothing left", len(table.time), "no row can be used: the run is left out")
        return None
    times = np.diff(table.time[rows])
    uneven = (
        times
        > (mapping.max_gap if mapping.max_gap and not mapping.rate else 1.5 * step)
    ) | (times < 0.5 * step)
    inner = times[uneven & (np.diff(rows) == 1)]
    if len(inner):
        shortest, longest = inner.min(), inner.max()
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


def _at_rest(states: Array, inputs: Array, spread: Array, step: float) -> np.ndarray:
    """Rows (K,) of stretches in which the inputs stay and no state moves by more than a tenth of its usual spread."""
    size = max(round(REST_TIME / step), 3)
    if len(states) < size or not inputs.shape[1]:
        return np.zeros(len(states), dtype=bool)
    limit = np.concatenate([REST_SHARE * spread, np.zeros(inputs.shape[1])])
    both = np.nan_to_num(np.concatenate([states, inputs], axis=1))
    moved = maximum_filter1d(both, size, axis=0) - minimum_filter1d(both, size, axis=0)
    return binary_dilation((moved <= limit).all(axis=1), np.ones(2 * (size // 2) + 1))


class Stamps(NamedTuple):
    """Stamps (K,) [s] that only increase, with what was wrong with them."""

    rows: np.ndarray  # (K,) of the table, those that are used
    time: Array  # (K,) [s]
    after_reversal: (
        np.ndarray
    )  # (K,) whether rows with earlier stamps stood before this one
    repeated: int
    backwards: int


def ordered_stamps(stamps: Array, where: str) -> Stamps:
    """Leaves out rows whose stamp is not the latest; ``DataError`` where it is not finite, or 5 % run backwards."""
    if not np.isfinite(stamps).all():
        row = int(np.argmin(np.isfinite(stamps)))
        raise DataError(
            f"{where}: the time in row {row + 1} is {stamps[row]}; expected a number"
        )
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
    return Stamps(
        rows, stamps[rows], reversed_before, int(repeated.sum()), int(backwards.sum())
    )


def resample(
    time: Array, values: Array, grid: Array, rule: str, max_gap: float
) -> Array:
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
        usable = (at >= 0) & (
            (lag <= RESOLUTION) | ((at < len(time) - 1) & (span <= max_gap))
        )
    return np.where(usable[:, None], found, np.nan)
