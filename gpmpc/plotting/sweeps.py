"""Draws the results of a sweep's runs over a variable."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

COLOURS = ("#1f4e79", "#c0392b", "#2e8b57", "#b8860b", "#6a3d9a", "#17858b", "#8c564b", "#555555")


@dataclass(frozen=True)
class Series:
    """One line of a figure.

    Attributes:
        label: In the legend.
        values: The runs' values by position on the axis; a position may have none.
    """

    label: str
    values: Sequence[Sequence[float]]


def over_variable(
    title: str,
    positions: Sequence[str],
    label: str,
    lines: Sequence[Series],
    logarithmic: bool = False,
    connected: bool = True,
) -> Figure:
    """Median and quartiles of a measure over the values of a variable, every run a dot.

    Args:
        title: Name of the variable.
        positions: Its values, as text.
        label: Of the measure, with its unit.
        lines: What else was varied, a line each; those without a number are left out.
        logarithmic: Whether the axis is, where the values span enough for it.
        connected: Whether the medians are joined, as over numbers; over words nothing lies between them.
    """
    drawn = [line for line in lines if any(line.values)]
    columns = max(1, 52 // (max((len(line.label) for line in drawn), default=0) + 8))  # 52 characters fill the width
    legend = -(-len(drawn) // columns) if len(drawn) > 1 else 0  # rows
    figure = Figure(figsize=(4.4, 3.2 + 0.22 * legend), layout="constrained")
    axis = figure.subplots()
    _draw(axis, lines, len(positions), "-" if connected else "none")
    axis.set_title(label, fontsize="medium")
    axis.set_xlabel(title)
    axis.set_xticks(range(len(positions)), list(positions))
    if max(map(len, positions)) * len(positions) > 40:
        axis.tick_params(axis="x", labelrotation=30)
    values = [v for line in lines for group in line.values for v in group]
    if logarithmic and values and min(values) > 0 and max(values) > 3 * min(values):
        axis.set_yscale("log")
        if max(values) < 30 * min(values):  # hardly a decade: its name alone says little
            axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.yaxis.set_minor_formatter(NullFormatter())
    elif not values or max(values) <= 0:
        axis.set_ylim(0, 1)
    elif min(values) >= 0:
        axis.set_ylim(bottom=0)
    axis.grid(axis="y", color="0.9")
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    if legend:
        figure.legend(loc="outside lower center", ncols=min(columns, len(drawn)), frameon=False)
    return figure


def _draw(axis: Axes, lines: Sequence[Series], count: int, linestyle: str) -> None:
    width = min(0.14, 0.7 / max(len(lines), 1))
    for i, line in enumerate(lines):
        colour = COLOURS[i % len(COLOURS)]
        offset = (i - (len(lines) - 1) / 2) * width  # lines side by side: their quartiles do not hide each other
        known = [(p + offset, np.quantile(group, [0.25, 0.5, 0.75])) for p, group in enumerate(line.values) if group]
        if not known:  # a line of failed runs alone
            continue
        places, quartiles = np.array([p for p, _ in known]), np.array([q for _, q in known])
        low, middle, high = quartiles.T
        style = {"color": colour, "marker": "o", "markersize": 4, "linestyle": linestyle}
        axis.errorbar(places, middle, np.array([middle - low, high - middle]), label=line.label, **style)
        for p, group in enumerate(line.values):
            aside = [0.25 * width * ((7 * j) % 11 / 5 - 1) for j in range(len(group))]
            axis.plot([p + offset + a for a in aside], group, ".", color=colour, alpha=0.45, markersize=5, mew=0)
    axis.set_xlim(-0.5, count - 0.5)
