"""Draws the results of a sweep's runs over a variable."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from gpmpc.plotting._style import COLOURS, add_legend, clipped, plain_numbers, styled


@dataclass(frozen=True)
class Series:
    """One line of a figure."""

    label: str  # in the legend
    values: Sequence[Sequence[float]]  # the runs' values by position on the axis; a position may have none


@styled
def over_variable(
    title: str, positions: Sequence[str], label: str, lines: Sequence[Series], logarithmic: bool = False
) -> Figure:
    """Median and quartiles of a measure over the values of a variable, every run a dot.

    Args:
        title: Name of the variable.
        positions: Its values, as text and in their order. Numbers stand at their place on the axis, which is
            logarithmic where they span a decade, and medians over them are joined; words stand side by side.
        label: Of the measure, with its unit.
        lines: What else was varied, a line each; those without a number are left out.
        logarithmic: Whether the axis is, where the values span enough for it.
    """
    drawn = [line for line in lines if any(line.values)]
    figure = Figure(figsize=(4.8, 3.4 + 0.11 * len(drawn)), layout="constrained")
    axis = figure.subplots()
    draw_quartiles(axis, lines, positions)
    axis.set_title(label, fontsize="medium")
    axis.set_xlabel(clipped(title, 50))
    if max(map(len, positions)) * len(positions) > 40:
        axis.tick_params(axis="x", labelrotation=30)
    values = [v for line in lines for group in line.values for v in group]
    if logarithmic and values and min(values) > 0 and max(values) > 3 * min(values):
        axis.set_yscale("log")
        plain_numbers(axis.yaxis, few=max(values) < 30 * min(values))
    elif not values or max(values) <= 0:
        axis.set_ylim(0, 1)
    elif min(values) >= 0:
        axis.set_ylim(0, 1.06 * max(values))
    if len(drawn) > 1:
        add_legend(figure, *axis.get_legend_handles_labels())
    return figure


def draw_quartiles(axis: Axes, lines: Sequence[Series], positions: Sequence[str]) -> None:
    """Draws median, quartiles and every value of each line at each position."""
    numbers = _numbers(positions)
    wide = numbers is not None and numbers[0] > 0 and numbers[-1] >= 10 * numbers[0]
    at = np.arange(float(len(positions))) if numbers is None else np.log10(numbers) if wide else numbers
    gap = float(np.diff(at).min(initial=np.inf)) if len(at) > 1 else 1.0

    def place(x: np.ndarray) -> np.ndarray:
        return 10**x if wide else x

    width = min(0.14, 0.7 / max(len(lines), 1)) * gap
    for i, line in enumerate(lines):
        colour = COLOURS[i % len(COLOURS)]
        middles = at + (i - (len(lines) - 1) / 2) * width  # side by side: their quartiles do not hide each other
        known = [p for p, group in enumerate(line.values) if group]
        if not known:  # a line of failed runs alone
            continue
        low, middle, high = np.array([np.quantile(line.values[p], [0.25, 0.5, 0.75]) for p in known]).T
        style: Any = {"color": colour, "marker": "o", "markersize": 4, "linestyle": "none" if numbers is None else "-"}
        axis.errorbar(place(middles[known]), middle, np.array([middle - low, high - middle]), label=line.label, **style)
        for x, group in zip(middles, line.values, strict=True):
            aside = [0.3 * width * ((j + 0.5) / len(group) * 2 - 1) for j in range(len(group))]
            axis.plot(place(x + np.array(aside)), group, ".", color=colour, alpha=0.45, markersize=5, mew=0)
    if wide:
        axis.set_xscale("log")
    axis.set_xticks(place(at), [clipped(position, 24) for position in positions])
    axis.xaxis.set_minor_locator(NullLocator())
    margin = 0.5 * gap if numbers is None else max(0.5 * gap, 0.06 * (at[-1] - at[0]))
    axis.set_xlim(*place(np.array([at[0] - margin, at[-1] + margin])))


def _numbers(positions: Sequence[str]) -> np.ndarray | None:
    try:
        numbers = np.array([float(position) for position in positions])
    except ValueError:
        return None
    return numbers if np.isfinite(numbers).all() and len(set(numbers)) == len(numbers) else None


@styled
def search_figure(costs: Sequence[float], importances: Mapping[str, float], unchanged: float | None) -> Figure:
    """Draws the costs of a search over its candidates, and beside them how much each setting mattered.

    Args:
        costs: In the order of the candidates; infinite ones stand at the upper edge.
        importances: Shares by setting, the most first; may be empty.
        unchanged: Cost of the settings without the search; None leaves it out.
    """
    figure = Figure(figsize=(4.4 + 4.0 * bool(importances), 3.4), layout="constrained")
    axes = figure.subplots(1, 1 + bool(importances), squeeze=False)[0]
    values = np.array(costs)
    finite, best = np.isfinite(values), np.minimum.accumulate(values)
    axes[0].plot(np.flatnonzero(finite), values[finite], ".", color=COLOURS[0], alpha=0.6, label="candidate")
    known = np.isfinite(best)
    axes[0].step(np.flatnonzero(known), best[known], color=COLOURS[1], where="post", label="best so far")
    if not finite.all():
        edge = axes[0].get_xaxis_transform()
        lost = np.flatnonzero(~finite)
        axes[0].plot(lost, np.full(len(lost), 0.98), "x", color="0.5", transform=edge, label="lost or failed")
    if unchanged is not None:
        axes[0].axhline(unchanged, color="0.4", linestyle="--", label="settings as they are")
    if finite.any() and values[finite].min() > 0:
        axes[0].set_yscale("log")
    axes[0].set(xlabel="candidate", ylabel="closed-loop cost per step")
    axes[0].xaxis.set_major_locator(MaxNLocator(integer=True))
    add_legend(figure, *axes[0].get_legend_handles_labels())
    if importances:
        names = [*importances][::-1]
        bars = axes[1].barh(names, [100 * importances[name] for name in names], color=COLOURS[0], height=0.5)
        axes[1].bar_label(bars, fmt="%.0f %%", padding=3)
        axes[1].set(xlabel="importance [%]", xlim=(0, 115))
    return figure
