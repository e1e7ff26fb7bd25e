"""Tables and figures of the flights: figures 2 to 4 in the paper's layout, and its times beside ours."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from gpmpc.metrics import binomial_interval, time_quantiles
from gpmpc.plotting import png
from gpmpc.plotting._style import (
    COLOURS,
    DASHED,
    DASHES,
    legend_below,
    make_figure,
    styled,
)
from gpmpc.studies._document import MISSING, Document, Table, number

ERRORS = ("x - reference [m]", "y - reference [m]", "z - reference [m], downwards")
POSITIONS = ("x [m]", "y [m]", "z, downwards [m]")
ANGLES = ("roll [rad]", "pitch [rad]", "yaw [rad]")
INPUTS = ("thrust U1 [N]", "direction ux", "direction uy")
LOOPS = {
    "model": "The paper's reading: the GP rolled on itself",
    "plant": "The plant in the loop",
}
LEGEND = (
    "RMSE: of the positions [m] (attitude: roll, pitch, yaw [rad]) over all steps and trials; total: root of summed "
    "squares. outside: the farthest that an input left its bounds. failed: steps without a solve, bridged by the last "
    "plan. lost: trials that left the finite numbers or had nothing to fall back on. Times: wall time of a decision."
)
BOUNDS_LEGEND = (
    "broken: steps outside the state bounds, with the exact binomial interval (95 %); at a bound: of the steps whose "
    "plan led to a bound at once, where 1 - eta is what the program promises. paid: steps whose program could not keep "
    "a bound."
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
HEADER = ["", "trajectory", "H", "RMSE x, y, z", "total", "trials", "outside", "failed"]
HEADER += ["ms: median", "95 %", "largest"]
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
KINDS = {"slsqp": "nonlinear"}  # of the paper's two controllers
TIMES_HEADER = ["", "trajectory", "our s", "paper's s", "paper's / ours"]


def summarise(records: Sequence[dict]) -> pd.DataFrame:
    """Returns one row a controller, trajectory and setting, over all its trials, in the order in which they come."""
    groups: dict[tuple, list[dict]] = {}
    for record in records:
        groups.setdefault(tuple(record[key] for key in KEYS), []).append(record)
    rows = [
        dict(zip(KEYS, key, strict=True)) | _pooled(group)
        for key, group in groups.items()
    ]
    return pd.DataFrame(rows, dtype=object)


def _pooled(group: list[dict]) -> dict[str, Any]:
    """Returns the numbers of one row; None where there is none."""
    good = [record for record in group if "error" not in record]
    columns = [
        "rmse_1",
        "rmse_2",
        "rmse_3",
        "total",
        "total_min",
        "total_max",
        "input_excess",
        "failed_steps",
    ]
    columns += ["ms_median", "ms_p95", "ms_max", "seconds"]
    columns += [
        "violations",
        "steps",
        "violations_at_bound",
        "steps_at_bound",
        "steps_paid",
    ]
    numbers: dict[str, Any] = {
        "trials": len(good),
        "lost": len(group) - len(good),
    } | dict.fromkeys(columns)
    if not good:
        return numbers
    totals = np.array([record["total"] for record in good])
    axes = np.sqrt(
        np.mean(np.square([record["rmse"] for record in good]), axis=0)
    ).tolist()
    excesses = [
        record["input_excess"] for record in good if record["input_excess"] is not None
    ]
    times = time_quantiles(np.concatenate([record["seconds"] for record in good]))
    numbers |= dict(zip(columns, axes, strict=False)) | {
        "total": float(np.sqrt(np.mean(totals**2)))
    }
    numbers |= {"total_min": float(totals.min()), "total_max": float(totals.max())}
    numbers |= {"input_excess": max(excesses, default=None)}
    numbers |= {"failed_steps": sum(len(record["failures"]) for record in good)}
    numbers |= {
        "ms_median": 1e3 * times["median"],
        "ms_p95": 1e3 * times["p95"],
        "ms_max": 1e3 * times["largest"],
    }
    numbers |= {
        "seconds": float(np.median([sum(record["seconds"]) for record in good]))
    }
    for key, names in (("violations", columns[-5:-3]), ("at_bound", columns[-3:-1])):
        if key in good[0]:
            numbers |= dict(
                zip(
                    names,
                    np.sum([record[key] for record in good], axis=0).tolist(),
                    strict=True,
                )
            )
            numbers["steps_paid"] = sum(record["paid"] for record in good)
    return numbers


def summary(rows: pd.DataFrame, note: str) -> tuple[list[Table], list[str]]:
    """Returns the tables for a terminal, without the columns that it has no room for, and the legends."""
    shown = {
        id(HEADER): [0, 1, 2, 4, 5, 6, 7, 8],
        id(BOUNDS_HEADER): [0, 1, 2, 3, 4, 6],
    }
    tables = []
    for table in _tables(rows):
        columns = shown.get(id(table.header), range(len(table.header)))
        narrow = [[row[column] for column in columns] for row in table.rows]
        tables.append(
            Table([table.header[column] for column in columns], narrow, table.title)
        )
    return tables, [*_legends(rows), note]


def document(rows: pd.DataFrame, records: Sequence[dict], note: str) -> Document:
    """Returns the tables and the figures."""
    return Document(
        "Flights",
        _tables(rows),
        rows,
        notes=[*_legends(rows), note],
        images=_images(rows, records),
    )


def _legends(rows: pd.DataFrame) -> list[str]:
    return [LEGEND, *([BOUNDS_LEGEND] if rows.violations.notna().any() else [])]


def _tables(rows: pd.DataFrame) -> list[Table]:
    each = list(rows.itertuples())
    tables = [
        Table(HEADER, [_cells(row) for row in each if row.loop == loop], LOOPS[loop])
        for loop in LOOPS
    ]
    bounded = [_bounds_cells(row) for row in each if row.violations is not None]
    tables.append(
        Table(
            BOUNDS_HEADER,
            bounded,
            "State bounds that may be broken with probability 1 - eta",
        )
    )
    tables.append(
        Table(TIMES_HEADER, timing(rows), "Time of 189 steps beside section 5.2")
    )
    return [table for table in tables if table.rows]


def _cells(row: Any) -> list[str]:
    size = f", N = {row.size}" if row.size else ""
    name = (
        row.name
        + (f", eta = {row.confidence:g}" if row.confidence is not None else "")
        + size
    )
    shown = f"{row.trajectory}{' attitude' if row.subsystem == 'rotational' else ''}"
    trials = str(row.trials) + (f" ({row.lost} lost)" if row.lost else "")
    if not row.trials:
        return [name, shown, str(row.horizon), MISSING, MISSING, trials, *[MISSING] * 5]
    excess = (
        MISSING
        if row.input_excess is None
        else "0"
        if row.input_excess <= 0
        else f"{row.input_excess:.0e}"
    )
    times = [
        f"{t:.3g}" if t < 100 else f"{t:.0f}"
        for t in (row.ms_median, row.ms_p95, row.ms_max)
    ]
    axes = ", ".join(map(number, (row.rmse_1, row.rmse_2, row.rmse_3)))
    return [
        name,
        shown,
        str(row.horizon),
        axes,
        number(row.total),
        trials,
        excess,
        str(row.failed_steps),
        *times,
    ]


def _bounds_cells(row: Any) -> list[str]:
    cells = [
        row.name,
        row.trajectory,
        str(row.horizon),
        f"{100 * (1 - row.confidence):.3g}",
    ]
    for violated, steps in (
        (row.violations, row.steps),
        (row.violations_at_bound, row.steps_at_bound),
    ):
        low, high = binomial_interval(violated, steps) if steps else (0.0, 1.0)
        share = f"{100 * violated / steps:.1f}" if steps else MISSING
        cells += [f"{share} [{100 * low:.1f}, {100 * high:.1f}]", str(steps)]
    return [*cells, str(row.steps_paid)]


@cache
def paper_seconds() -> dict[tuple[str, str], float]:
    """Returns the seconds for 189 steps that section 5.2 prints, by kind of controller and trajectory."""
    kinds = {"nonlinear_gpmpc": "nonlinear", "gpmpc": "convex"}
    with Path(__file__).with_name("paper_timings.csv").open(encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    return {
        (kinds[line["controller"]], line["trajectory"]): float(line["seconds_total"])
        for line in lines
    }


def timing(rows: pd.DataFrame) -> list[list[str]]:
    """Returns the flights of the model loop with H = 1 beside the paper's seconds, and the controllers' ratios."""
    timed = rows[
        (rows.loop == "model")
        & (rows.horizon == 1)
        & (rows.subsystem == "translational")
        & (rows.trials > 0)
    ]
    timed = list(timed.itertuples())
    lines = []
    for row in timed:
        if paper := paper_seconds().get(
            (KINDS.get(row.controller, row.controller), row.trajectory)
        ):
            lines.append(
                [
                    row.name,
                    row.trajectory,
                    f"{row.seconds:.3f}",
                    f"{paper:g}",
                    f"{paper / row.seconds:.0f}",
                ]
            )
    for trajectory in dict.fromkeys(row.trajectory for row in timed):
        here = [row for row in timed if row.trajectory == trajectory]
        convex = next((row for row in here if row.controller == "convex"), None)
        for row in here:
            if (
                KINDS.get(row.controller, row.controller) == "nonlinear"
                and convex
                and ("nonlinear", trajectory) in paper_seconds()
            ):
                paper = (
                    paper_seconds()["nonlinear", trajectory]
                    / paper_seconds()["convex", trajectory]
                )
                ratio = f"{row.seconds / convex.seconds:.2f}"
                lines.append(
                    [
                        f"ratio: {row.name} / {convex.name}",
                        trajectory,
                        ratio,
                        f"{paper:.2f}",
                        "",
                    ]
                )
    return lines


@dataclass(frozen=True)
class Curve:
    """One line in each panel of a group."""

    label: str  # in the legend
    at: np.ndarray  # where the values lie on the horizontal axis (K,)
    values: np.ndarray  # A column a panel (K, p)
    wanted: np.ndarray | None = (
        None  # what they were to be (K or more, p); None where there is nothing
    )
    bounds: Sequence[Sequence[float]] | None = (
        None  # lower and upper, an entry a panel; None without
    )
    interval: np.ndarray | None = (
        None  # lower and upper end of what is doubtful of the first column (K, 2)
    )


@styled
def tracking(
    groups: Sequence[tuple[Sequence[str], Sequence[Curve]]], title: str = ""
) -> Figure:
    """Values over the time steps, a row of panels a group and a panel a column; references grey, bounds dotted."""
    columns = max(len(labels) for labels, _ in groups)
    figure, axes = make_figure(
        4.0 * columns, 2.7 * len(groups) + 0.7, len(groups), columns, title, sharex=True
    )
    for row, (labels, curves) in zip(axes, groups, strict=True):
        wanted = next((c.wanted for c in curves if c.wanted is not None), None)
        bounds = next((c.bounds for c in curves if c.bounds is not None), ())
        for j, (axis, label) in enumerate(zip(row, labels, strict=False)):
            reach = [c.values[:, j] for c in curves]
            if wanted is not None:
                axis.plot(
                    wanted[: len(curves[0].at), j],
                    color="0.75",
                    linewidth=3.5,
                    label="reference",
                )
                reach.append(wanted[:, j])
            low = min(v.min() for v in reach)
            high = max(v.max() for v in reach)
            near = 0.4 * max(high - low, 1e-6)
            for bound in (side[j] for side in bounds):
                if (
                    low - near <= bound <= high + near
                ):  # one that is far away would only flatten the curves
                    axis.axhline(
                        bound, color="0.25", linestyle=":", linewidth=1.2, label="bound"
                    )
            for curve, colour, dash in zip(curves, COLOURS, DASHES, strict=False):
                line = {
                    "color": colour,
                    "linestyle": dash,
                    "linewidth": 1.3,
                    "label": curve.label,
                }
                axis.plot(curve.at, curve.values[:, j], **line)
            axis.set_ylabel(label)
    for axis in axes[-1]:
        axis.set_xlabel("time step k")
    legend_below(figure, axes.flat)
    return figure


@styled
def over_settings(
    panels: Mapping[str, Sequence[Curve]],
    label: str,
    logarithmic: bool = False,
    diagonal: bool = False,
    title: str = "",
) -> Figure:
    """One measure over a setting, a panel a title, with intervals; logarithmic, or with the diagonal drawn in."""
    columns = min(2, len(panels))
    rows = -(-len(panels) // 2)
    figure, axes = make_figure(
        4.8 * columns, 3.5 * rows + 0.8 * (rows > 1), rows, columns, title
    )
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    for axis, (heading, curves) in zip(axes.flat, panels.items(), strict=False):
        axis.set(title=heading, xlabel=label)
        for i, curve in enumerate(curves):
            colour = COLOURS[i % len(COLOURS)]
            dash = DASHES[i % len(DASHES)]
            value = curve.values[:, 0]
            line = {"color": colour, "markersize": 4, "label": curve.label}
            if curve.interval is None:
                axis.plot(
                    curve.at, value, marker="o", linestyle=dash, linewidth=1.3, **line
                )
            else:
                aside = (
                    0.012 * (i - (len(curves) - 1) / 2) * float(curve.at.max())
                )  # intervals beside each other
                axis.errorbar(
                    curve.at + aside,
                    value,
                    np.abs(curve.interval.T - value),
                    fmt="o-",
                    capsize=3,
                    **line,
                )
        if logarithmic:
            axis.set_xscale("log")
            reach = np.concatenate([curve.values[:, 0] for curve in curves])
            if reach.max() > 10 * reach.min() > 0:
                axis.set_yscale("log")
            else:
                axis.set_ylim(0, 1.08 * reach.max())
            ticks = sorted({int(a) for curve in curves for a in curve.at})
            axis.set_xticks(ticks, [str(t) for t in ticks])
            axis.xaxis.set_minor_locator(NullLocator())
        if diagonal:
            end = max(float(curve.at.max()) for curve in curves)
            axis.plot(
                [0, end],
                [0, end],
                color="0.4",
                linestyle=DASHED,
                linewidth=1,
                label="what is allowed",
            )
            axis.set_ylim(bottom=0)
    legend_below(figure, axes.flat)
    return figure


def _images(rows: pd.DataFrame, records: Sequence[dict]) -> dict[str, bytes]:
    """Draws figures 2 (elliptical), 3 (Lorenz), 4 (inputs), the same of the plant in the loop; curves over settings."""
    found: dict[str, bytes] = {}
    for loop, suffix in (("model", ""), ("plant", "-plant")):
        chosen = _shown(
            record for record in records if "drawn" in record and record["loop"] == loop
        )
        for figure, trajectory in (("figure2", "elliptical"), ("figure3", "lorenz")):
            panels = []
            for subsystem, labels in (
                ("translational", POSITIONS),
                ("rotational", ANGLES),
            ):
                here = [
                    r
                    for r in chosen
                    if (r["trajectory"], r["subsystem"]) == (trajectory, subsystem)
                ]
                if (
                    here and loop == "plant"
                ):  # all are so close to the reference that only the difference shows
                    panels.append(
                        (ERRORS, [_curve(r, "errors", range(0, 6, 2)) for r in here])
                    )
                elif here:
                    panels.append(
                        (labels, [_curve(r, "states", range(0, 6, 2)) for r in here])
                    )
            if panels:
                found[f"{figure}{suffix}.png"] = png(
                    tracking(panels, f"{trajectory} trajectory: {LOOPS[loop].lower()}")
                )
        flown = [r for r in chosen if r["subsystem"] == "translational"]
        inputs = [
            (
                tuple(f"{trajectory}: {label}" for label in INPUTS),
                [
                    _curve(r, "inputs", range(3))
                    for r in flown
                    if r["trajectory"] == trajectory
                ],
            )
            for trajectory in dict.fromkeys(r["trajectory"] for r in flown)
        ]
        if inputs:
            found[f"figure4{suffix}.png"] = png(
                tracking(inputs, f"inputs: {LOOPS[loop].lower()}")
            )
    if panels := _over_horizon(rows):
        found["horizon.png"] = png(
            over_settings(
                panels, "horizon H", logarithmic=True, title="the plant in the loop"
            )
        )
    if panels := _over_confidence(rows):
        found["confidence.png"] = png(
            over_settings(
                panels,
                "allowed rate 1 - eta",
                diagonal=True,
                title="State bounds that may be broken",
            )
        )
    return found


def _shown(records: Iterable[dict]) -> list[dict]:
    """Returns the trials that figures 2 to 4 show: of every row with all data the shortest horizon."""
    records = [
        r for r in records if "timed" not in r["name"] and r["confidence"] is None
    ]
    shortest = {
        r["name"]: min(o["horizon"] for o in records if o["name"] == r["name"])
        for r in records
    }
    records = [
        r for r in records if r["horizon"] == shortest[r["name"]] and not r["size"]
    ]
    return [r for r in records if "without" not in r["name"]]


def _curve(record: dict, key: str, columns: Sequence[int]) -> Curve:
    drawn = record["drawn"]
    at = list(columns)
    if key == "errors":
        values = (np.array(drawn["states"]) - np.array(drawn["references"]))[:, at]
    else:
        values = np.array(drawn[key])[:, at]
    reference = drawn.get(
        {"states": "references", "inputs": "reference_inputs"}.get(key)
    )
    bounds = record["bounds"] if key == "inputs" and record["bounded"] else None
    label = record["name"] + (
        f" (H = {record['horizon']})" if record["loop"] == "plant" else ""
    )
    return Curve(
        label,
        np.arange(len(values)),
        values,
        None if reference is None else np.array(reference)[:, at],
        bounds,
    )


def _over_horizon(rows: pd.DataFrame) -> dict[str, list[Curve]]:
    flown = rows[(rows.loop == "plant") & rows.confidence.isna() & (rows.trials > 0)]

    def curve(name: str, size: int, group: pd.DataFrame, column: str) -> Curve:
        title = f"{name}, N = {size}" if size else name
        return Curve(
            title, group.horizon.to_numpy(int), group[[column]].to_numpy(float)
        )

    measures = {"RMSE [m]": "total", "median time of a step [ms]": "ms_median"}
    return {
        f"{trajectory}: {label}": curves
        for label, column in measures.items()
        for trajectory, here in flown.groupby("trajectory", sort=False)
        if (
            curves := [
                curve(*key, group, column)
                for key, group in _groups(here, ["name", "size"])
            ]
        )
    }


def _over_confidence(rows: pd.DataFrame) -> dict[str, list[Curve]]:
    panels: dict[str, list[Curve]] = {}
    which = (
        ("violations", "steps", "all steps"),
        ("violations_at_bound", "steps_at_bound", "steps planned at a bound"),
    )
    for trajectory, here in rows[rows.violations.notna()].groupby(
        "trajectory", sort=False
    ):
        for (name, H), group in _groups(here, ["name", "horizon"]):
            for broken, steps, label in which:
                if not group[steps].all():
                    continue
                ends = np.array(
                    [
                        binomial_interval(*count)
                        for count in zip(group[broken], group[steps], strict=True)
                    ]
                )
                rates = (group[broken] / group[steps]).to_numpy(float)[:, None]
                curve = Curve(
                    f"{name}, H = {H}",
                    1 - group.confidence.to_numpy(float),
                    rates,
                    interval=ends,
                )
                panels.setdefault(f"{trajectory}: broken, share of {label}", []).append(
                    curve
                )
    return panels


def _groups(rows: pd.DataFrame, keys: list[str]) -> list[tuple[Any, pd.DataFrame]]:
    """Returns the groups of several rows, of which a curve can be drawn."""
    return [
        (key, group) for key, group in rows.groupby(keys, sort=False) if len(group) > 1
    ]
