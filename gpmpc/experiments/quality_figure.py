"""Draws closed-loop cost over the time of a decision."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator

from gpmpc.plotting._style import (
    BLACK,
    COLOURS,
    DASHED,
    make_figure,
    plain_numbers,
    styled,
)

CURVES = 5  # in the figure
MARKERS = ("o", "^", "s", "D", "v", "P", "X")
# greys
OTHERS = "0.75"
FRONT = "0.35"
TICKS = (-1, 0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)  # [%]
LINEAR = 1.0  # [%] of cost up to which the axis is linear

Case = Mapping[str, Any]  # a row of the quality study; "excess" is its cost in %


@styled
def front_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draws cost above NMPC on the true model over milliseconds a decision.

    A curve is one choice of settings at growing horizons: of each controller the one of
    least cost, of at most five controllers. All others are grey dots. The members of
    the front of the best are numbered, and named by what is typed after ``gpmpc run``.

    Args:
        rows: Of the quality study; lost ones are counted in the corner.
    """
    cases = [
        {**row, "excess": 100 * (row["cost"] - 1)}
        for row in rows
        if row["lost"] is None
    ]
    horizons = sorted({row["H"] for row in rows})
    markers = {H: MARKERS[i % len(MARKERS)] for i, H in enumerate(horizons)}
    choices = len({row["what"] for row in rows})
    # at 100 dots an inch as wide as a README
    figure, ((axis,),) = make_figure(width=9.0, height=6.2)
    axis.set_title(f"gpmpc quality: {choices} choices of settings over the horizon")
    axis.axhline(0, color=BLACK, linewidth=0.8, linestyle=DASHED, zorder=1)
    for case in cases:
        _draw_case(axis, case, markers, colour=OTHERS, size=4, zorder=2)
    handles = []
    for (what, line), colour in zip(_curves(cases).items(), COLOURS, strict=False):
        handles.append(_draw_curve(axis, what, line, markers, colour))
    handles += _other_handles(markers)
    _set_scales(axis, cases)
    members = [case for case in cases if case["front"]]
    members.sort(key=lambda case: (case["median"], -case["cost"]))
    _draw_front(axis, members)
    figure.legend(handles=handles, loc="outside upper center", ncols=3, fontsize=8.5)
    lost_count = len(rows) - len(cases)
    if lost_count:
        axis.text(
            0.99,
            0.98,
            f"lost: {lost_count}",
            transform=axis.transAxes,
            ha="right",
            va="top",
            color=FRONT,
        )
    return figure


def _draw_case(
    axis: Axes,
    case: Case,
    markers: Mapping[int, str],
    colour: str,
    size: int,
    zorder: int,
) -> None:
    axis.plot(
        case["median"],
        case["excess"],
        markers[case["H"]],
        color=colour,
        markersize=size,
        zorder=zorder,
    )


def _draw_curve(
    axis: Axes,
    what: str,
    cases: Sequence[Case],
    markers: Mapping[int, str],
    colour: str,
) -> Line2D:
    """Draws one choice of settings at growing horizons; returns its legend entry."""
    axis.plot(
        [case["median"] for case in cases],
        [case["excess"] for case in cases],
        color=colour,
        zorder=3,
    )
    for case in cases:
        _draw_case(axis, case, markers, colour=colour, size=6, zorder=3)
    return Line2D([], [], color=colour, marker="o", markersize=5.5, label=what)


def _other_handles(markers: Mapping[int, str]) -> list[Line2D]:
    """Returns the legend entries of the grey dots, the front and the horizons."""
    handles = [
        _dot_handle("o", colour=OTHERS, label="other settings"),
        Line2D(
            [], [], color=FRONT, linewidth=1.4, label="front: none is better and faster"
        ),
    ]
    for horizon, marker in markers.items():
        handles.append(_dot_handle(marker, colour="0.4", label=f"H = {horizon}"))
    return handles


def _dot_handle(marker: str, colour: str, label: str) -> Line2D:
    return Line2D(
        [],
        [],
        color=colour,
        marker=marker,
        linestyle="none",
        markersize=5.5,
        label=label,
    )


def _curves(cases: Sequence[Case]) -> dict[str, list[Case]]:
    """Returns the settings of least cost of each controller, at most ``CURVES``.

    Of costs that are equal to 0.1 % the fastest is taken.
    """
    lines: dict[str, list[Case]] = {}
    for case in sorted(cases, key=lambda case: case["H"]):
        lines.setdefault(case["what"], []).append(case)
    ranks = {what: _rank(line) for what, line in lines.items()}
    best: dict[str, str] = {}  # settings by controller
    for what in sorted(lines, key=lambda what: ranks[what]):
        best.setdefault(what.split()[0], what)
    return {what: lines[what] for what in list(best.values())[:CURVES]}


def _rank(line: Sequence[Case]) -> tuple[float, float]:
    """Returns the least cost over the horizons, rounded, and the least time for it."""
    cost = min(round(case["cost"], 3) for case in line)
    times = [case["median"] for case in line if round(case["cost"], 3) == cost]
    return cost, min(times)


def _set_scales(axis: Axes, cases: Sequence[Case]) -> None:
    axis.set_xscale("log")
    axis.set_yscale("symlog", linthresh=LINEAR, linscale=0.4)
    axis.set_xlabel("median time of a decision [ms], one thread")
    axis.set_ylabel("closed-loop cost above NMPC on the true model")
    plain_numbers(axis.xaxis, few=True)
    values = [case["excess"] for case in cases] or [0.0]
    times = [case["median"] for case in cases] or [1.0]
    low = min(values)
    high = max(values)
    ticks = [tick for tick in TICKS if low * 1.5 - 1 <= tick <= high * 1.5 + 1]
    axis.set_yticks(ticks, [f"{tick:+d} %" if tick else "0" for tick in ticks])
    axis.yaxis.set_minor_locator(NullLocator())
    axis.set_ylim(min(1.5 * low, 0) - 0.4, 1.7 * max(high, LINEAR))
    axis.set_xlim(min(times) / 1.7, max(times) * 1.6)


def _draw_front(axis: Axes, members: Sequence[Case]) -> None:
    """Draws a stair that no case lies below.

    Its members are numbered, and named under the axis.
    """
    if not members:
        return
    times = [case["median"] for case in members]
    costs = [case["excess"] for case in members]
    right = axis.get_xlim()[1]
    top = axis.get_ylim()[1]
    axis.plot(
        [times[0], *times, right],
        [top, *costs, costs[-1]],
        color=FRONT,
        linewidth=1.4,
        zorder=1.5,
        drawstyle="steps-post",
    )
    axis.set_xlim(right=right)
    axis.set_ylim(top=top)
    handles = []
    for i, case in enumerate(members, 1):
        _number_member(axis, i, case)
        label = f"{i}  {case['what']} horizon={case['H']}"
        handles.append(Line2D([], [], linestyle="none", label=label))
    font: Any = {"family": "monospace", "size": 8.5}
    axis.figure.legend(
        handles=handles, loc="outside lower left", handlelength=0, prop=font
    )


def _number_member(axis: Axes, i: int, case: Case) -> None:
    place = (case["median"], case["excess"])
    axis.plot(
        *place,
        "o",
        markersize=11,
        markerfacecolor="none",
        markeredgecolor=FRONT,
        markeredgewidth=1.2,
    )
    # No other case is below and left of it.
    axis.annotate(
        str(i),
        place,
        (-9 - 9 * (i % 2), -9),
        textcoords="offset points",
        ha="right",
        va="center",
        weight="bold",
    )
