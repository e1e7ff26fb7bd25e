"""The figure of quality over time: what every controller pays in cost, and what its decisions take."""

import math
from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

SIZE = (9.0, 6.2)  # [in]: at 100 dots an inch as wide as a README
COLOURS = (
    "#111111", "#8c6d31", "#c0392b", "#e08214", "#2e8b57", "#1f6fb4", "#7fb3dc", "#14395b", "#c77cb8", "#6a3d9a",
)  # fmt: skip
MARKERS = ("o", "^", "s", "D", "v", "P", "X")
TICKS = (-1, 0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)  # [%]
LINEAR = 1.0  # [%] of cost up to which the axis is linear
GAP = 0.055  # of the axis between the labels of two members of the front


def quality(rows: Sequence[Mapping]) -> Figure:
    """Cost above NMPC on the true model over milliseconds a decision, with the front of the best.

    A line is one choice of settings at growing horizons; open points flew with fewer seeds. The members of the front
    are named by what is typed after ``gpmpc run``.

    Args:
        rows: Of ``gpmpc.bench.quality``; lost ones are counted below the axis.
    """
    flown = [row for row in rows if row["lost"] is None]
    families, horizons = list(dict.fromkeys(row["family"] for row in rows)), sorted({row["H"] for row in rows})
    colours = {family: COLOURS[i % len(COLOURS)] for i, family in enumerate(families)}
    markers = {horizon: MARKERS[i % len(MARKERS)] for i, horizon in enumerate(horizons)}
    figure = Figure(figsize=SIZE, layout="constrained")
    axis = figure.subplots()
    axis.axhline(0, color=COLOURS[0], linewidth=0.8, linestyle=(0, (5, 3)), zorder=1)
    most = max((row["flights"] for row in flown), default=0)
    for words in dict.fromkeys(row["what"] for row in flown):
        line = sorted((row for row in flown if row["what"] == words), key=lambda row: row["H"])
        colour, at = colours[line[0]["family"]], [(row["median"], _excess(row)) for row in line]
        axis.plot(*zip(*at, strict=True), color=colour, linewidth=0.9, alpha=0.55, zorder=2)
        for row, (x, y) in zip(line, at, strict=True):
            inside = colour if row["flights"] == most else "white"
            axis.plot(
                x,
                y,
                markers[row["H"]],
                color=colour,
                markerfacecolor=inside,
                markersize=5.5,
                markeredgewidth=1,
                zorder=3,
            )
    _scales(axis, flown)
    _front(axis, [row for row in flown if row["front"]])
    _legends(axis, colours, markers, len(rows) - len(flown))
    return figure


def _excess(row: Mapping) -> float:
    """[%]."""
    return 100 * (row["cost"] - 1)


def _scales(axis: Axes, rows: Sequence[Mapping]) -> None:
    axis.set_xscale("log")
    axis.set_yscale("symlog", linthresh=LINEAR, linscale=0.6)
    axis.set_xlabel("median of a decision [ms], one thread")
    axis.set_ylabel("closed-loop cost above NMPC on the true model")
    axis.xaxis.set_major_locator(LogLocator(10, (1, 2, 5)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    values = [_excess(row) for row in rows] or [0.0]
    low, high = min(values), max(values)
    reach = [tick for tick in TICKS if low * 1.5 - 1 <= tick <= high * 1.5 + 1]
    axis.set_yticks(reach, [f"{tick:+d} %" if tick else "0" for tick in reach])
    axis.yaxis.set_minor_locator(NullLocator())
    times = [row["median"] for row in rows] or [1.0]
    axis.set_xlim(min(times) / 4, max(times) * 1.6)
    axis.grid(color="0.92")
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)


def _front(axis: Axes, members: Sequence[Mapping]) -> None:
    """A stair that nobody is below of, and its members' settings, in the room that they leave at its left."""
    members = sorted(members, key=lambda row: (row["median"], -row["cost"]))
    if not members:
        return
    at = [(row["median"], _excess(row)) for row in members]
    right, top = axis.get_xlim()[1], axis.get_ylim()[1]
    stair = [(at[0][0], top)]
    for x, y in at:
        stair += [(x, stair[-1][1]), (x, y)]
    axis.plot(*zip(*stair, (right, at[-1][1]), strict=True), color="0.35", linewidth=1.4, zorder=1.5)
    axis.set_xlim(right=right)
    axis.set_ylim(top=top)
    free = math.inf  # what lies above is taken
    for row, (x, y) in zip(members, at, strict=True):
        left, height = axis.transLimits.transform(axis.transScale.transform((x, y)))
        axis.plot(x, y, "o", markersize=11, markerfacecolor="none", markeredgecolor="0.35", markeredgewidth=1.2)
        free = min(height, free - GAP)
        axis.annotate(
            _typed(row),
            (x, y),
            (left - 0.035, free),
            textcoords="axes fraction",
            ha="right",
            va="center",
            fontsize=7.5,
            family="monospace",
            linespacing=1.15,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
            arrowprops={"arrowstyle": "-", "color": "0.35", "linewidth": 0.8, "shrinkB": 5.5, "shrinkA": 0},
            zorder=4,
        )


def _typed(row: Mapping) -> str:
    """The words that choose it, in two lines."""
    controller, *others = row["what"].split()
    return "\n".join([f"{controller} horizon={row['H']}", *others])


def _legends(axis: Axes, colours: Mapping[str, str], markers: Mapping[int, str], lost: int) -> None:
    """Families by colour, horizons by marker."""
    plain = {"linestyle": "none", "markersize": 5.5}
    handles = [Line2D([], [], color=colour, marker="o", **plain, label=name) for name, colour in colours.items()]
    handles += [Line2D([], [], color="0.4", marker=kind, **plain, label=f"H = {H}") for H, kind in markers.items()]
    handles.append(Line2D([], [], color="0.4", marker="o", markerfacecolor="white", **plain, label="fewer seeds"))
    handles.append(Line2D([], [], color="0.35", linewidth=1.4, label="front: nothing is better and faster"))
    axis.figure.legend(
        handles=handles, loc="outside upper center", ncols=4, frameon=False, fontsize=8.5, columnspacing=1.4
    )
    if lost:
        axis.text(0.99, 0.99, f"lost: {lost}", transform=axis.transAxes, ha="right", va="top", color="0.35")
