"""Finds the time step of a log, which is one for all rows of all runs.

Rates are differences over this step, so runs whose steps are unlike are refused, and
steps that vary from row to row are noted.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError
from gpmpc.logs._findings import Finding
from gpmpc.logs._mapping import LogMapping
from gpmpc.logs._run_tables import RunTable

SHORTEST_STEP = 1e-5  # [s] of rows that are measured one by one
LONGEST_STEP = 3600.0  # [s] likewise
MOST_UNLIKE = 0.05  # of the step of most rows, by which that of a run may differ
FEWEST_STEPS = 10  # of a run whose step is compared
JITTER = 0.1  # of the time step, from which on a rate should be stated
SHORT_STEP = 0.5  # time steps; a shorter one is uneven
LONG_STEP = 1.5  # time steps likewise
_ROUNDING = 1e-9  # of a step
_NEXT_MULTIPLE = 1.6  # steps; stamps that are rounded make steps of 2 and of 3 units


def find_time_step(
    tables: Sequence[RunTable],
    first_path: Path,
    mapping: LogMapping,
    findings: list[Finding],
) -> float:
    """Returns the time step [s] of a log: its rate's, or the usual one of its rows.

    Args:
        tables: Of all runs.
        first_path: The first file, for errors.
        mapping: May state a rate.
        findings: Takes what is odd about the steps.

    Raises:
        DataError: No two rows have different stamps, or the steps of two runs are
            unlike.
    """
    steps = np.concatenate([np.diff(table.time) for table in tables])
    if not len(steps):
        reason = "no two rows have different stamps"
        if mapping.rate:
            reason = f"a rate of {mapping.rate:g} Hz leaves a single row"
        raise DataError(f"{first_path}: {reason}")
    if mapping.rate:
        return 1 / mapping.rate
    step = _usual_step(steps)
    if not SHORTEST_STEP <= step <= LONGEST_STEP:
        text = f"rows are {step:.3g} s apart: is the unit of the time right?"
        findings.append(Finding("time step", tables[0].name, 1, text))
    _check_equal_steps(tables)
    for table in tables:
        _note_jitter(table, step, findings)
    return step


def _check_equal_steps(tables: Sequence[RunTable]) -> None:
    """Raises ``DataError`` where the step of a run is not that of most rows."""
    runs = [table for table in tables if len(table.time) > FEWEST_STEPS]
    if len(runs) < 2:
        return
    usual = np.array([_usual_step(np.diff(table.time)) for table in runs])
    rows = [len(table.time) for table in runs]
    of_most_rows = float(np.median(np.repeat(usual, rows)))
    farthest = int(np.abs(usual / of_most_rows - 1).argmax())
    if abs(usual[farthest] / of_most_rows - 1) <= MOST_UNLIKE:
        return
    raise DataError(
        f"run {runs[farthest].name}: rows are {usual[farthest]:.3g} s apart, those of "
        f"other runs {of_most_rows:.3g} s, and a log has one time step: state a rate "
        f"(rate: {1 / usual.max():.3g} resamples all runs)"
    )


def _usual_step(steps: Array) -> float:
    """Returns the mean of steps [s] that leave out no row.

    Unlike a median it is that of the clock where stamps are rounded: at 120 Hz, stamps
    in ms have steps of 8, 8 and 9. A row that came late and the next one, which did
    not, make a long and a short step, and neither counts. Where all steps are equal but
    for rounding it is the median, which other rows do not move by a last digit.
    """
    median = float(np.median(steps))
    is_usual = (steps >= SHORT_STEP * median) & (steps <= _NEXT_MULTIPLE * median)
    mean = float(steps[is_usual].mean())
    return median if abs(mean - median) <= _ROUNDING * median else mean


def _note_jitter(table: RunTable, step: float, findings: list[Finding]) -> None:
    """Notes steps that vary, of rows that are learned from as if they did not."""
    steps = np.diff(table.time)
    steps = steps[(steps >= SHORT_STEP * step) & (steps <= LONG_STEP * step)]
    if len(steps) < FEWEST_STEPS:
        return
    jitter = float(steps.std() / step)
    if jitter > JITTER:
        text = (
            f"steps from row to row vary by {jitter:.0%} of the time step, and are "
            f"taken as {step:.3g} s each (a rate resamples)"
        )
        findings.append(Finding("jitter", table.name, len(steps), text))
