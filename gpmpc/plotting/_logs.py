"""Figures of logs: what is in one, and how what was learned from it fares on runs that it never saw."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from gpmpc.plotting._style import BLUE, COLOURS, GREY, ORANGE, legend_below, styled

if TYPE_CHECKING:
    from gpmpc.logs import Inspection, Judgement

_MODEL, _GAP = BLUE, ORANGE
_OTHERS = (GREY, *COLOURS[1:5])  # told apart without colour by their markers
_MARKERS = ("s", "^", "v", "D", "P")
_PER_PAGE = 24  # channels drawn


@styled
def judgement_figure(judgement: "Judgement") -> Figure:
    """Draws the errors over the steps for every predictor, with coverage and width of the model's intervals below."""
    steps, groups = judgement.steps, len(judgement.groups)
    figure = Figure(figsize=(2.6 * groups, 4.8), layout="constrained")
    axes = figure.subplots(2, groups, squeeze=False, gridspec_kw={"height_ratios": [3, 1.6]})
    others = [name for name in judgement.mean if name != "model"]
    for g, (axis, below) in enumerate(axes.T):
        for name, colour, marker in zip(others, _OTHERS, _MARKERS, strict=False):
            errors = np.where(np.isfinite(judgement.mean[name][:, g]), judgement.mean[name][:, g], np.nan)
            axis.loglog(steps, errors, color=colour, marker=marker, markersize=4, linewidth=1, label=name)
        axis.loglog(steps, judgement.mean["model"][:, g], color=_MODEL, marker="o", linewidth=2, label="model")
        axis.set(title=judgement.groups[g], ylabel=f"mean error [{judgement.units[g]}]")
        share, (low, high) = judgement.coverage[:, g], judgement.coverage_interval[:, g].T
        bars = np.maximum([share - low, high - share], 0)
        below.errorbar(steps, share, bars, color=_MODEL, marker="o", capsize=3)
        below.plot(steps, judgement.width[:, g], color=_OTHERS[1], marker="s", linestyle="--")
        below.axhline(judgement.level, color="0.6", linewidth=0.8)
        below.set(xscale="log", ylim=(0.5, 1.5), xlabel="steps ahead")
        for each in (axis, below):
            each.set_xticks(steps, [str(step) for step in steps])
            each.minorticks_off()
    axes[1][0].set_ylabel("coverage (solid)\nwidth (dashed)")
    legend_below(figure, axes[0])
    return figure


@styled
def inspection_figure(inspection: "Inspection") -> Figure:
    """Draws each channel over the time, with its gaps, on one page."""
    channels = inspection.channels[:_PER_PAGE]
    columns = 2 if len(channels) > 6 else 1
    rows = -(-len(channels) // columns)
    figure = Figure(figsize=(10, 1.1 * rows + 1), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True)
    for axis, channel in zip(axes.T.flat, channels, strict=False):
        axis.plot(channel.time, channel.values, color=_MODEL, linewidth=0.7)
        for begin, end in inspection.gaps[:200]:
            axis.axvspan(begin, end, color=_GAP, alpha=0.4, linewidth=0)
        axis.set_ylabel(channel.name, rotation=0, ha="right", va="center", fontsize=7)
        axis.tick_params(labelsize=7)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    for axis in list(axes.T.flat)[len(channels) :]:
        axis.set_visible(False)
    figure.suptitle(inspection.title, fontsize=10)
    return figure
