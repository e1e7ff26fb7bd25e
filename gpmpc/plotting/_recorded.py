"""Figures of one recorded flight, of what is in a log, and of how what was learned from it fares.

Cao, Lai and Alam (2017), figures 2 to 4, show positions and inputs over time. The tube here is what the controller
expected one step before, with two standard deviations.
"""

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gpmpc.plotting._style import (
    BLUE,
    COLOURS,
    DASHED,
    GREY,
    ORANGE,
    SKY,
    VERMILION,
    legend_below,
    name_of,
    plain_numbers,
    styled,
)

if TYPE_CHECKING:
    from gpmpc.logs import Inspection, Judgement
    from gpmpc.recording import Run


FLOWN, REFERENCE, TUBE, _BOUND, _FAILED = BLUE, VERMILION, SKY, GREY, ORANGE
_STAGES = {"model": BLUE, "build": SKY, "solve": VERMILION}
_MODEL, _GAP = BLUE, ORANGE
_OTHERS = (GREY, *COLOURS[1:5])  # told apart without colour by their markers
_MARKERS = ("s", "^", "v", "D", "P")
_PER_PAGE = 24  # channels drawn


def expected(run: "Run", states: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Means and standard deviations (K, j) that were predicted one step before; NaN where nothing was.

    What is predicted is the state itself: the noise that the plan leaves out belongs to it.
    """
    mean, std = np.full((2, len(run.times), len(states)), np.nan)
    if run.plan_means.shape[1] > 1:
        mean[1:] = run.plan_means[:-1, 1, states]
        std[1:] = np.hypot(run.plan_stds[:-1, 1, states], _noise(run)[states])
    return mean, std


def _noise(run: "Run") -> np.ndarray:
    """Standard deviations of a next state's noise (n,); zero where the recording does not say."""
    n = len(run.state_names)
    try:
        noise = np.array(run.metadata["run"]["noise_std"].split(), dtype=float)
    except (KeyError, ValueError):
        return np.zeros(n)
    return noise if noise.shape == (n,) and np.isfinite(noise).all() else np.zeros(n)


@styled
def tracking_figure(run: "Run") -> Figure:
    """Draws every tracked state and angle over time against its reference, and below it the error with the tube."""
    said, names, units = run.metadata.get("run", {}), list(run.state_names), run.metadata.get("units", {})
    angles, z_down = said.get("angles", "").split(), run.metadata.get("frames", {}).get("z axis") != "up"
    tracked = dict.fromkeys([*said.get("tracked", "").split(), *angles])
    states = [names.index(name) for name in tracked if name in names] or list(range(len(names)))
    mean, std = expected(run, states)
    figure = Figure(figsize=(2.9 * max(len(states), 2), 4.8), layout="constrained")
    figure.suptitle(_title_of(run))
    axes = figure.subplots(2, len(states), squeeze=False, sharex=True, gridspec_kw={"height_ratios": [3, 2]})
    dashed: Any = {"color": REFERENCE, "linestyle": DASHED}
    before = None
    for (above, below), i, predicted, deviation in zip(axes.T, states, mean.T, std.T, strict=True):
        state, reference, unit = run.states[:, i], run.references[:, i], units.get(f"state.{names[i]}", "")
        if names[i] in angles:  # at the turn that is nearest to where it was
            reference = reference + 2 * np.pi * np.round((state - reference) / (2 * np.pi))
        above.plot(run.times, state, color=FLOWN, linewidth=1.6, label="flown")
        above.plot(run.times, reference, linewidth=1.2, label="reference", **dashed)
        above.set_title(name_of(names[i], unit, z_down))
        below.axhline(0, linewidth=1, **dashed)
        low, high = predicted - reference - 2 * deviation, predicted - reference + 2 * deviation
        tube = {"color": TUBE, "alpha": 0.7, "linewidth": 0, "label": "expected one step before, $\\pm 2\\sigma$"}
        below.fill_between(run.times, low, high, **tube)
        below.plot(run.times, state - reference, color=FLOWN, linewidth=1.2)
        _failures(run, (above, below))
        below.set_xlabel("time [s]")
        if unit != before:
            below.set_ylabel(name_of("error", unit))
        before = unit
    legend_below(figure, axes.flat)
    figure.align_ylabels(axes[:, 0])
    return figure


@styled
def inputs_figure(run: "Run") -> Figure:
    """Draws what acted, over time, with its bounds."""
    m = len(run.input_names)
    figure = Figure(figsize=(7.2, 1.6 * m + 1.0), layout="constrained")
    figure.suptitle(_title_of(run))
    axes = figure.subplots(m, 1, squeeze=False, sharex=True)[:, 0]
    for axis, name, values, bounds in zip(axes, run.input_names, run.inputs.T, run.input_bounds.T, strict=True):
        until_end = np.append(values, values[-1])  # the last one holds until its step ends
        axis.step(_edges(run), until_end, where="post", color=FLOWN, linewidth=1.4, label="applied")
        _bounds(axis, values, bounds)
        axis.set_ylabel(name_of(name, run.metadata.get("units", {}).get(f"input.{name}", "")))
        _failures(run, (axis,))
    axes[-1].set_xlabel("time [s]")
    legend_below(figure, axes)
    figure.align_ylabels(axes)
    return figure


@styled
def timing_figure(run: "Run") -> Figure:
    """Draws where the time of every decision went, and how the totals are distributed."""
    milliseconds = 1e3 * run.timings
    figure = Figure(figsize=(8.4, 3.6), layout="constrained")
    figure.suptitle(_title_of(run))
    over_time, distribution = figure.subplots(1, 2, gridspec_kw={"width_ratios": [3, 2]})
    bottom = np.zeros(len(run.times))
    for (name, colour), stage in zip(_STAGES.items(), milliseconds.T, strict=False):
        over_time.stairs(bottom + stage, _edges(run), baseline=bottom, fill=True, color=colour, label=name)
        bottom = bottom + stage
    total = np.sort(milliseconds[:, -1])
    total = total[total > 0] if total.any() else total  # a controller that was not asked took no time
    # A first step that compiles, and those that waited for a core, would leave nothing to be seen of the others.
    most_of_them = float(np.quantile(total, 0.98, method="inverted_cdf"))
    ceiling = 1.15 * min(most_of_them, 5 * float(np.median(total))) or 1.0
    over_time.set(xlabel="time [s]", ylabel="time of a decision [ms]", ylim=(0, ceiling))
    if beyond := int((total > ceiling).sum()):
        over_time.set_title(f"{beyond} of {len(total)} steps above, up to {_duration(total[-1])}", fontsize="small")
    distribution.step(total, np.arange(1, len(total) + 1) / len(total), where="post", color=FLOWN)
    if total[0] > 0 and total[-1] > 5 * total[0]:
        distribution.set_xscale("log")
        plain_numbers(distribution.xaxis, few=total[-1] < 300 * total[0])
    median, most = np.quantile(total, [0.5, 0.99]).tolist()
    for value in (median, most):
        distribution.axvline(value, color=_BOUND, linewidth=1, linestyle=DASHED)
    distribution.set_title(f"median {_duration(median)}, 99 % below {_duration(most)}", fontsize="small")
    distribution.set(ylim=(0, 1.02), xlabel="time of a decision [ms]", ylabel="share of the steps")
    legend_below(figure, [over_time])
    return figure


def _edges(run: "Run") -> np.ndarray:
    """Times at which steps begin, and the end of the last one (K + 1,) [s]."""
    width = run.times[1] - run.times[0] if len(run.times) > 1 else 1.0
    return np.append(run.times, run.times[-1] + width)


def _duration(milliseconds: float) -> str:
    return f"{milliseconds:.3g} ms" if milliseconds < 999.5 else f"{milliseconds / 1e3:.3g} s"


def _title_of(run: "Run") -> str:
    """Returns what was run: the command, or the file."""
    command = run.metadata.get("run", {}).get("command", "")
    return textwrap.fill(command if command.startswith("gpmpc") else str(run.path), 90, max_lines=2, placeholder=" ...")


def _bounds(axis: Axes, inputs: np.ndarray, bounds: np.ndarray) -> None:
    """Draws lines where they are near; where they are so far that the input would be flat beside them, words."""
    low, high = float(inputs.min()), float(inputs.max())
    span = max(high - low, 1e-3 * max(abs(low), abs(high), 1e-3))
    limits = bounds[np.isfinite(bounds)]
    near = limits[(low - 2 * span <= limits) & (limits <= high + 2 * span)]
    for limit in near:
        axis.axhline(limit, color=_BOUND, linestyle=DASHED, linewidth=1, label="bound")
    low, high = min([low, *near]), max([high, *near])
    axis.set_ylim(low - 0.12 * max(high - low, span), high + 0.25 * max(high - low, span))
    if len(near) < len(limits):
        place: Any = {"xycoords": "axes fraction", "ha": "right", "va": "top", "fontsize": "small", "color": _BOUND}
        axis.annotate("bounds " + " and ".join(f"{limit:g}" for limit in limits), (0.995, 0.97), **place)


def _failures(run: "Run", axes: tuple[Axes, ...]) -> None:
    """Draws a mark at every step whose decision was not applied."""
    for axis in axes:
        for time in run.times[run.failed]:
            axis.axvline(time, color=_FAILED, linewidth=1, alpha=0.6, label="failed solve", zorder=0)


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
    channels = [*inspection.lines.items()][:_PER_PAGE]
    columns = 2 if len(channels) > 6 else 1
    rows = -(-len(channels) // columns)
    figure = Figure(figsize=(10, 1.1 * rows + 1), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True)
    for axis, (name, line) in zip(axes.T.flat, channels, strict=False):
        axis.plot(*line, color=_MODEL, linewidth=0.7)
        for begin, end in inspection.gaps[:200]:
            axis.axvspan(begin, end, color=_GAP, alpha=0.4, linewidth=0)
        axis.set_ylabel(name, rotation=0, ha="right", va="center", fontsize=7)
        axis.tick_params(labelsize=7)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    for axis in list(axes.T.flat)[len(channels) :]:
        axis.set_visible(False)
    figure.suptitle(inspection.title, fontsize=10)
    return figure
