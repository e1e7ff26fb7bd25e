"""Draws the results of a sweep's runs over a variable, and the costs of a search."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from gpmpc._calls import explains_arguments
from gpmpc.plotting._style import (
    COLOURS,
    clipped,
    legend_below,
    make_figure,
    plain_numbers,
    styled,
)

_MOST_TICKS = 40  # on the axis of the variable


@dataclass(frozen=True)
class Series:
    """One line of a figure."""

    label: str  # in the legend
    # The runs' values by position on the axis; a position may have none.
    values: Sequence[Sequence[float]]


@explains_arguments
@styled
def over_variable(
    variable: str,
    values_of_variable: Sequence[str],
    measure: str,
    lines: Sequence[Series],
    logarithmic: bool = False,
) -> Figure:
    """Draws median and quartiles of a measure over a variable, every run as a dot.

    Args:
        variable: Its name, below the axis.
        values_of_variable: As text and in their order. Numbers stand at their place on
            the axis, which is logarithmic where they span a decade, and medians over
            them are joined; words stand side by side.
        measure: Its name with its unit, above the axis.
        lines: What else was varied, a line each; those without a number are left out.
        logarithmic: Whether the axis is, where the values span enough for it.
    """
    line_count = sum(any(line.values) for line in lines)
    figure, ((axis,),) = make_figure(width=4.8, height=3.4 + 0.11 * line_count)
    draw_quartiles(axis, lines, values_of_variable)
    axis.set_title(measure, fontsize="medium")
    axis.set_xlabel(clipped(variable, 50))
    longest = max(map(len, values_of_variable))
    if longest * min(len(values_of_variable), _MOST_TICKS) > 40:
        axis.tick_params(axis="x", labelrotation=30)
    values = [value for line in lines for group in line.values for value in group]
    low = min(values, default=0)
    high = max(values, default=0)
    if logarithmic and low > 0 and high > 3 * low:
        axis.set_yscale("log")
        plain_numbers(axis.yaxis, few=high < 30 * low)
    elif low >= 0:
        axis.set_ylim(0, 1.06 * high or 1)
    if line_count > 1:
        legend_below(figure, [axis])
    return figure


def draw_quartiles(
    axis: Axes, lines: Sequence[Series], positions: Sequence[str]
) -> None:
    """Draws median, quartiles and every value of each line at each position."""
    scale = _position_scale(positions)
    # Lines stand side by side, so that their quartiles do not hide each other.
    distance = min(0.14, 0.7 / max(len(lines), 1)) * scale.gap
    places = _places_side_by_side(lines)
    for i, line in enumerate(lines):
        if not any(line.values):  # a line of failed runs alone
            continue
        centres = scale.coordinates + distance * places[i]
        colour = COLOURS[i % len(COLOURS)]
        _draw_medians(axis, line, centres, scale, colour)
        _draw_values(axis, line, centres, scale, colour, width=0.3 * distance)
    if scale.is_logarithmic:
        axis.set_xscale("log")
    every = -(-len(positions) // _MOST_TICKS)  # rounded up
    axis.set_xticks(
        scale.to_axis(scale.coordinates[::every]),
        [clipped(position, 24) for position in positions[::every]],
    )
    axis.xaxis.set_minor_locator(NullLocator())
    axis.set_xlim(*scale.limits())


def _places_side_by_side(lines: Sequence[Series]) -> np.ndarray:
    """Returns how far each line stands from the middle of each position, in distances.

    Only lines with values at a position share it: one alone stands on its tick, two
    stand at -1/2 and 1/2, three at -1, 0 and 1.
    """
    has_values = np.array([[bool(group) for group in line.values] for line in lines])
    rank = has_values.cumsum(axis=0) - 1
    return rank - (has_values.sum(axis=0) - 1) / 2


@dataclass(frozen=True)
class _PositionScale:
    """Places of the values of a variable along an axis.

    Coordinates are what is evenly spread on paper: numbers, or their logarithms.
    """

    coordinates: np.ndarray
    has_numbers: bool
    is_logarithmic: bool

    @property
    def gap(self) -> float:
        """Smallest distance of two coordinates."""
        if len(self.coordinates) < 2:
            return 1.0
        return float(np.diff(self.coordinates).min())

    def to_axis(self, coordinates: np.ndarray) -> np.ndarray:
        """Returns coordinates in the values of the axis."""
        return 10**coordinates if self.is_logarithmic else coordinates

    def limits(self) -> np.ndarray:
        """Returns the values of the axis between which it is drawn (2,)."""
        lowest = self.coordinates[0]
        highest = self.coordinates[-1]
        margin = 0.5 * self.gap
        if self.has_numbers:
            margin = max(margin, 0.06 * (highest - lowest))
        return self.to_axis(np.array([lowest - margin, highest + margin]))


def _position_scale(positions: Sequence[str]) -> _PositionScale:
    """Places numbers where they belong, words side by side."""
    numbers = _numbers(positions)
    if numbers is None:
        side_by_side = np.arange(float(len(positions)))
        return _PositionScale(side_by_side, has_numbers=False, is_logarithmic=False)
    if numbers[0] > 0 and numbers[-1] >= 10 * numbers[0]:
        exponents = np.log10(numbers)
        return _PositionScale(exponents, has_numbers=True, is_logarithmic=True)
    return _PositionScale(numbers, has_numbers=True, is_logarithmic=False)


def _numbers(positions: Sequence[str]) -> np.ndarray | None:
    """Returns the positions as distinct finite numbers; None where they are none."""
    try:
        numbers = np.array([float(position) for position in positions])
    except ValueError:
        return None
    if not np.isfinite(numbers).all() or len(set(numbers)) < len(numbers):
        return None
    return numbers


def _draw_medians(
    axis: Axes, line: Series, centres: np.ndarray, scale: _PositionScale, colour: str
) -> None:
    """Draws medians with bars between the quartiles; those of numbers are joined."""
    positions = [p for p, group in enumerate(line.values) if group]
    low, median, high = np.transpose(
        [np.quantile(line.values[p], [0.25, 0.5, 0.75]) for p in positions]
    )
    axis.errorbar(
        scale.to_axis(centres[positions]),
        median,
        np.array([median - low, high - median]),
        label=line.label,
        color=colour,
        marker="o",
        markersize=4,
        linestyle="-" if scale.has_numbers else "none",
    )


def _draw_values(
    axis: Axes,
    line: Series,
    centres: np.ndarray,
    scale: _PositionScale,
    colour: str,
    width: float,
) -> None:
    """Draws every value as a dot, those of a position side by side."""
    coordinates = [np.empty(0)]
    for centre, group in zip(centres, line.values, strict=True):
        fractions = (np.arange(len(group)) + 0.5) / max(len(group), 1)  # 0 to 1
        coordinates.append(centre + width * (fractions * 2 - 1))
    axis.plot(
        scale.to_axis(np.concatenate(coordinates)),
        [value for group in line.values for value in group],
        ".",
        color=colour,
        alpha=0.45,
        markersize=5,
        mew=0,
    )


@explains_arguments
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
    has_bars = bool(importances)
    figure, axes = make_figure(
        width=8.4 if has_bars else 4.4, height=3.4, columns=2 if has_bars else 1
    )
    _draw_costs(axes[0, 0], np.array(costs), unchanged)
    legend_below(figure, [axes[0, 0]])
    if has_bars:
        _draw_importances(axes[0, 1], importances)
    return figure


def _draw_costs(axis: Axes, costs: np.ndarray, unchanged: float | None) -> None:
    """Draws each candidate's cost, and the least so far."""
    is_finite = np.isfinite(costs)
    axis.plot(
        np.flatnonzero(is_finite),
        costs[is_finite],
        ".",
        color=COLOURS[0],
        alpha=0.6,
        label="candidate",
    )
    least = np.minimum.accumulate(costs)
    has_least = np.isfinite(least)
    axis.step(
        np.flatnonzero(has_least),
        least[has_least],
        color=COLOURS[1],
        where="post",
        label="best so far",
    )
    failed = np.flatnonzero(~is_finite)
    if len(failed):
        axis.plot(
            failed,
            np.full(len(failed), 0.98),
            "x",
            transform=axis.get_xaxis_transform(),
            color="0.5",
            label="lost or failed",
        )
    if unchanged is not None:
        axis.axhline(
            unchanged, color="0.4", linestyle="--", label="settings as they are"
        )
    if is_finite.any() and costs[is_finite].min() > 0:
        axis.set_yscale("log")
    axis.set(xlabel="candidate", ylabel="closed-loop cost per step")
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))


def _draw_importances(axis: Axes, importances: Mapping[str, float]) -> None:
    """Draws a bar for each setting, the most important one on top."""
    names = [clipped(name, 60) for name in importances]
    percentages = [100 * share for share in importances.values()]
    bars = axis.barh(names[::-1], percentages[::-1], color=COLOURS[0], height=0.5)
    axis.bar_label(bars, fmt="%.0f %%", padding=3)
    axis.set(xlabel="importance [%]", xlim=(0, 115))
