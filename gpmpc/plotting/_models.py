"""Draws how good the predictions of a model are, and what is in a log."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator, PercentFormatter

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import SettingError, check_kind
from gpmpc.plotting._style import (
    BLUE,
    COLOURS,
    DASHED,
    GREY,
    ORANGE,
    VERMILION,
    figure_label,
    legend_below,
    make_figure,
    plain_numbers,
    styled,
)

if TYPE_CHECKING:
    from torch import Tensor

    from gpmpc.calibration import Calibration
    from gpmpc.estimation import FilterRun
    from gpmpc.logs import Inspection, Judgement

# Colour and marker of each baseline: markers tell them apart without colour.
_BASELINE_STYLES = tuple(zip((GREY, *COLOURS[1:5]), "s^vDP", strict=True))
_NORMAL_95 = 1.96  # standard deviations that hold 95 % of a normal variable
_CHANNELS_PER_PAGE = 24
_MOST_GAPS = 200  # drawn


class _Level(NamedTuple):
    """A nominal level of coverage."""

    column: int  # in ``Calibration.coverage``
    value: float
    colour: np.ndarray


@explains_arguments
@styled
def calibration_figure(calibration: "Calibration") -> Figure:
    """Draws coverage, log density and error over the steps ahead, a column a state.

    The nominal levels of coverage are dashed.
    """
    from gpmpc.calibration import Calibration

    check_kind("calibration", calibration, Calibration, "what calibrate returns")
    n = len(calibration.names)
    figure, axes = make_figure(
        width=1.5 + 2.4 * n, height=6.0, rows=3, columns=n, sharex=True
    )
    levels = _levels(calibration)
    for i, (coverage, density, error) in enumerate(axes.T):
        coverage.set_title(figure_label(calibration.names[i]), fontsize="medium")
        _draw_coverage(coverage, calibration, i, levels)
        coverage.tick_params(labelleft=i == 0)
        widest = levels[-1]
        _draw_over_steps(density, calibration, calibration.nlpd[:, i], widest.colour)
        _draw_over_steps(error, calibration, calibration.rmse[:, i], widest.colour)
        density.yaxis.set_major_locator(MaxNLocator(nbins=5))
        error.yaxis.set_major_locator(MaxNLocator(nbins=5))
        error.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=6, min_n_ticks=1))
        error.set_ylim(bottom=0)
    _name_levels(axes[0, -1], levels)
    axes[0, 0].set_ylabel("coverage")
    axes[1, 0].set_ylabel("negative log density")
    axes[2, 0].set_ylabel("RMSE")
    x_label = "steps ahead"
    if calibration.noise:
        x_label += f"; intervals hold {calibration.noise}"
    figure.supxlabel(x_label, fontsize="medium")
    figure.align_ylabels(axes[:, 0])
    return figure


def _levels(calibration: "Calibration") -> list[_Level]:
    """Returns the levels by size; the wider the interval, the darker its colour."""
    values = calibration.levels
    order = sorted(range(len(values)), key=values.__getitem__)
    colours = colormaps["Blues"](np.linspace(1.0, 0.5, len(order))[::-1])
    return [
        _Level(column=column, value=values[column], colour=colour)
        for column, colour in zip(order, colours, strict=True)
    ]


def _draw_coverage(
    axis: Axes, calibration: "Calibration", state: int, levels: list[_Level]
) -> None:
    """Draws how often the intervals of each level held a state."""
    for level in levels:
        axis.axhline(level.value, color=level.colour, linestyle=DASHED, linewidth=1)
        coverage = calibration.coverage[:, state, level.column]
        _draw_over_steps(axis, calibration, coverage, level.colour)
    axis.set_ylim(0, 1.04)
    axis.yaxis.set_major_formatter(PercentFormatter(1))


def _draw_over_steps(
    axis: Axes, calibration: "Calibration", values: "Tensor", colour: np.ndarray
) -> None:
    """Draws values (H,) over the steps ahead, with a marker each where they are few."""
    steps = range(1, calibration.horizon + 1)
    marker = "o" if calibration.horizon <= 30 else None
    axis.plot(steps, values, color=colour, marker=marker, markersize=3)


def _name_levels(axis: Axes, levels: list[_Level]) -> None:
    """Names each level beside its line, or just above the last name."""
    lowest = 0.0
    for level in levels:
        height = max(level.value, lowest)
        axis.annotate(
            f"{100 * level.value:g} %",
            (1.03, height),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize="small",
            color=level.colour,
        )
        lowest = height + 0.085


@explains_arguments
@styled
def innovations_figure(
    run: "FilterRun", time_step: float = 1.0, names: list[str] | None = None
) -> Figure:
    """Draws the innovations of each measured value over their standard deviation.

    The legend says how many are outside of 95 %, and how many were not measured. One of
    a value that was known exactly beforehand has no deviation, and is not drawn.

    Raises:
        SettingError: The names are not one a measured value.
    """
    from gpmpc.estimation import FilterRun

    check_kind("run", run, FilterRun, "what KalmanFilter.run returns")
    stds = run.innovation_covariances.diagonal(dim1=-2, dim2=-1).sqrt()
    innovations = run.innovations.detach().cpu().numpy()
    deviations = stds.detach().cpu().numpy()
    is_drawn = np.isfinite(innovations) & (deviations > 0)
    normalized = np.full_like(innovations, np.nan)
    np.divide(innovations, deviations, out=normalized, where=is_drawn)
    missing = 1 - np.isfinite(innovations).mean(axis=0)
    p = normalized.shape[1]
    times = time_step * np.arange(len(normalized))
    if names is None:
        names = [f"y{i + 1}" for i in range(p)]
    if len(names) != p:
        raise SettingError("names", f"must be {p}, one a measured value; got {names}")
    figure, axes = make_figure(
        width=7.0,
        height=1.0 + 1.4 * p,
        rows=p,
        title="innovations over their standard deviation",
        sharex=True,
    )
    for i, axis in enumerate(axes.flat):
        _draw_innovations(axis, times, normalized[:, i], missing[i])
        axis.set_ylabel(figure_label(names[i]))
    axes[-1, 0].set_xlabel("time [s]")
    return figure


def _draw_innovations(
    axis: Axes, times: np.ndarray, normalized: np.ndarray, missing: float
) -> None:
    """Draws one value's innovations (K,), NaN where there is nothing to draw.

    ``missing`` is the share that was not measured.
    """
    is_drawn = np.isfinite(normalized)
    drawn = normalized[is_drawn]
    outside = np.nan
    if len(drawn):
        outside = 100 * float((np.abs(drawn) > _NORMAL_95).mean())
    label = f"{outside:.1f} % outside (5 % expected), {100 * missing:.0f} % missing"
    axis.plot(times[is_drawn], drawn, ".", color=BLUE, markersize=3, label=label)
    for limit in (-_NORMAL_95, _NORMAL_95):
        axis.axhline(limit, color=VERMILION, linewidth=0.8)
    axis.legend(loc="upper right", fontsize="small")


@explains_arguments
@styled
def judgement_figure(judgement: "Judgement") -> Figure:
    """Draws the errors over the steps for every predictor.

    Below stand coverage and width of the model's intervals.
    """
    from gpmpc.logs import Judgement

    check_kind("judgement", judgement, Judgement, "what judge returns")
    n = len(judgement.groups)
    figure, axes = make_figure(
        width=2.6 * n,
        height=6.0,
        rows=3,
        columns=n,
        gridspec_kw={"height_ratios": [3, 1.4, 1.4]},
    )
    for group, (above, middle, below) in enumerate(axes.T):
        _draw_errors(above, judgement, group)
        _draw_interval_coverage(middle, judgement, group)
        _draw_interval_width(below, judgement, group)
        for axis in (above, middle, below):
            axis.set_xticks(judgement.steps, [str(step) for step in judgement.steps])
            axis.xaxis.set_minor_locator(NullLocator())
        above.minorticks_off()
        below.set_xlabel("steps ahead")
    axes[1, 0].set_ylabel("coverage")
    axes[2, 0].set_ylabel("width\nover errors")
    legend_below(figure, axes[0])
    figure.align_ylabels(axes[:, 0])
    return figure


def _draw_errors(axis: Axes, judgement: "Judgement", group: int) -> None:
    """Draws the mean errors of a group of states, of the baselines and of the model."""
    baselines = [name for name in judgement.mean if name != "model"]
    for name, (colour, marker) in zip(baselines, _BASELINE_STYLES, strict=False):
        errors = judgement.mean[name][:, group]
        axis.loglog(
            judgement.steps,
            np.where(np.isfinite(errors), errors, np.nan),
            color=colour,
            marker=marker,
            markersize=4,
            linewidth=1,
            label=name,
        )
    axis.loglog(
        judgement.steps,
        judgement.mean["model"][:, group],
        color=BLUE,
        marker="o",
        linewidth=2,
        label="model",
    )
    axis.set(
        title=figure_label(judgement.groups[group]),
        ylabel=f"mean error [{figure_label(judgement.units[group])}]",
    )
    if not any((errors[:, group] > 0).any() for errors in judgement.mean.values()):
        axis.set_yscale("linear")  # of a state that never moves
    else:
        _label_by_numbers(axis)


def _draw_interval_coverage(axis: Axes, judgement: "Judgement", group: int) -> None:
    """Draws how many errors of a group the model's intervals hold, and should."""
    coverage = judgement.coverage[:, group]
    low, high = judgement.coverage_interval[:, group].T
    bars = np.maximum([coverage - low, high - coverage], 0)
    axis.errorbar(judgement.steps, coverage, bars, color=BLUE, marker="o", capsize=3)
    axis.axhline(judgement.level, color="0.6", linewidth=0.8)
    shown = np.concatenate([coverage, low])
    lowest = shown[np.isfinite(shown)].min(initial=0.55)
    axis.set(xscale="log", ylim=(lowest - 0.05, 1.05))


def _draw_interval_width(axis: Axes, judgement: "Judgement", group: int) -> None:
    """Draws how wide the model's intervals are over what the errors of a group are."""
    width = judgement.width[:, group]
    width = np.where(np.isfinite(width) & (width > 0), width, np.nan)
    axis.loglog(judgement.steps, width, color=BLUE, marker="s")
    axis.axhline(1.0, color="0.6", linewidth=0.8)
    shown = width[np.isfinite(width)]
    axis.set_ylim(shown.min(initial=0.5) / 1.5, 1.5 * shown.max(initial=2.0))
    _label_by_numbers(axis)


def _label_by_numbers(axis: Axes) -> None:
    """Labels a logarithmic axis of values so that at least two numbers stand at it."""
    low, high = axis.get_ylim()
    plain_numbers(axis.yaxis, few=high < 100 * low)


@explains_arguments
@styled
def inspection_figure(inspection: "Inspection") -> Figure:
    """Draws each channel over the time, with its gaps, on one page.

    Of more than 24 the first are drawn, which the title says.
    """
    from gpmpc.logs import Inspection

    check_kind("inspection", inspection, Inspection, "what inspect_log returns")
    over_rows = inspection.streams["rate [Hz]"].isna().all()
    channels = list(inspection.lines.items())[:_CHANNELS_PER_PAGE]
    if not channels:
        return _empty_page(inspection.title)
    columns = 2 if len(channels) > 6 else 1
    rows = -(-len(channels) // columns)
    figure, axes = make_figure(
        width=10, height=1.1 * rows + 1, rows=rows, columns=columns, sharex=True
    )
    for axis, (name, (times, values)) in zip(axes.T.flat, channels, strict=False):
        axis.plot(times, values, color=BLUE, linewidth=0.7)
        for begin, end in inspection.gaps[:_MOST_GAPS]:
            axis.axvspan(begin, end, color=ORANGE, alpha=0.4, linewidth=0)
        axis.set_ylabel(
            figure_label(name), rotation=0, ha="right", va="center", fontsize=7
        )
        axis.tick_params(labelsize=7)
    for axis in axes[-1]:
        axis.set_xlabel("row" if over_rows else "time [s]")
    for axis in axes.T.flat[len(channels) :]:
        axis.set_visible(False)
    title = inspection.title
    if len(inspection.lines) > len(channels):
        title += f" (the first {len(channels)} of {len(inspection.lines)} channels)"
    figure.suptitle(figure_label(title), fontsize=10)
    return figure


def _empty_page(title: str) -> Figure:
    """Draws the page of a log without a channel of numbers."""
    figure, ((axis,),) = make_figure(width=10, height=2)
    axis.set_axis_off()
    axis.text(0.5, 0.5, "no channel of numbers", ha="center", va="center")
    figure.suptitle(figure_label(title), fontsize=10)
    return figure
