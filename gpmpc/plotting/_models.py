"""Draws how good the predictions of a model are, and what is in a log."""

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from gpmpc.plotting._style import (
    BLUE,
    COLOURS,
    DASHED,
    GREY,
    ORANGE,
    VERMILION,
    legend_below,
    make_figure,
    styled,
)

if TYPE_CHECKING:
    from gpmpc.calibration import Calibration
    from gpmpc.estimation import FilterRun
    from gpmpc.logs import Inspection, Judgement

_BASELINES = tuple(
    zip((GREY, *COLOURS[1:5]), "s^vDP", strict=True)
)  # told apart without colour by their markers
_PER_PAGE = 24  # channels drawn


@styled
def calibration_figure(calibration: "Calibration") -> Figure:
    """Draws coverage, log density and error over the steps ahead, a column a state.

    The nominal levels of coverage are dashed.
    """
    n = len(calibration.names)
    steps = range(1, calibration.horizon + 1)
    order = sorted(range(len(calibration.levels)), key=calibration.levels.__getitem__)
    colours = colormaps["Blues"](
        np.linspace(1.0, 0.5, len(order))[::-1]
    )  # the wider the interval, the darker
    line = {"marker": "o" if calibration.horizon <= 30 else None, "markersize": 3}
    figure, axes = make_figure(1.5 + 2.4 * n, 6.0, 3, n, sharex=True)
    for i, (above, density, error) in enumerate(axes.T):
        above.set_title(calibration.names[i], fontsize="medium")
        for j, colour in zip(order, colours, strict=True):
            above.axhline(
                calibration.levels[j], color=colour, linestyle=DASHED, linewidth=1
            )
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
    for j, colour in zip(
        order, colours, strict=True
    ):  # a level is named at its line, or just above the last name
        height = max(calibration.levels[j], lowest)
        place: Any = {
            "xycoords": ("axes fraction", "data"),
            "va": "center",
            "fontsize": "small",
        }
        axes[0, -1].annotate(
            f"{100 * calibration.levels[j]:g} %", (1.03, height), color=colour, **place
        )
        lowest = height + 0.085
    for axis, label in zip(
        axes[:, 0], ("coverage", "negative log density", "RMSE"), strict=True
    ):
        axis.set_ylabel(label)
    label = "steps ahead"
    if calibration.noise:
        label += f"; intervals hold {calibration.noise}"
    figure.supxlabel(label, fontsize="medium")
    figure.align_ylabels(axes[:, 0])
    return figure


@styled
def innovations_figure(
    run: "FilterRun", time_step: float = 1.0, names: list[str] | None = None
) -> Figure:
    """Draws the innovations of each measured value over their standard deviation.

    The legend says how many are outside of 95 %.
    """
    deviations = run.innovation_covariances.diagonal(dim1=-2, dim2=-1).sqrt()
    white = (run.innovations / deviations).cpu().numpy()
    p = white.shape[1]
    times = time_step * np.arange(len(white))
    figure, axes = make_figure(
        7.0,
        1.0 + 1.4 * p,
        p,
        1,
        "innovations over their standard deviation",
        sharex=True,
    )
    for i, axis in enumerate(axes.flat):
        seen = np.isfinite(white[:, i])
        outside = (
            100 * float((np.abs(white[seen, i]) > 1.96).mean())
            if seen.any()
            else np.nan
        )
        missing = 100 * float((~seen).mean())
        label = f"{outside:.1f} % outside (5 % expected), {missing:.0f} % missing"
        axis.plot(
            times[seen], white[seen, i], ".", color=BLUE, markersize=3, label=label
        )
        for limit in (-1.96, 1.96):
            axis.axhline(limit, color=VERMILION, linewidth=0.8)
        axis.set_ylabel(names[i] if names is not None else f"y{i + 1}")
        axis.legend(loc="upper right", fontsize="small")
    axes[-1, 0].set_xlabel("time [s]")
    return figure


@styled
def judgement_figure(judgement: "Judgement") -> Figure:
    """Draws the errors over the steps for every predictor.

    Below stand coverage and width of the model's intervals.
    """
    steps = judgement.steps
    n = len(judgement.groups)
    figure, axes = make_figure(
        2.6 * n, 4.8, 2, n, gridspec_kw={"height_ratios": [3, 1.6]}
    )
    for g, (axis, below) in enumerate(axes.T):
        others = (item for item in judgement.mean.items() if item[0] != "model")
        for (name, mean), (colour, marker) in zip(others, _BASELINES, strict=False):
            errors = np.where(np.isfinite(mean[:, g]), mean[:, g], np.nan)
            axis.loglog(
                steps,
                errors,
                color=colour,
                marker=marker,
                markersize=4,
                linewidth=1,
                label=name,
            )
        axis.loglog(
            steps,
            judgement.mean["model"][:, g],
            color=BLUE,
            marker="o",
            linewidth=2,
            label="model",
        )
        axis.set(title=judgement.groups[g], ylabel=f"mean error [{judgement.units[g]}]")
        share, (low, high) = (
            judgement.coverage[:, g],
            judgement.coverage_interval[:, g].T,
        )
        bars = np.maximum([share - low, high - share], 0)
        below.errorbar(steps, share, bars, color=BLUE, marker="o", capsize=3)
        below.plot(
            steps, judgement.width[:, g], color=VERMILION, marker="s", linestyle="--"
        )
        below.axhline(judgement.level, color="0.6", linewidth=0.8)
        below.set(xscale="log", ylim=(0.5, 1.5), xlabel="steps ahead")
        for each in (axis, below):
            each.set_xticks(steps, [str(step) for step in steps])
            each.minorticks_off()
    axes[1, 0].set_ylabel("coverage (solid)\nwidth (dashed)")
    legend_below(figure, axes[0])
    return figure


@styled
def inspection_figure(inspection: "Inspection") -> Figure:
    """Draws each channel over the time, with its gaps, on one page."""
    channels = [*inspection.lines.items()][:_PER_PAGE]
    if not channels:
        figure, axes = make_figure(10, 2, 1, 1)
        axes[0, 0].set_axis_off()
        axes[0, 0].text(0.5, 0.5, "no channel of numbers", ha="center", va="center")
        figure.suptitle(inspection.title, fontsize=10)
        return figure
    columns = 2 if len(channels) > 6 else 1
    rows = -(-len(channels) // columns)
    figure, axes = make_figure(10, 1.1 * rows + 1, rows, columns, sharex=True)
    for axis, (name, line) in zip(axes.T.flat, channels, strict=False):
        axis.plot(*line, color=BLUE, linewidth=0.7)
        for begin, end in inspection.gaps[:200]:
            axis.axvspan(begin, end, color=ORANGE, alpha=0.4, linewidth=0)
        axis.set_ylabel(name, rotation=0, ha="right", va="center", fontsize=7)
        axis.tick_params(labelsize=7)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    for axis in axes.T.flat[len(channels) :]:
        axis.set_visible(False)
    figure.suptitle(inspection.title, fontsize=10)
    return figure
