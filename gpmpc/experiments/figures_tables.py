"""Tables of the flights of figures 2 to 4, and the paper's times beside ours."""

import csv
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from gpmpc.experiments.figures_drawing import LOOP_TITLES, draw_all
from gpmpc.metrics import binomial_interval, time_quantiles
from gpmpc.studies._document import MISSING, Document, Table, number
from gpmpc.studies.study import is_lost

LEGEND = (
    "RMSE: of the positions [m] (attitude: roll, pitch, yaw [rad]) over all steps and "
    "trials; total: root of summed squares. outside: the farthest that an input left "
    "its bounds. failed: steps without a solve, bridged by the last plan. lost: trials "
    "that left the finite numbers or had nothing to fall back on. Times: wall time of "
    "a decision."
)
BOUNDS_LEGEND = (
    "broken: steps outside the state bounds, with the exact binomial interval (95 %); "
    "at a bound: of the steps whose plan led to a bound at once, where 1 - eta is what "
    "the program promises. paid: steps whose program could not keep a bound."
)
KEYS = [
    "name",
    "loop",
    "controller",
    "trajectory",
    "subsystem",
    "horizon",
    "size",
    "confidence",
]
NUMBERS = [
    "rmse_1",
    "rmse_2",
    "rmse_3",
    "total",
    "total_min",
    "total_max",
    "input_excess",
    "failed_steps",
    "ms_median",
    "ms_p95",
    "ms_max",
    "seconds",
    "violations",
    "steps",
    "violations_at_bound",
    "steps_at_bound",
    "steps_paid",
]
HEADER = [
    "",
    "trajectory",
    "H",
    "RMSE x, y, z",
    "total",
    "trials",
    "outside",
    "failed",
    "ms: median",
    "95 %",
    "largest",
]
TERMINAL_COLUMNS = [0, 1, 2, 4, 5, 6, 7, 8]  # those that a terminal has room for
BOUNDS_HEADER = [
    "",
    "trajectory",
    "H",
    "allowed %",
    "broken %",
    "of steps",
    "at a bound %",
    "of steps",
    "paid",
]
BOUNDS_TERMINAL_COLUMNS = [0, 1, 2, 3, 4, 6]
TIMES_HEADER = ["", "trajectory", "our s", "paper's s", "paper's / ours"]


def summarise(records: Sequence[dict]) -> pd.DataFrame:
    """Returns one row for each controller, trajectory and setting, over its trials.

    Rows stand in the order in which they come.
    """
    groups: dict[tuple, list[dict]] = {}
    for record in records:
        key = tuple(record[name] for name in KEYS)
        groups.setdefault(key, []).append(record)
    rows = []
    for key, group in groups.items():
        labels = dict(zip(KEYS, key, strict=True))
        rows.append(labels | _pooled(group))
    return pd.DataFrame(rows, dtype=object)


def _pooled(records: list[dict]) -> dict[str, Any]:
    """Returns the numbers of one row; None for those that it does not have."""
    good = [record for record in records if "error" not in record]
    losses = sum(map(is_lost, records))
    numbers: dict[str, Any] = {"trials": len(good), "lost": losses}
    numbers |= dict.fromkeys(NUMBERS)
    if not good:
        return numbers
    numbers |= _pooled_errors(good) | _pooled_times(good)
    if "violations" in good[0]:
        numbers |= _pooled_violations(good)
    return numbers


def _pooled_errors(records: list[dict]) -> dict[str, Any]:
    squares = np.square([record["rmse"] for record in records])
    axes = np.sqrt(np.mean(squares, axis=0)).tolist()
    totals = np.array([record["total"] for record in records])
    excesses = [record["input_excess"] for record in records]
    excesses = [excess for excess in excesses if excess is not None]
    return {
        "rmse_1": axes[0],
        "rmse_2": axes[1],
        "rmse_3": axes[2],
        "total": float(np.sqrt(np.mean(totals**2))),
        "total_min": float(totals.min()),
        "total_max": float(totals.max()),
        "input_excess": max(excesses, default=None),
        "failed_steps": sum(len(record["failures"]) for record in records),
    }


def _pooled_times(records: list[dict]) -> dict[str, float]:
    times = time_quantiles(np.concatenate([record["seconds"] for record in records]))
    flights = [sum(record["seconds"]) for record in records]
    return {
        "ms_median": 1e3 * times["median"],
        "ms_p95": 1e3 * times["p95"],
        "ms_max": 1e3 * times["largest"],
        "seconds": float(np.median(flights)),
    }


def _pooled_violations(records: list[dict]) -> dict[str, int]:
    everywhere = np.sum([record["violations"] for record in records], axis=0)
    at_bound = np.sum([record["at_bound"] for record in records], axis=0)
    violations, steps = everywhere.tolist()
    violations_at_bound, steps_at_bound = at_bound.tolist()
    return {
        "violations": violations,
        "steps": steps,
        "violations_at_bound": violations_at_bound,
        "steps_at_bound": steps_at_bound,
        "steps_paid": sum(record["paid"] for record in records),
    }


def summary(rows: pd.DataFrame, note: str) -> tuple[list[Table], list[str]]:
    """Returns the tables for a terminal and the legends below them.

    The tables lack the columns that a terminal has no room for.
    """
    tables = [_narrowed(table, TERMINAL_COLUMNS) for table in _flight_tables(rows)]
    tables.append(_narrowed(_bounds_table(rows), BOUNDS_TERMINAL_COLUMNS))
    tables.append(_times_table(rows))
    return _not_empty(tables), [*_legends(rows), note]


def document(rows: pd.DataFrame, records: Sequence[dict], note: str) -> Document:
    """Returns the tables and the figures."""
    tables = [*_flight_tables(rows), _bounds_table(rows), _times_table(rows)]
    return Document(
        title="Flights",
        tables=_not_empty(tables),
        data=rows,
        notes=[*_legends(rows), note],
        images=draw_all(rows, records),
    )


def _narrowed(table: Table, columns: Sequence[int]) -> Table:
    """Returns some columns of a table."""
    header = [table.header[column] for column in columns]
    rows = [[row[column] for column in columns] for row in table.rows]
    return Table(header, rows, table.title)


def _not_empty(tables: Sequence[Table]) -> list[Table]:
    return [table for table in tables if table.rows]


def _legends(rows: pd.DataFrame) -> list[str]:
    legends = [LEGEND]
    if rows.violations.notna().any():
        legends.append(BOUNDS_LEGEND)
    return legends


def _flight_tables(rows: pd.DataFrame) -> list[Table]:
    """Returns one table for each loop."""
    tables = []
    for loop, title in LOOP_TITLES.items():
        cells = [_cells(row) for row in rows.itertuples() if row.loop == loop]
        tables.append(Table(HEADER, cells, title))
    return tables


def _bounds_table(rows: pd.DataFrame) -> Table:
    bounded = [row for row in rows.itertuples() if row.violations is not None]
    return Table(
        BOUNDS_HEADER,
        [_bounds_cells(row) for row in bounded],
        "State bounds that may be broken with probability 1 - eta",
    )


def _times_table(rows: pd.DataFrame) -> Table:
    return Table(TIMES_HEADER, timing(rows), "Time of 189 steps beside section 5.2")


def _cells(row: Any) -> list[str]:
    name = row.name
    if row.confidence is not None:
        name = f"{name}, eta = {row.confidence:g}"
    if row.size:
        name = f"{name}, N = {row.size}"
    trajectory = row.trajectory
    if row.subsystem == "rotational":
        trajectory = f"{trajectory} attitude"
    trials = f"{row.trials} ({row.lost} lost)" if row.lost else str(row.trials)
    if not row.trials:
        missing = [MISSING] * 5
        return [name, trajectory, str(row.horizon), MISSING, MISSING, trials, *missing]
    axes = [number(rmse) for rmse in (row.rmse_1, row.rmse_2, row.rmse_3)]
    return [
        name,
        trajectory,
        str(row.horizon),
        ", ".join(axes),
        number(row.total),
        trials,
        _excess_cell(row.input_excess),
        str(row.failed_steps),
        _milliseconds(row.ms_median),
        _milliseconds(row.ms_p95),
        _milliseconds(row.ms_max),
    ]


def _excess_cell(excess: float | None) -> str:
    if excess is None:
        return MISSING
    return "0" if excess <= 0 else f"{excess:.0e}"


def _milliseconds(time: float) -> str:
    return f"{time:.3g}" if time < 100 else f"{time:.0f}"


def _bounds_cells(row: Any) -> list[str]:
    allowed = f"{100 * (1 - row.confidence):.3g}"
    return [
        row.name,
        row.trajectory,
        str(row.horizon),
        allowed,
        _rate_cell(row.violations, row.steps),
        str(row.steps),
        _rate_cell(row.violations_at_bound, row.steps_at_bound),
        str(row.steps_at_bound),
        str(row.steps_paid),
    ]


def _rate_cell(violations: int, steps: int) -> str:
    """Writes the rate of violations and its interval, in percent."""
    if not steps:
        return f"{MISSING} [0.0, 100.0]"
    low, high = binomial_interval(violations, steps)
    rate = f"{100 * violations / steps:.1f}"
    return f"{rate} [{100 * low:.1f}, {100 * high:.1f}]"


@cache
def paper_seconds() -> dict[tuple[str, str], float]:
    """Returns the seconds for 189 steps that section 5.2 prints.

    Keys are the kind of controller and the trajectory.
    """
    kinds = {"nonlinear_gpmpc": "nonlinear", "gpmpc": "convex"}
    seconds = {}
    with Path(__file__).with_name("paper_timings.csv").open(encoding="utf-8") as file:
        for line in csv.DictReader(file):
            kind = kinds[line["controller"]]
            seconds[kind, line["trajectory"]] = float(line["seconds_total"])
    return seconds


def timing(rows: pd.DataFrame) -> list[list[str]]:
    """Returns the flights beside the paper's seconds, and the controllers' ratios.

    The flights are those of the model loop with H = 1.
    """
    is_timed = (rows.loop == "model") & (rows.horizon == 1)
    is_timed &= (rows.subsystem == "translational") & (rows.trials > 0)
    timed = list(rows[is_timed].itertuples())
    lines = []
    for row in timed:
        paper = paper_seconds().get((_kind(row.controller), row.trajectory))
        if paper is not None:
            ratio = f"{paper / row.seconds:.0f}"
            seconds = f"{row.seconds:.3f}"
            lines.append([row.name, row.trajectory, seconds, f"{paper:g}", ratio])
    for trajectory in dict.fromkeys(row.trajectory for row in timed):
        lines += _ratios([row for row in timed if row.trajectory == trajectory])
    return lines


def _kind(controller: str) -> str:
    """Returns which of the paper's two controllers one is."""
    return "nonlinear" if controller == "slsqp" else controller


def _ratios(rows: Sequence[Any]) -> list[list[str]]:
    """Returns the times of nonlinear controllers over those of the convex one.

    The rows are those of one trajectory.
    """
    trajectory = rows[0].trajectory
    convex = next((row for row in rows if row.controller == "convex"), None)
    paper = paper_seconds()
    if convex is None or ("nonlinear", trajectory) not in paper:
        return []
    papers_ratio = paper["nonlinear", trajectory] / paper["convex", trajectory]
    lines = []
    for row in rows:
        if _kind(row.controller) == "nonlinear":
            title = f"ratio: {row.name} / {convex.name}"
            ratio = f"{row.seconds / convex.seconds:.2f}"
            lines.append([title, trajectory, ratio, f"{papers_ratio:.2f}", ""])
    return lines
