"""Figures of the published results, and of how far predictions can be believed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, NullLocator, PercentFormatter

from gpmpc.plotting._style import BLACK, BLUE, COLOURS, DASHED, DASHES, VERMILION, legend_below, plain_numbers, styled
from gpmpc.plotting._sweeps import Series, draw_quartiles

if TYPE_CHECKING:
    from gpmpc.calibration import Calibration
    from gpmpc.estimation import FilterRun

_SIZE = (9.0, 6.2)  # [in]: at 100 dots an inch as wide as a README
_CURVES = 5
_MARKERS = ("o", "^", "s", "D", "v", "P", "X")
_OTHERS = "0.75"
_FRONT = "0.35"
_TICKS = (-1, 0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)  # [%]
_LINEAR = 1.0  # [%] of cost up to which the axis is linear


@styled
def error_over_size(
    panels: Mapping[str, tuple[dict[int, list[float]], dict[int, float]]], label: str, title: str = ""
) -> Figure:
    """Draws of an error over the training size with their quartiles, and the paper's points; logarithmic.

    Args:
        panels: By title, the errors of all draws and the paper's figure, both by training size.
        label: Of the error.
        title: Of the figure.
    """
    figure, axes = _panels(len(panels), 4.6, 3.4, title)
    for axis, (heading, (errors, paper)) in zip(axes, panels.items(), strict=False):
        sizes = sorted(errors)
        axis.set(title=heading, xlabel="training points N")
        if not sizes:  # every fit failed
            axis.set_axis_off()
            continue
        draws = Series("our draws, with their quartiles", [errors[size] for size in sizes])
        draw_quartiles(axis, [draws], [str(size) for size in sizes])
        if known := {size: paper[size] for size in sizes if size in paper}:
            axis.plot([*known], [*known.values()], "o", color=VERMILION, markersize=6, zorder=3, label="paper")
        axis.set_yscale("log")
        axis.yaxis.set_minor_locator(NullLocator())
    legend_below(figure, axes)
    figure.supylabel(label)
    return figure


def _panels(count: int, width: float, height: float, title: str) -> tuple[Figure, Any]:
    """Makes a figure of panels in two columns."""
    columns = min(2, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(width * columns, height * rows + 0.8 * (rows > 1)), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes[count:]:
        axis.set_visible(False)
    return figure, axes


@styled
def calibration_figure(calibration: "Calibration") -> Figure:
    """Coverage against its nominal level (dashed), log density and error over the steps ahead, a column a state."""
    n, steps = len(calibration.names), range(1, calibration.horizon + 1)
    order = sorted(range(len(calibration.levels)), key=calibration.levels.__getitem__)
    colours = colormaps["Blues"](np.linspace(1.0, 0.5, len(order))[::-1])  # the wider the interval, the darker
    line = {"marker": "o" if calibration.horizon <= 30 else None, "markersize": 3}
    figure = Figure(figsize=(1.5 + 2.4 * n, 6.0), layout="constrained")
    axes = figure.subplots(3, n, squeeze=False, sharex=True)
    for (above, density, error), i in zip(axes.T, range(n), strict=True):
        above.set_title(calibration.names[i], fontsize="medium")
        for j, colour in zip(order, colours, strict=True):
            above.axhline(calibration.levels[j], color=colour, linestyle=DASHED, linewidth=1)
            above.plot(steps, calibration.coverage[:, i, j], color=colour, **line)
        density.plot(steps, calibration.nlpd[:, i], color=colours[-1], **line)
        error.plot(steps, calibration.rmse[:, i], color=colours[-1], **line)
        above.set_ylim(0, 1.04)
        above.yaxis.set_major_formatter(PercentFormatter(1))
        above.tick_params(labelleft=i == 0)
        density.yaxis.set_major_locator(MaxNLocator(nbins=5))
        error.set_ylim(bottom=0)
        error.yaxis.set_major_locator(MaxNLocator(nbins=5))
        error.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=6, min_n_ticks=1))
    lowest = 0.0
    for j, colour in zip(order, colours, strict=True):  # a level is named at its line, or just above the last name
        height = max(calibration.levels[j], lowest)
        place: Any = {"xycoords": ("axes fraction", "data"), "va": "center", "fontsize": "small"}
        axes[0, -1].annotate(f"{100 * calibration.levels[j]:g} %", (1.03, height), color=colour, **place)
        lowest = height + 0.085
    for axis, label in zip(axes[:, 0], ("coverage", "negative log density", "RMSE"), strict=True):
        axis.set_ylabel(label)
    figure.supxlabel("steps ahead", fontsize="medium")
    figure.align_ylabels(axes[:, 0])
    return figure


@styled
def innovations_figure(run: "FilterRun", time_step: float = 1.0, names: list[str] | None = None) -> Figure:
    """Draws each measured value's innovations over their standard deviation, and the share outside of 95 %."""
    deviations = run.innovation_covariances.diagonal(dim1=-2, dim2=-1).sqrt()
    white = (run.innovations / deviations).cpu().numpy()
    p, times = white.shape[1], time_step * np.arange(len(white))
    figure = Figure(figsize=(7.0, 1.0 + 1.4 * p), layout="constrained")
    for i, axis in enumerate(figure.subplots(p, 1, sharex=True, squeeze=False).ravel()):
        seen = np.isfinite(white[:, i])
        outside = 100 * float((np.abs(white[seen, i]) > 1.96).mean()) if seen.any() else np.nan
        label = f"{outside:.1f} % outside (5 % expected), {100 * float((~seen).mean()):.0f} % missing"
        axis.plot(times[seen], white[seen, i], ".", color=BLUE, markersize=3, label=label)
        for limit in (-1.96, 1.96):
            axis.axhline(limit, color=VERMILION, linewidth=0.8)
        axis.set_ylabel(names[i] if names is not None else f"y{i + 1}")
        axis.legend(loc="upper right", fontsize="small")
        axis.set_xlabel("time [s]" if i == p - 1 else "")
    figure.suptitle("innovations over their standard deviation")
    return figure


@dataclass(frozen=True)
class Curve:
    """One line in each panel of a group."""

    label: str  # in the legend
    at: np.ndarray  # where the values lie on the horizontal axis (K,)
    values: np.ndarray  # A column a panel (K, p)
    wanted: np.ndarray | None = None  # what they were to be (K or more, p); None where there is nothing
    bounds: Sequence[Sequence[float]] | None = None  # lower and upper, an entry a panel; None without
    interval: np.ndarray | None = None  # lower and upper end of what is doubtful of the first column (K, 2)


@styled
def tracking(groups: Sequence[tuple[Sequence[str], Sequence[Curve]]], title: str = "") -> Figure:
    """Values over the time steps, a row of panels a group and a panel a column; references grey, bounds dotted."""
    columns = max(len(labels) for labels, _ in groups)
    figure = Figure(figsize=(4.0 * columns, 2.7 * len(groups) + 0.7), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(len(groups), columns, squeeze=False, sharex=True)
    for row, (labels, curves) in zip(axes, groups, strict=True):
        wanted = next((c.wanted for c in curves if c.wanted is not None), None)
        bounds = next((c.bounds for c in curves if c.bounds is not None), ())
        for j, (axis, label) in enumerate(zip(row, labels, strict=False)):
            reach = [c.values[:, j] for c in curves]
            if wanted is not None:
                axis.plot(wanted[: len(curves[0].at), j], color="0.75", linewidth=3.5, label="reference")
                reach.append(wanted[:, j])
            low, high = min(v.min() for v in reach), max(v.max() for v in reach)
            near = 0.4 * max(high - low, 1e-6)
            for bound in (side[j] for side in bounds):
                if low - near <= bound <= high + near:  # one that is far away would only flatten the curves
                    axis.axhline(bound, color="0.25", linestyle=":", linewidth=1.2, label="bound")
            for curve, colour, dash in zip(curves, COLOURS, DASHES, strict=False):
                line = {"color": colour, "linestyle": dash, "linewidth": 1.3, "label": curve.label}
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
    figure, axes = _panels(len(panels), 4.8, 3.5, title)
    for axis, (heading, curves) in zip(axes, panels.items(), strict=False):
        axis.set(title=heading, xlabel=label)
        for i, curve in enumerate(curves):
            colour, dash, value = COLOURS[i % len(COLOURS)], DASHES[i % len(DASHES)], curve.values[:, 0]
            line = {"color": colour, "markersize": 4, "label": curve.label}
            if curve.interval is None:
                axis.plot(curve.at, value, marker="o", linestyle=dash, linewidth=1.3, **line)
            else:
                aside = 0.012 * (i - (len(curves) - 1) / 2) * float(curve.at.max())  # intervals beside each other
                axis.errorbar(curve.at + aside, value, np.abs(curve.interval.T - value), fmt="o-", capsize=3, **line)
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
            axis.plot([0, end], [0, end], color="0.4", linestyle=DASHED, linewidth=1, label="what is allowed")
            axis.set_ylim(bottom=0)
    legend_below(figure, axes)
    return figure


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
