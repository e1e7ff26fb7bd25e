"""Figures 2 to 4 in the paper's layout, and curves over horizon and confidence."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from gpmpc.metrics import binomial_interval
from gpmpc.plotting import png
from gpmpc.plotting._style import (
    COLOURS,
    DASHED,
    DASHES,
    legend_below,
    make_figure,
    styled,
)

ERRORS = ("x - reference [m]", "y - reference [m]", "z - reference [m], downwards")
POSITIONS = ("x [m]", "y [m]", "z, downwards [m]")
ANGLES = ("roll [rad]", "pitch [rad]", "yaw [rad]")
INPUTS = ("thrust U1 [N]", "direction ux", "direction uy")
LOOP_TITLES = {
    "model": "The paper's reading: the GP rolled on itself",
    "plant": "The plant in the loop",
}
_LOOPS = {  # in the title of a figure, by loop
    "model": "the GP rolled on itself",
    "plant": "the plant in the loop",
}
SUFFIXES = {"model": "", "plant": "-plant"}  # of file names, by loop
TRAJECTORY_FIGURES = {"figure2": "elliptical", "figure3": "lorenz"}
REFERENCES = {"states": "references", "inputs": "reference_inputs"}  # of curves


@dataclass(frozen=True)
class Curve:
    """One line in each panel of a group."""

    label: str  #: in the legend
    positions: np.ndarray  #: of the values on the horizontal axis (K,)
    values: np.ndarray  #: a column a panel (K, p)
    #: drawn in grey below the values (K or more, p); None for none
    reference: np.ndarray | None = None
    #: lower and upper, an entry a panel; None without
    bounds: Sequence[Sequence[float]] | None = None
    #: lower and upper end of what is doubtful of the first column (K, 2)
    interval: np.ndarray | None = None


class Group(NamedTuple):
    """A row of panels, and the curves that each of them has."""

    labels: Sequence[str]  # of the panels
    curves: Sequence[Curve]

    @property
    def reference(self) -> np.ndarray | None:
        """The reference of the first curve that has one."""
        references = (curve.reference for curve in self.curves)
        return next((known for known in references if known is not None), None)

    @property
    def bounds(self) -> Sequence[Sequence[float]]:
        """The bounds of the first curve that has some."""
        bounds = (curve.bounds for curve in self.curves)
        return next((sides for sides in bounds if sides is not None), ())


@styled
def tracking(groups: Sequence[Group], title: str = "") -> Figure:
    """Draws values over the time steps: a row of panels a group, a panel a column.

    References are grey, bounds dotted.
    """
    columns = max(len(group.labels) for group in groups)
    figure, axes = make_figure(
        width=4.0 * columns,
        height=2.7 * len(groups) + 0.7,
        rows=len(groups),
        columns=columns,
        title=title,
        sharex=True,
    )
    for row, group in zip(axes, groups, strict=True):
        for column, label in enumerate(group.labels):
            _draw_tracking_panel(row[column], group, column)
            row[column].set_ylabel(label)
    for axis in axes[-1]:
        axis.set_xlabel("time step k")
    legend_below(figure, axes.flat)
    return figure


def _draw_tracking_panel(axis: Axes, group: Group, column: int) -> None:
    drawn = [curve.values[:, column] for curve in group.curves]
    reference = group.reference
    if reference is not None:
        steps = len(group.curves[0].positions)
        axis.plot(
            reference[:steps, column], color="0.75", linewidth=3.5, label="reference"
        )
        drawn.append(reference[:, column])
    low = min(values.min() for values in drawn)
    high = max(values.max() for values in drawn)
    margin = 0.4 * max(high - low, 1e-6)
    for side in group.bounds:
        # One that is far away would only flatten the curves.
        if low - margin <= side[column] <= high + margin:
            axis.axhline(
                side[column], color="0.25", linestyle=":", linewidth=1.2, label="bound"
            )
    for curve, colour, dash in zip(group.curves, COLOURS, DASHES, strict=False):
        axis.plot(
            curve.positions,
            curve.values[:, column],
            color=colour,
            linestyle=dash,
            linewidth=1.3,
            label=curve.label,
        )


@styled
def over_settings(
    panels: Mapping[str, Sequence[Curve]],
    label: str,
    logarithmic: bool = False,
    diagonal: bool = False,
    title: str = "",
) -> Figure:
    """Draws one measure over a setting with its intervals.

    Args:
        panels: Curves by the title of their panel.
        label: Of the setting.
        logarithmic: Whether the axes are.
        diagonal: Whether the diagonal is drawn in.
        title: Of the figure.
    """
    columns = min(2, len(panels))
    rows = -(-len(panels) // 2)
    figure, axes = make_figure(
        width=4.8 * columns,
        height=3.5 * rows + 0.8 * (rows > 1),
        rows=rows,
        columns=columns,
        title=title,
    )
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    for axis, (heading, curves) in zip(axes.flat, panels.items(), strict=False):
        axis.set(title=heading, xlabel=label)
        _draw_measure(axis, curves)
        if logarithmic:
            _make_logarithmic(axis, curves)
        if diagonal:
            _draw_diagonal(axis, curves)
    legend_below(figure, axes.flat)
    return figure


def _draw_measure(axis: Axes, curves: Sequence[Curve]) -> None:
    for i, curve in enumerate(curves):
        colour = COLOURS[i % len(COLOURS)]
        dash = DASHES[i % len(DASHES)]
        values = curve.values[:, 0]
        if curve.interval is None:
            axis.plot(
                curve.positions,
                values,
                marker="o",
                markersize=4,
                color=colour,
                linestyle=dash,
                linewidth=1.3,
                label=curve.label,
            )
            continue
        # Intervals of different curves stand beside each other.
        place = i - (len(curves) - 1) / 2
        shift = 0.012 * place * float(curve.positions.max())
        axis.errorbar(
            curve.positions + shift,
            values,
            np.abs(curve.interval.T - values),
            fmt="o-",
            markersize=4,
            color=colour,
            capsize=3,
            label=curve.label,
        )


def _make_logarithmic(axis: Axes, curves: Sequence[Curve]) -> None:
    axis.set_xscale("log")
    values = np.concatenate([curve.values[:, 0] for curve in curves])
    if values.max() > 10 * values.min() > 0:
        axis.set_yscale("log")
    else:
        axis.set_ylim(0, 1.08 * values.max())
    positions = np.concatenate([curve.positions for curve in curves])
    ticks = sorted({int(position) for position in positions})
    axis.set_xticks(ticks, [str(tick) for tick in ticks])
    axis.xaxis.set_minor_locator(NullLocator())


def _draw_diagonal(axis: Axes, curves: Sequence[Curve]) -> None:
    end = max(float(curve.positions.max()) for curve in curves)
    axis.plot(
        [0, end],
        [0, end],
        color="0.4",
        linestyle=DASHED,
        linewidth=1,
        label="what is allowed",
    )
    axis.set_ylim(bottom=0)


def draw_all(rows: pd.DataFrame, records: Sequence[dict]) -> dict[str, bytes]:
    """Draws all figures for which there are flights, as PNG files by name.

    Figure 2 shows the elliptical trajectory, 3 the Lorenz curve, 4 the inputs; the same
    follow with the plant in the loop, then curves over settings.
    """
    images: dict[str, bytes] = {}
    drawn = [record for record in records if "drawn" in record]
    for loop, suffix in SUFFIXES.items():
        flights = _shown(record for record in drawn if record["loop"] == loop)
        for figure, trajectory in TRAJECTORY_FIGURES.items():
            followed = [r for r in flights if r["trajectory"] == trajectory]
            groups = _state_groups(followed, loop)
            if groups:
                title = f"{trajectory} trajectory: {_LOOPS[loop]}"
                images[f"{figure}{suffix}.png"] = png(tracking(groups, title))
        groups = _input_groups(flights)
        if groups:
            title = f"inputs: {_LOOPS[loop]}"
            images[f"figure4{suffix}.png"] = png(tracking(groups, title))
    return images | _setting_images(rows)


def _setting_images(rows: pd.DataFrame) -> dict[str, bytes]:
    images = {}
    panels = _over_horizon(rows)
    if panels:
        figure = over_settings(
            panels, "horizon H", logarithmic=True, title="the plant in the loop"
        )
        images["horizon.png"] = png(figure)
    panels = _over_confidence(rows)
    if panels:
        figure = over_settings(
            panels,
            "allowed rate 1 - eta",
            diagonal=True,
            title="State bounds that may be broken",
        )
        images["confidence.png"] = png(figure)
    return images


def _state_groups(records: Sequence[dict], loop: str) -> list[Group]:
    """Returns positions and angles of flights along one trajectory."""
    groups = []
    for subsystem, labels in (("translational", POSITIONS), ("rotational", ANGLES)):
        flights = [r for r in records if r["subsystem"] == subsystem]
        if not flights:
            continue
        quantity = "states"
        if loop == "plant":
            # All are so close to the reference that only the difference shows.
            quantity = "errors"
            labels = ERRORS
        curves = [_curve(r, quantity, range(0, 6, 2)) for r in flights]
        groups.append(Group(labels, curves))
    return groups


def _input_groups(records: Sequence[dict]) -> list[Group]:
    """Returns the inputs of the translational subsystem by trajectory."""
    flights = [r for r in records if r["subsystem"] == "translational"]
    groups = []
    for trajectory in dict.fromkeys(r["trajectory"] for r in flights):
        followed = [r for r in flights if r["trajectory"] == trajectory]
        labels = [f"{trajectory}: {label}" for label in INPUTS]
        curves = [_curve(r, "inputs", range(3)) for r in followed]
        groups.append(Group(labels, curves))
    return groups


def _shown(records: Iterable[dict]) -> list[dict]:
    """Returns the trials that figures 2 to 4 show.

    They are those with all data and the shortest horizon of every row.
    """
    candidates = [
        record
        for record in records
        if "timed" not in record["name"] and record["confidence"] is None
    ]
    shortest: dict[str, int] = {}
    for record in candidates:
        name = record["name"]
        horizon = record["horizon"]
        if name not in shortest or horizon < shortest[name]:
            shortest[name] = horizon
    return [
        record
        for record in candidates
        if record["horizon"] == shortest[record["name"]]
        and not record["size"]
        and "without" not in record["name"]
    ]


def _curve(record: dict, quantity: str, columns: Sequence[int]) -> Curve:
    """Returns a curve of some columns of the states, their errors or the inputs."""
    drawn = record["drawn"]
    columns = list(columns)
    if quantity == "errors":
        values = np.array(drawn["states"]) - np.array(drawn["references"])
    else:
        values = np.array(drawn[quantity])
    reference = None
    reference_name = REFERENCES.get(quantity)
    if reference_name in drawn:
        reference = np.array(drawn[reference_name])[:, columns]
    label = record["name"]
    if record["loop"] == "plant":
        label = f"{label} (H = {record['horizon']})"
    has_bounds = quantity == "inputs" and record["bounded"]
    return Curve(
        label=label,
        positions=np.arange(len(values)),
        values=values[:, columns],
        reference=reference,
        bounds=record["bounds"] if has_bounds else None,
    )


def _over_horizon(rows: pd.DataFrame) -> dict[str, list[Curve]]:
    """Returns error and time over the horizon, a panel a trajectory and measure."""
    is_flown = (rows.loop == "plant") & rows.confidence.isna() & (rows.trials > 0)
    measures = {"RMSE [m]": "total", "median time of a step [ms]": "ms_median"}
    panels = {}
    for label, column in measures.items():
        for trajectory, flights in rows[is_flown].groupby("trajectory", sort=False):
            curves = []
            for (name, size), group in _groups(flights, ["name", "size"]):
                curve = Curve(
                    label=f"{name}, N = {size}" if size else name,
                    positions=group.horizon.to_numpy(int),
                    values=group[[column]].to_numpy(float),
                )
                curves.append(curve)
            if curves:
                panels[f"{trajectory}: {label}"] = curves
    return panels


def _over_confidence(rows: pd.DataFrame) -> dict[str, list[Curve]]:
    """Returns rates of violations over the confidence, a panel a trajectory."""
    panels: dict[str, list[Curve]] = {}
    bounded = rows[rows.violations.notna()]
    for trajectory, flights in bounded.groupby("trajectory", sort=False):
        everywhere = panels.setdefault(f"{trajectory}: broken, share of all steps", [])
        at_bound = panels.setdefault(
            f"{trajectory}: broken, share of steps planned at a bound", []
        )
        for (name, horizon), group in _groups(flights, ["name", "horizon"]):
            label = f"{name}, H = {horizon}"
            allowed = 1 - group.confidence.to_numpy(float)
            if group.steps.all():
                everywhere.append(
                    _rate_curve(label, allowed, group.violations, group.steps)
                )
            if group.steps_at_bound.all():
                curve = _rate_curve(
                    label, allowed, group.violations_at_bound, group.steps_at_bound
                )
                at_bound.append(curve)
    return {title: curves for title, curves in panels.items() if curves}


def _rate_curve(
    label: str, allowed: np.ndarray, violations: pd.Series, steps: pd.Series
) -> Curve:
    intervals = [
        binomial_interval(broken, count)
        for broken, count in zip(violations, steps, strict=True)
    ]
    return Curve(
        label=label,
        positions=allowed,
        values=(violations / steps).to_numpy(float)[:, None],
        interval=np.array(intervals),
    )


def _groups(
    rows: pd.DataFrame, keys: list[str]
) -> Iterator[tuple[tuple[Any, Any], pd.DataFrame]]:
    """Yields the groups of several rows by two keys: a curve can be drawn of them."""
    for (first, second), group in rows.groupby(keys, sort=False):
        if len(group) > 1:
            yield (first, second), group
