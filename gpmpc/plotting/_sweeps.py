"""Draws the results of a sweep's runs over a variable, and the costs of a search."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from gpmpc.plotting._style import (
    COLOURS,
    clipped,
    legend_below,
    make_figure,
    plain_numbers,
    styled,
)


@dataclass(frozen=True)
class Series:
    """One line of a figure."""

    label: str  # in the legend
    values: Sequence[
        Sequence[float]
    ]  # the runs' values by position on the axis; a position may have none


@styled
def over_variable(
    title: str,
    positions: Sequence[str],
    label: str,
    lines: Sequence[Series],
    logarithmic: bool = False,
) -> Figure:
    """Median and quartiles of a measure over the values of a variable, every run a dot.

    Args:
        title: Name of the variable.
        positions: Its values, as text and in their order. Numbers stand at their place
            on the axis, which is logarithmic where they span a decade, and medians over
            them are joined; words stand side by side.
        label: Of the measure, with its unit.
        lines: What else was varied, a line each; those without a number are left out.
        logarithmic: Whether the axis is, where the values span enough for it.
    """
    drawn = sum(any(line.values) for line in lines)
    figure, ((axis,),) = make_figure(4.8, 3.4 + 0.11 * drawn)
    draw_quartiles(axis, lines, positions)
    axis.set_title(label, fontsize="medium")
    axis.set_xlabel(clipped(title, 50))
    if max(map(len, positions)) * len(positions) > 40:
        axis.tick_params(axis="x", labelrotation=30)
    values = [v for line in lines for group in line.values for v in group]
    low = min(values, default=0)
    high = max(values, default=0)
    if logarithmic and low > 0 and high > 3 * low:
        axis.set_yscale("log")
        plain_numbers(axis.yaxis, few=high < 30 * low)
    elif low >= 0:
        axis.set_ylim(0, 1.06 * high or 1)
    if drawn > 1:
        legend_below(figure, [axis])
    return figure


def draw_quartiles(
    axis: Axes, lines: Sequence[Series], positions: Sequence[str]
) -> None:
    """Draws median, quartiles and every value of each line at each position."""
    numbers = _numbers(positions)
    wide = numbers is not None and numbers[0] > 0 and numbers[-1] >= 10 * numbers[0]
    if numbers is None:
        at = np.arange(float(len(positions)))
    elif wide:
        at = np.log10(numbers)
    else:
        at = numbers
    gap = float(np.diff(at).min(initial=np.inf)) if len(at) > 1 else 1.0

    def place(x: np.ndarray) -> np.ndarray:
        return 10**x if wide else x

    width = min(0.14, 0.7 / max(len(lines), 1)) * gap
    for i, line in enumerate(lines):
        colour = COLOURS[i % len(COLOURS)]
        middles = (
            at + (i - (len(lines) - 1) / 2) * width
        )  # side by side: their quartiles do not hide each other
        known = [p for p, group in enumerate(line.values) if group]
        if not known:  # a line of failed runs alone
            continue
        low, middle, high = np.array(
            [np.quantile(line.values[p], [0.25, 0.5, 0.75]) for p in known]
        ).T
        style: Any = {
            "color": colour,
            "marker": "o",
            "markersize": 4,
            "linestyle": "none" if numbers is None else "-",
        }
        axis.errorbar(
            place(middles[known]),
            middle,
            np.array([middle - low, high - middle]),
            label=line.label,
            **style,
        )
        for x, group in zip(middles, line.values, strict=True):
            aside = (
                0.3
                * width
                * ((np.arange(len(group)) + 0.5) / max(len(group), 1) * 2 - 1)
            )
            axis.plot(
                place(x + aside),
                group,
                ".",
                color=colour,
                alpha=0.45,
                markersize=5,
                mew=0,
            )
    if wide:
        axis.set_xscale("log")
    axis.set_xticks(place(at), [clipped(position, 24) for position in positions])
    axis.xaxis.set_minor_locator(NullLocator())
    margin = 0.5 * gap if numbers is None else max(0.5 * gap, 0.06 * (at[-1] - at[0]))
    axis.set_xlim(*place(np.array([at[0] - margin, at[-1] + margin])))


def _numbers(positions: Sequence[str]) -> np.ndarray | None:
    """Returns the positions as distinct finite numbers; None where they are none."""
    try:
        numbers = np.array([float(position) for position in positions])
    except ValueError:
        return None
    if not np.isfinite(numbers).all() or len(set(numbers)) < len(numbers):
        return None
    return numbers


@styled
def search_figure(
    costs: Sequence[float], importances: Mapping[str, float], unchanged: float | None
) -> Figure:
    """Draws the costs of a search over its candidates, and how much settings mattered.

    Args:
        costs: In the order of the candidates; infinite ones stand at the upper edge.
        importances: Shares by setting, the most first; may be empty.
        unchanged: Cost of the settings without the search; None leaves it out.
    """
    figure, ((axis, *bars),) = make_figure(
        4.4 + 4.0 * bool(importances), 3.4, columns=1 + bool(importances)
    )
    values = np.array(costs)
    finite = np.isfinite(values)
    best = np.minimum.accumulate(values)
    axis.plot(
        np.flatnonzero(finite),
        values[finite],
        ".",
        color=COLOURS[0],
        alpha=0.6,
        label="candidate",
    )
    known = np.isfinite(best)
    axis.step(
        np.flatnonzero(known),
        best[known],
        color=COLOURS[1],
        where="post",
        label="best so far",
    )
    if len(lost := np.flatnonzero(~finite)):
        top = {
            "transform": axis.get_xaxis_transform(),
            "color": "0.5",
            "label": "lost or failed",
        }
        axis.plot(lost, np.full(len(lost), 0.98), "x", **top)
    if unchanged is not None:
        axis.axhline(
            unchanged, color="0.4", linestyle="--", label="settings as they are"
        )
    if finite.any() and values[finite].min() > 0:
        axis.set_yscale("log")
    axis.set(xlabel="candidate", ylabel="closed-loop cost per step")
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    legend_below(figure, [axis])
    for beside in bars:
        names = [clipped(name, 60) for name in importances]
        shares = [100 * share for share in importances.values()]
        drawn = beside.barh(names[::-1], shares[::-1], color=COLOURS[0], height=0.5)
        beside.bar_label(drawn, fmt="%.0f %%", padding=3)
        beside.set(xlabel="importance [%]", xlim=(0, 115))
    return figure
