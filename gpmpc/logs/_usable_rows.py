"""Leaves out the rows that are no measurement of a moving system, and marks the pieces.

Left out are rows outside the ranges of ``keep``, at rest, without a value, or that
repeat the row before because a sensor was silent. Where rows are missing, a new piece
begins.
"""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from gpmpc._dynamics import Array
from gpmpc.logs._clocks import JUMP
from gpmpc.logs._dropouts import changes_rarely, frozen_rows
from gpmpc.logs._findings import RunFindings
from gpmpc.logs._log import LogRun
from gpmpc.logs._mapping import LogMapping
from gpmpc.logs._run_tables import RunTable
from gpmpc.logs._time_step import LONG_STEP, SHORT_STEP

REST_TIME = 0.5  # [s] for which nothing moves at rest
# Rows for which nothing moves at rest, at least: what settles for fewer, after a step
# of an input, is a response, and would fall into pieces without them.
REST_ROWS = 50
REST_SHARE = 0.1  # of a state's usual motion that counts as no movement
USUAL_MOTION = 0.9  # quantile of the ranges within ``REST_TIME``
# Share of the rows; beyond, a signal has another rate than its table. At half the rate
# half of them repeat, or a little less where the two clocks drift: .45 is below both.
MOST_HELD = 0.45
UNCHANGING = "unchanging signal"  # kind of the finding of a run that is left out
MOST_MISSING = 0.5  # of the rows within ``REST_TIME``: of fewer a range says nothing


def least_motion(states: Sequence[Array], step: float) -> Array:
    """Returns the ranges (n,) within ``REST_TIME`` up to which states do not move.

    They are a tenth of what the states usually move in that time: a slow state that
    drifts at its usual speed moves. Of fast states it is a tenth of their spread, half
    of the range that holds 80 % of the rows.

    Args:
        states: Of each run (K, n); rows with a NaN do not count for the spread, and
            some are without.
        step: Time step of the log [s].
    """
    present = np.concatenate([rows[np.isfinite(rows).all(axis=1)] for rows in states])
    low, high = np.quantile(present, [0.1, 0.9], axis=0)
    spread = (high - low) / 2
    of_runs = [_ranges_of_rest_time(rows, step) for rows in states]
    ranges = np.concatenate([*of_runs, spread[None]])  # the spread where all are NaN
    usual = np.nanquantile(ranges, USUAL_MOTION, axis=0)
    return REST_SHARE * np.minimum(spread, usual)


def is_settled_at_rest(
    tables: Sequence[RunTable], step: float, rest_ranges: Array, mapping: LogMapping
) -> bool:
    """Returns whether the values at which states rest depend on the inputs.

    They do for a process that settles after every step of an input: rows at rest tell
    its gain. A vehicle that waits is at rest whatever its steering is. Vehicles that
    the mapping names (``model``) have states that no input holds, such as a position.

    Args:
        tables: Of all runs.
        step: Time step of the log [s].
        rest_ranges: Up to which states do not move (n,); see ``least_motion``.
        mapping: Of the log.
    """
    if mapping.model != "none" or mapping.rest == "use":
        return False
    states_at_rest = []
    inputs_at_rest = []
    for table in tables:
        values = mapping.split(table.values)
        at_rest = _at_rest(values.states, values.inputs, rest_ranges, step)
        at_rest &= ~np.isnan(table.values).any(axis=1) & ~table.outside_keep
        states_at_rest.append(values.states[at_rest])
        inputs_at_rest.append(values.inputs[at_rest])
    states = np.concatenate(states_at_rest)
    inputs = np.concatenate(inputs_at_rest)
    if not len(states):
        return False
    groups = np.unique(inputs, axis=0, return_inverse=True)[1].ravel()
    counts = np.bincount(groups)
    means = np.stack(
        [np.bincount(groups, column) / counts for column in states.T], axis=-1
    )
    scatter = np.sqrt(np.square(states - means[groups]).mean(axis=0))
    differ_by = np.ptp(means, axis=0)
    # By more than they scatter where inputs are the same.
    return bool((differ_by > np.maximum(rest_ranges, scatter)).any())


def select_rows(
    table: RunTable,
    step: float,
    rest_ranges: Array,
    keep_rest: bool,
    mapping: LogMapping,
    findings: RunFindings,
) -> LogRun | None:
    """Makes a run of the rows of a table that can be used.

    Args:
        table: Of the run.
        step: Time step of the log [s].
        rest_ranges: Up to which states do not move (n,); see ``least_motion``.
        keep_rest: Whether rows at rest stay in; see ``is_settled_at_rest``.
        mapping: Says what is left out.
        findings: Of the run, which takes what is left out.

    Returns:
        The run; None where less than two rows are left, or where a signal changes in so
        few rows that its sensor was silent, or slow.
    """
    values = mapping.split(table.values)
    rows = _RowSelection(len(table.time), findings)
    rows.leave_out(table.outside_keep, "outside of keep", "outside the ranges of keep")
    is_settled = np.zeros(len(table.time), dtype=bool)
    if mapping.rest == "drop":
        at_rest = _at_rest(values.states, values.inputs, rest_ranges, step)
        if keep_rest:
            is_settled = at_rest & rows.usable
            text = (
                f"{is_settled.sum()} of {len(at_rest)} rows where nothing moves: "
                "states rest at other values for other inputs, which tells the gain; "
                "left in"
            )
            findings.add("settled", is_settled.sum(), text)
        else:
            text = "where nothing moves (rest: use keeps them)"
            rows.leave_out(at_rest, "at rest", text)
    is_missing = np.asarray(np.isnan(table.values).any(axis=1))
    rows.leave_out(is_missing, "missing value", "in a gap or without a value")
    fault = _leave_out_held_values(rows, is_settled, values.states, mapping)
    if fault:
        findings.add(UNCHANGING, len(table.time), f"is left out: {fault}")
        return None
    motion = _ranges_of_rest_time(values.states, step) > rest_ranges
    _note_held_sensors(values.states, motion, mapping, findings)
    usable_rows = np.flatnonzero(rows.usable)
    if len(usable_rows) < 2:
        text = "no row can be used: the run is left out"
        findings.add("nothing left", len(table.time), text)
        return None
    ends_piece = _find_ends_of_pieces(table, usable_rows, step, mapping, findings)
    values = mapping.split(table.values[usable_rows])
    return LogRun(
        name=table.name,
        time=table.time[usable_rows],
        states=values.states,
        inputs=values.inputs,
        context=values.context,
        begins=(0, *(np.flatnonzero(ends_piece) + 1).tolist()),
    )


class _RowSelection:
    """The rows of a run that are usable so far."""

    def __init__(self, count: int, findings: RunFindings) -> None:
        self.usable = np.ones(count, dtype=bool)
        self._findings = findings

    def leave_out(self, rows: np.ndarray, kind: str, text: str) -> None:
        """Leaves out rows (K,), and notes those that were usable until now."""
        count = (rows & self.usable).sum()
        text = f"{count} of {len(rows)} rows {text}: left out"
        self._findings.add(kind, count, text)
        self.usable[rows] = False


def _leave_out_held_values(
    rows: _RowSelection, is_settled: np.ndarray, states: Array, mapping: LogMapping
) -> str:
    """Leaves out rows in which a whole signal of the states repeats the row before.

    What has settled (K,) repeats by itself, and goes on for a while after a step of an
    input: that counts for nothing here. Returns what is wrong where these are too many;
    empty otherwise.
    """
    # of all signals the same: they may repeat in turn
    usable = rows.usable & ~is_settled
    count = usable.sum()
    for signal, columns in zip(
        mapping.of("states"), mapping.space.columns, strict=True
    ):
        if (signal.held or mapping.held) == "use":
            continue
        # A single entry may repeat by its resolution.
        if columns.stop - columns.start < 2:
            continue
        repeats = (states[1:, columns] == states[:-1, columns]).all(axis=1)
        is_repeated = np.r_[False, repeats]
        values = np.cumsum(~is_repeated)  # numbers of the values, one after the other
        has_settled = np.isin(values, values[is_settled])
        is_repeated &= usable & ~has_settled
        if is_repeated.sum() >= max(count - 1, 1):
            return (
                f"{signal.name} never changes: its sensor was silent; leave it out, or "
                "held: use"
            )
        if is_repeated.sum() > MOST_HELD * max(count, 1):
            changes = (usable & ~is_repeated).sum()
            return (
                f"{signal.name} changes in {changes} of {count} rows only: its own "
                "rate is lower; state a lower rate, or held: use"
            )
        text = f"where {signal.name} repeats the row before"
        rows.leave_out(is_repeated, "held value", text)
    return ""


def _note_held_sensors(
    states: Array, motion: np.ndarray, mapping: LogMapping, findings: RunFindings
) -> None:
    """Notes single columns that repeat while others move.

    They stay in: a wheel at rest repeats its speed, too, and then starts with a jump.
    """
    for signal, columns in zip(
        mapping.of("states"), mapping.space.columns, strict=True
    ):
        if signal.combines_columns or (signal.held or mapping.held) == "use":
            continue
        for index, name in enumerate(signal.columns, start=columns.start):
            others_move = np.any(np.delete(motion, index, axis=1), axis=1)
            column = states[:, index]
            frozen = frozen_rows(column, others_move)
            if frozen.any():
                text = (
                    f"{frozen.sum()} rows in which {name} stays at its value, and then "
                    "jumps or ends, while others move: was the sensor silent? left in"
                )
                findings.add("held sensor", frozen.sum(), text)
            elif changes_rarely(column, others_move):
                changes = int((np.diff(column) != 0).sum())
                text = (
                    f"{name} changes in {changes} of {len(column)} rows only, while "
                    "others move: is its own rate lower? state a lower rate; left in"
                )
                findings.add("held sensor", len(column) - 1 - changes, text)


def _find_ends_of_pieces(
    table: RunTable,
    rows: np.ndarray,
    step: float,
    mapping: LogMapping,
    findings: RunFindings,
) -> np.ndarray:
    """Finds the usable rows with which a piece ends, and notes gaps.

    Args:
        table: Of the run.
        rows: Usable ones (U,).
        step: Time step of the log [s].
        mapping: Says how long a gap may be.
        findings: Takes the gaps between neighbouring rows.

    Returns:
        Whether a piece ends with each of them but the last (U - 1,).
    """
    longest = LONG_STEP * step
    if mapping.max_gap and not mapping.rate:  # rows that follow are one step apart
        longest = min(longest, mapping.max_gap)
    steps = np.diff(table.time[rows])
    is_uneven = (steps > longest) | (steps < SHORT_STEP * step)
    are_apart = np.diff(rows) > 1
    is_before_break = table.breaks[rows[1:]]
    is_jump = is_before_break & (steps > JUMP)  # which has its own finding
    uneven = steps[is_uneven & ~are_apart & ~is_jump]
    _note_gaps(uneven, step, mapping, findings)
    return is_uneven | are_apart | is_before_break


def _note_gaps(
    uneven: Array, step: float, mapping: LogMapping, findings: RunFindings
) -> None:
    """Notes uneven time steps (G,) [s] between neighbouring rows."""
    if not len(uneven):
        return
    shortest = uneven.min()
    longest = uneven.max()
    if shortest > step:
        text = f"{len(uneven)} gaps, up to {longest:.3g} s: boundaries"
        if not mapping.rate and shortest <= (mapping.max_gap or 0.0):
            text += " (only a rate resamples over gaps of up to max_gap)"
    else:
        text = (
            f"{len(uneven)} steps of {shortest:.3g} to {longest:.3g} s: boundaries "
            "(a rate resamples)"
        )
    findings.add("gap", len(uneven), text)


def _ranges_of_rest_time(states: Array, step: float) -> Array:
    """Returns the ranges of states (K, n) within ``REST_TIME`` around each row."""
    return _range_within(states, min(_rest_rows(step), len(states)))


def _rest_rows(step: float) -> int:
    """Returns the rows, an odd number, for which nothing moves at rest."""
    return 2 * (max(round(REST_TIME / step), REST_ROWS) // 2) + 1


def _at_rest(
    states: Array, inputs: Array, rest_ranges: Array, step: float
) -> np.ndarray:
    """Finds rows (K,) of stretches in which inputs stay and no state moves.

    ``rest_ranges`` are those (n,) up to which states do not; see ``least_motion``.
    """
    size = _rest_rows(step)
    if len(states) < size or not inputs.shape[1]:
        return np.zeros(len(states), dtype=bool)
    limit = np.concatenate([rest_ranges, np.zeros(inputs.shape[1])])
    values = np.concatenate([states, inputs], axis=1)
    is_still = np.asarray((_range_within(values, size) <= limit).all(axis=1))
    is_still[: size // 2] = False  # the window begins before the run
    is_still[len(is_still) - size // 2 :] = False
    # A maximum takes the same time for any size, a dilation by the rows of one second
    # of a fast plant minutes.
    return maximum_filter1d(is_still.astype(np.uint8), size, mode="constant") > 0


def _range_within(values: Array, size: int) -> Array:
    """Returns the range of values (K, c) within ``size`` rows around each.

    Missing values do not count; where more than half are missing, the range is NaN.
    """
    is_missing = np.isnan(values)
    highest = maximum_filter1d(np.where(is_missing, -np.inf, values), size, axis=0)
    lowest = minimum_filter1d(np.where(is_missing, np.inf, values), size, axis=0)
    missing = uniform_filter1d(is_missing.astype(float), size, axis=0)
    return np.where(missing > MOST_MISSING, np.nan, highest - lowest)
