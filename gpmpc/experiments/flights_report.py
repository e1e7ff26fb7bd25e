"""How the flights are shown: tables as text, Markdown, CSV and JSON, and the paper's figures 2 to 4 in their layout."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from gpmpc.experiments.escapes import in_csv
from gpmpc.experiments.tables_report import markdown_table, number
from gpmpc.metrics import binomial_interval, time_quantiles
from gpmpc.plotting import Curve, over_settings, png, tracking

STYLE = {"box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0), "title_justify": "left", "title_style": "bold"}
ERRORS = ("x - reference [m]", "y - reference [m]", "z - reference [m]")
POSITIONS, ANGLES = ("x [m]", "y [m]", "z [m]"), ("roll [rad]", "pitch [rad]", "yaw [rad]")
INPUTS = ("U1 [N]", "ux [-]", "uy [-]")
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
    " broken: steps outside the state bounds, with the exact binomial interval (95 %); at a bound: of the steps whose "
    "plan led to a bound at once, where 1 - eta is what the program promises. paid: steps whose program could not keep "
    "a bound."
)


@dataclass(frozen=True)
class Summary:
    """All trials of one row on one trajectory.

    Attributes:
        name: Of the row.
        loop: ``"model"`` or ``"plant"``.
        controller: Its kind.
        trajectory: By name.
        subsystem: By name.
        horizon: H.
        size: Training transitions; 0 for all.
        confidence: eta; None without state bounds.
        trials: Flown to the end.
        lost: Not.
        rmse: By axis (3,), pooled.
        total: Pooled.
        spread: Smallest and largest total of a trial.
        excess: How far an input was outside its bounds; None where there are none.
        failed: Steps without a solve.
        milliseconds: Median, 95 % quantile and largest time of a decision [ms].
        seconds: Of all decisions of a trial, median over the trials [s].
        violations: Steps outside the state bounds, and all steps.
        at_bound: The same where the plan's next state was at a bound: there 1 - eta is what the bound promises.
        paid: Steps whose program could not keep a bound.
    """

    name: str
    loop: str
    controller: str
    trajectory: str
    subsystem: str
    horizon: int
    size: int
    confidence: float | None
    trials: int
    lost: int
    rmse: tuple[float, ...] = ()
    total: float = float("nan")
    spread: tuple[float, float] = (float("nan"), float("nan"))
    excess: float | None = None
    failed: int = 0
    milliseconds: tuple[float, float, float] = (float("nan"),) * 3
    seconds: float = float("nan")
    violations: tuple[int, int] | None = None
    at_bound: tuple[int, int] | None = None
    paid: int | None = None


def summarise(records: Sequence[dict]) -> list[Summary]:
    """One summary a row and trajectory, in the order in which they come."""
    keys = ("name", "loop", "controller", "trajectory", "subsystem", "horizon", "size", "confidence")
    groups: dict[tuple, list[dict]] = {}
    for record in records:
        groups.setdefault(tuple(record[key] for key in keys), []).append(record)
    return [_summary(dict(zip(keys, key, strict=True)), group) for key, group in groups.items()]


def _summary(named: dict, group: list[dict]) -> Summary:
    good = [record for record in group if "error" not in record]
    counts = named | {"trials": len(good), "lost": len(group) - len(good)}
    if not good:
        return Summary(**counts)
    totals = np.array([record["total"] for record in good])
    excesses = [record["input_excess"] for record in good if record["input_excess"] is not None]
    times = time_quantiles(np.concatenate([record["seconds"] for record in good]))
    pooled = {
        key: np.sum([r[key] for r in good], axis=0).tolist() for key in ("violations", "at_bound") if key in good[0]
    }
    return Summary(
        **counts,
        rmse=tuple(np.sqrt(np.mean(np.square([record["rmse"] for record in good]), axis=0)).tolist()),
        total=float(np.sqrt(np.mean(totals**2))),
        spread=(float(totals.min()), float(totals.max())),
        excess=max(excesses) if excesses else None,
        failed=sum(len(record["failures"]) for record in good),
        milliseconds=(1e3 * times.median, 1e3 * times.p95, 1e3 * times.largest),
        seconds=float(np.median([sum(record["seconds"]) for record in good])),
        **{key: tuple(value) for key, value in pooled.items()},
        paid=sum(record["paid"] for record in good) if pooled else None,
    )


@cache
def paper_seconds() -> dict[tuple[str, str], float]:
    """Seconds for 189 steps that section 5.2 prints, by kind of controller and trajectory."""
    text = files("gpmpc.experiments").joinpath("paper_timings.csv").read_text(encoding="utf-8")
    kinds = {"nonlinear_gpmpc": "nonlinear", "gpmpc": "convex"}
    return {
        (kinds[line["controller"]], line["trajectory"]): float(line["seconds_total"])
        for line in csv.DictReader(io.StringIO(text))
    }


HEADER = (
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
)
SHORT = [0, 1, 2, 4, 5, 6, 7, 8]  # columns of the same for a terminal
SHORT_BOUNDS = [0, 1, 2, 3, 4, 6]  # the same
BOUNDS_HEADER = ("", "trajectory", "H", "allowed %", "broken %", "of steps", "at a bound %", "of steps", "paid")
TIMES_HEADER = ("", "trajectory", "our s", "paper's s", "paper's / ours")


def _cells(row: Summary) -> list[str]:
    size = f", N = {row.size}" if row.size else ""
    name = row.name + (f", eta = {row.confidence:g}" if row.confidence is not None else "") + size
    shown = f"{row.trajectory}{' attitude' if row.subsystem == 'rotational' else ''}"
    trials = str(row.trials) + (f" ({row.lost} lost)" if row.lost else "")
    if not row.trials:
        return [name, shown, str(row.horizon), "—", "—", trials, "—", "—", "—", "—", "—"]
    excess = "—" if row.excess is None else "0" if row.excess <= 0 else f"{row.excess:.0e}"
    times = [f"{value:.3g}" if value < 100 else f"{value:.0f}" for value in row.milliseconds]
    axes = ", ".join(map(number, row.rmse))
    return [name, shown, str(row.horizon), axes, number(row.total), trials, excess, str(row.failed), *times]


def _bounds_cells(row: Summary) -> list[str]:
    cells = [row.name, row.trajectory, str(row.horizon), f"{100 * (1 - row.confidence):.3g}"]
    for violated, steps in (row.violations, row.at_bound):
        low, high = binomial_interval(violated, steps) if steps else (0.0, 1.0)
        share = f"{100 * violated / steps:.1f}" if steps else "—"
        cells += [f"{share} [{100 * low:.1f}, {100 * high:.1f}]", str(steps)]
    return [*cells, str(row.paid)]


def timing(rows: Sequence[Summary]) -> list[list[str]]:
    """The flights of the model loop with H = 1 beside the paper's seconds, and the ratios of the two controllers."""
    lines, ours = [], {}
    timed = [r for r in rows if r.loop == "model" and r.horizon == 1 and r.subsystem == "translational" and r.trials]
    for row in timed:
        paper = paper_seconds().get((row.controller, row.trajectory))
        ours.setdefault(row.trajectory, {})[row.name] = row
        if paper:
            lines.append([row.name, row.trajectory, f"{row.seconds:.3f}", f"{paper:g}", f"{paper / row.seconds:.0f}"])
    for trajectory, by_name in ours.items():
        convex = [row for row in by_name.values() if row.controller == "convex"]
        for row in by_name.values():
            if row.controller == "nonlinear" and convex and ("nonlinear", trajectory) in paper_seconds():
                paper = paper_seconds()[("nonlinear", trajectory)] / paper_seconds()[("convex", trajectory)]
                ratio = row.seconds / convex[0].seconds
                lines.append([f"ratio: {row.name} / {convex[0].name}", trajectory, f"{ratio:.2f}", f"{paper:.2f}", ""])
    return lines


def _tables(rows: Sequence[Summary]) -> list[tuple[str, Sequence[str], list[list[str]]]]:
    """Titles, headers and lines of all tables."""
    tables = [(title, HEADER, [_cells(row) for row in rows if row.loop == loop]) for loop, title in LOOPS.items()]
    bounded = [_bounds_cells(row) for row in rows if row.violations is not None]
    tables.append(("State bounds that may be broken with probability 1 - eta", BOUNDS_HEADER, bounded))
    tables.append(("Time of 189 steps beside section 5.2", TIMES_HEADER, timing(rows)))
    return [table for table in tables if table[2]]


def legend(rows: Sequence[Summary]) -> str:
    """What the columns of the tables mean."""
    return LEGEND + (BOUNDS_LEGEND if any(row.violations is not None for row in rows) else "")


def render(rows: Sequence[Summary], note: str) -> Group:
    """The tables for a terminal."""
    parts = []
    for title, header, lines in _tables(rows):
        table = Table(title=f"\n{title}", **STYLE)
        columns = {HEADER: SHORT, BOUNDS_HEADER: SHORT_BOUNDS}.get(header, range(len(header)))
        for column in columns:
            table.add_column(header[column], overflow="fold", no_wrap=column > 1)
        for line in lines:
            table.add_row(*(Text(line[column]) for column in columns))
        parts.append(table)
    return Group(*parts, Text(f"{legend(rows)}\n{note}"))


def documents(rows: Sequence[Summary], records: Sequence[dict], meta: dict, note: str) -> dict[str, str | bytes]:
    """Everything that is written of a run, by file name."""
    parts = ["# Flights", ""]
    for title, header, lines in _tables(rows):
        parts += [f"## {title}", "", *markdown_table(list(header), lines), ""]
    parts += [legend(rows), "", note, "", "## Made by", "", "```json", json.dumps(meta, indent=2), "```", ""]
    plain = [{k: v for k, v in record.items() if k != "drawn"} for record in records]
    written = {
        "figures.md": "\n".join(parts),
        "figures.csv": comma_separated(rows),
        "figures.json": json.dumps({"meta": meta, "flights": plain}, indent=None),
    }
    return written | pictures(rows, records)


def comma_separated(rows: Sequence[Summary]) -> str:
    """One line a summary."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    plain = ["name", "loop", "controller", "trajectory", "subsystem", "horizon", "size", "confidence", "trials", "lost"]
    more = ["rmse_1", "rmse_2", "rmse_3", "total", "total_min", "total_max", "input_excess", "failed_steps"]
    more += [
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
    writer.writerow(plain + more)
    for row in rows:
        axes = row.rmse or ("", "", "")
        line = [in_csv(getattr(row, key)) for key in plain]
        line += [*axes, row.total, *row.spread, row.excess, row.failed, *row.milliseconds, row.seconds]
        writer.writerow([*line, *(row.violations or ("", "")), *(row.at_bound or ("", "")), row.paid])
    return buffer.getvalue()


def pictures(rows: Sequence[Summary], records: Sequence[dict]) -> dict[str, bytes]:
    """Figures 2 (elliptical), 3 (Lorenz), 4 (inputs), the same of the plant in the loop; curves over settings."""
    found: dict[str, bytes] = {}
    drawn = [record for record in records if "drawn" in record]
    for loop, suffix in (("model", ""), ("plant", "-plant")):
        chosen = [r for r in drawn if r["loop"] == loop and "timed" not in r["name"] and r["confidence"] is None]
        shortest = {r["name"]: min(o["horizon"] for o in chosen if o["name"] == r["name"]) for r in chosen}
        chosen = [r for r in chosen if r["horizon"] == shortest[r["name"]] and not r["size"]]
        chosen = [r for r in chosen if "without" not in r["name"]]
        for figure, trajectory in (("figure2", "elliptical"), ("figure3", "lorenz")):
            shown = []
            for subsystem, labels in (("translational", POSITIONS), ("rotational", ANGLES)):
                there = [r for r in chosen if (r["trajectory"], r["subsystem"]) == (trajectory, subsystem)]
                if there and loop == "plant":  # all are so close to the reference that only the difference shows
                    shown.append((ERRORS, [_curve(r, "errors", range(0, 6, 2)) for r in there]))
                elif there:
                    shown.append((labels, [_curve(r, "states", range(0, 6, 2)) for r in there]))
            if shown:
                found[f"{figure}{suffix}.png"] = png(tracking(shown))
        flying = [r for r in chosen if r["subsystem"] == "translational"]
        inputs = [
            (
                tuple(f"{trajectory}: {label}" for label in INPUTS),
                [_curve(r, "inputs", range(3)) for r in flying if r["trajectory"] == trajectory],
            )
            for trajectory in dict.fromkeys(r["trajectory"] for r in flying)
        ]
        if inputs:
            found[f"figure4{suffix}.png"] = png(tracking(inputs))
    curves = (
        ("horizon.png", _over_horizon(rows), "horizon H", {"logarithmic": True}),
        ("confidence.png", _over_confidence(rows), "allowed rate 1 - eta", {"diagonal": True}),
    )
    return found | {name: png(over_settings(panels, at, **how)) for name, panels, at, how in curves if panels}


def _curve(record: dict, key: str, columns: Sequence[int]) -> Curve:
    drawn, at = record["drawn"], list(columns)
    if key == "errors":
        values = (np.array(drawn["states"]) - np.array(drawn["references"]))[:, at]
    else:
        values = np.array(drawn[key])[:, at]
    wanted = drawn.get({"states": "references", "inputs": "reference_inputs"}.get(key))
    bounds = record["bounds"] if key == "inputs" and record["bounded"] else None
    label = record["name"] + (f" (H = {record['horizon']})" if record["loop"] == "plant" else "")
    return Curve(label, np.arange(len(values)), values, None if wanted is None else np.array(wanted)[:, at], bounds)


def _over_horizon(rows: Sequence[Summary]) -> dict[str, list[Curve]]:
    panels: dict[str, list[Curve]] = {}
    for measure, label in (("total", "RMSE [m]"), ("milliseconds", "median time of a step [ms]")):
        for trajectory in dict.fromkeys(row.trajectory for row in rows):
            free = [row for row in rows if row.loop == "plant" and row.confidence is None and row.trials]
            for name, size in dict.fromkeys((row.name, row.size) for row in free):
                chosen = [r for r in free if (r.name, r.size, r.trajectory) == (name, size, trajectory)]
                values = [r.total if measure == "total" else r.milliseconds[0] for r in chosen]
                title = f"{name}, N = {size}" if size else name
                if len(chosen) > 1:
                    curve = Curve(title, np.array([r.horizon for r in chosen]), np.array(values)[:, None])
                    panels.setdefault(f"{trajectory}: {label}", []).append(curve)
    return panels


def _over_confidence(rows: Sequence[Summary]) -> dict[str, list[Curve]]:
    panels: dict[str, list[Curve]] = {}
    for trajectory in dict.fromkeys(row.trajectory for row in rows):
        for name, H in dict.fromkeys((row.name, row.horizon) for row in rows):
            group = [r for r in rows if (r.name, r.horizon, r.trajectory) == (name, H, trajectory) and r.violations]
            if len(group) < 2:
                continue
            for which, label in (("violations", "all steps"), ("at_bound", "steps planned at a bound")):
                counts = [getattr(r, which) for r in group]
                if not all(steps for _, steps in counts):
                    continue
                ends = np.array([binomial_interval(*count) for count in counts])
                rates = np.array([violated / steps for violated, steps in counts])
                at = np.array([1 - r.confidence for r in group])
                curve = Curve(f"{name}, H = {H}", at, rates[:, None], interval=ends)
                panels.setdefault(f"{trajectory}: broken, share of {label}", []).append(curve)
    return panels
