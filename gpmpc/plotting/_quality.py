"""The figure of quality over time: what every controller pays in cost, and what its decisions take."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator

from gpmpc.plotting._style import BLACK, COLOURS, DASHED, plain_numbers, styled

_SIZE = (9.0, 6.2)  # [in]: at 100 dots an inch as wide as a README
_CURVES = 5
_MARKERS = ("o", "^", "s", "D", "v", "P", "X")
_OTHERS = "0.75"
_FRONT = "0.35"
_TICKS = (-1, 0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)  # [%]
_LINEAR = 1.0  # [%] of cost up to which the axis is linear


@styled
def quality(rows: Sequence[Mapping]) -> Figure:
    """Cost above NMPC on the true model over milliseconds a decision, with the front of the best.

    A curve is one choice of settings at growing horizons: of each controller the one of least cost, of at most five
    controllers. All others are grey dots. The members of the front are numbered, and named by what is typed after
    ``gpmpc run``.

    Args:
        rows: Of the quality study; lost ones are counted in the corner.
    """
    flown = [{**row, "excess": 100 * (row["cost"] - 1)} for row in rows if row["lost"] is None]
    markers = {horizon: _MARKERS[i % len(_MARKERS)] for i, horizon in enumerate(sorted({row["H"] for row in rows}))}
    figure = Figure(figsize=_SIZE, layout="constrained")
    axis = figure.subplots()
    axis.set_title(f"gpmpc quality: {len({row['what'] for row in rows})} choices of settings over the horizon")
    axis.axhline(0, color=BLACK, linewidth=0.8, linestyle=DASHED, zorder=1)
    for row in flown:
        axis.plot(row["median"], row["excess"], markers[row["H"]], color=_OTHERS, markersize=4, zorder=2)
    plain: dict[str, Any] = {"linestyle": "none", "markersize": 5.5}
    handles = []
    for (what, line), colour in zip(_curves(flown).items(), COLOURS, strict=False):
        axis.plot([row["median"] for row in line], [row["excess"] for row in line], color=colour, zorder=3)
        for row in line:
            axis.plot(row["median"], row["excess"], markers[row["H"]], color=colour, markersize=6, zorder=3)
        handles.append(Line2D([], [], color=colour, marker="o", markersize=5.5, label=what))
    handles.append(Line2D([], [], color=_OTHERS, marker="o", **plain, label="other settings"))
    handles.append(Line2D([], [], color=_FRONT, linewidth=1.4, label="front: none is better and faster"))
    handles += [Line2D([], [], color="0.4", marker=kind, **plain, label=f"H = {H}") for H, kind in markers.items()]
    _scales(axis, flown)
    _front(axis, sorted((row for row in flown if row["front"]), key=lambda row: (row["median"], -row["cost"])))
    figure.legend(handles=handles, loc="outside upper center", ncols=3, fontsize=8.5)
    if lost := len(rows) - len(flown):
        axis.text(0.99, 0.98, f"lost: {lost}", transform=axis.transAxes, ha="right", va="top", color=_FRONT)
    return figure


def _curves(rows: Sequence[Mapping]) -> dict[str, list[Mapping]]:
    """Of each controller the settings of least cost, the fastest of those equal to 0.1 %; at most ``CURVES``."""
    lines: dict[str, list[Mapping]] = {}
    for row in sorted(rows, key=lambda row: row["H"]):
        lines.setdefault(row["what"], []).append(row)

    def merit(what: str) -> tuple[float, float]:
        cost = min(round(row["cost"], 3) for row in lines[what])
        return cost, min(row["median"] for row in lines[what] if round(row["cost"], 3) == cost)

    best: dict[str, str] = {}
    for what in sorted(lines, key=merit):
        best.setdefault(what.split()[0], what)
    return {what: lines[what] for what in list(best.values())[:_CURVES]}


def _scales(axis: Axes, rows: Sequence[Mapping]) -> None:
    axis.set_xscale("log")
    axis.set_yscale("symlog", linthresh=_LINEAR, linscale=0.4)
    axis.set_xlabel("median time of a decision [ms], one thread")
    axis.set_ylabel("closed-loop cost above NMPC on the true model")
    plain_numbers(axis.xaxis, few=True)
    values, times = [row["excess"] for row in rows] or [0.0], [row["median"] for row in rows] or [1.0]
    low, high = min(values), max(values)
    reach = [tick for tick in _TICKS if low * 1.5 - 1 <= tick <= high * 1.5 + 1]
    axis.set_yticks(reach, [f"{tick:+d} %" if tick else "0" for tick in reach])
    axis.yaxis.set_minor_locator(NullLocator())
    axis.set_ylim(min(1.5 * low, 0) - 0.4, 1.7 * max(high, _LINEAR))
    axis.set_xlim(min(times) / 1.7, max(times) * 1.6)


def _front(axis: Axes, members: Sequence[Mapping]) -> None:
    """Draws a stair that nobody is below of; its members are numbered, and named under the axis."""
    if not members:
        return
    x, y = [row["median"] for row in members], [row["excess"] for row in members]
    right, top = axis.get_xlim()[1], axis.get_ylim()[1]
    stair: Any = {"color": _FRONT, "linewidth": 1.4, "zorder": 1.5, "drawstyle": "steps-post"}
    axis.plot([x[0], *x, right], [top, *y, y[-1]], **stair)
    axis.set_xlim(right=right)
    axis.set_ylim(top=top)
    for number, place in enumerate(zip(x, y, strict=True), 1):
        axis.plot(*place, "o", markersize=11, markerfacecolor="none", markeredgecolor=_FRONT, markeredgewidth=1.2)
        beside: Any = {"textcoords": "offset points", "ha": "right", "va": "center", "weight": "bold"}
        axis.annotate(str(number), place, (-9 - 9 * (number % 2), -9), **beside)  # nobody is below and left of it
    names = [f"{number}  {row['what']} horizon={row['H']}" for number, row in enumerate(members, 1)]
    handles = [Line2D([], [], linestyle="none", label=name) for name in names]
    font: Any = {"family": "monospace", "size": 8.5}
    axis.figure.legend(handles=handles, loc="outside lower left", handlelength=0, prop=font)
