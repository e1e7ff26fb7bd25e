"""Figures of one recorded flight, in the manner of the paper's: tracking, inputs, computation time.

Cao, Lai and Alam (2017), figures 2 to 4, show positions and inputs over time. The tube here is what the controller
expected one step before, with two standard deviations.
"""

import textwrap
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gpmpc.plotting._style import (
    BLUE,
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
    from gpmpc.recording import Run

FLOWN, REFERENCE, TUBE, _BOUND, _FAILED = BLUE, VERMILION, SKY, GREY, ORANGE
_STAGES = ("model", "build", "solve")
_STAGE_COLOURS = (BLUE, SKY, VERMILION)


def _tracked_of(run: "Run") -> list[int]:
    """Indices of tracked states and angles, as the recording says; of all where it does not."""
    said, names = run.metadata.get("run", {}), list(run.state_names)
    drawn = dict.fromkeys(f"{said.get('tracked', '')} {said.get('angles', '')}".split())
    return [names.index(name) for name in drawn if name in names] or list(range(len(names)))


def _reference_of(run: "Run", state: int) -> np.ndarray:
    """What a state was to be (K,); of an angle at the turn that is nearest to where it was."""
    reference = run.references[:, state]
    if run.state_names[state] not in run.metadata.get("run", {}).get("angles", "").split():
        return reference
    return reference + 2 * np.pi * np.round((run.states[:, state] - reference) / (2 * np.pi))


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
    """Every axis over time against its reference, and below it the error with the tube."""
    states = _tracked_of(run)
    mean, std = expected(run, states)
    figure = Figure(figsize=(2.9 * max(len(states), 2), 4.8), layout="constrained")
    figure.suptitle(_title_of(run))
    axes = figure.subplots(2, len(states), squeeze=False, sharex=True, gridspec_kw={"height_ratios": [3, 2]})
    for column, i in enumerate(states):
        above, below = axes[:, column]
        reference = _reference_of(run, i)
        above.plot(run.times, run.states[:, i], color=FLOWN, linewidth=1.6, label="flown")
        above.plot(run.times, reference, color=REFERENCE, linewidth=1.2, linestyle=DASHED, label="reference")
        name = run.state_names[i]
        above.set_title(
            name_of(name, _unit(run, f"state.{name}"), run.metadata.get("frames", {}).get("z axis") != "up")
        )
        error, band = mean[:, column] - reference, 2 * std[:, column]
        below.axhline(0, color=REFERENCE, linewidth=1, linestyle=DASHED)
        below.fill_between(
            run.times,
            error - band,
            error + band,
            color=TUBE,
            alpha=0.7,
            linewidth=0,
            label="expected one step before, $\\pm 2\\sigma$",
        )
        below.plot(run.times, run.states[:, i] - reference, color=FLOWN, linewidth=1.2)
        _failures(run, (above, below))
        below.set_xlabel("time [s]")
        units = [_unit(run, f"state.{run.state_names[state]}") for state in states[max(column - 1, 0) : column + 1]]
        if column == 0 or units[0] != units[1]:
            below.set_ylabel(name_of("error", units[-1]))
    legend_below(figure, axes.ravel())
    figure.align_ylabels(axes[:, 0])
    return figure


@styled
def inputs_figure(run: "Run") -> Figure:
    """What acted, over time, with its bounds."""
    m = len(run.input_names)
    figure = Figure(figsize=(7.2, 1.6 * m + 1.0), layout="constrained")
    figure.suptitle(_title_of(run))
    axes = figure.subplots(m, 1, squeeze=False, sharex=True)[:, 0]
    for i, axis in enumerate(axes):
        held = np.append(run.inputs[:, i], run.inputs[-1:, i])  # the last one until its step ends
        axis.step(_edges(run), held, where="post", color=FLOWN, linewidth=1.4, label="applied")
        _bounds(axis, run.inputs[:, i], run.input_bounds[:, i])
        axis.set_ylabel(name_of(run.input_names[i], _unit(run, f"input.{run.input_names[i]}")))
        _failures(run, (axis,))
    axes[-1].set_xlabel("time [s]")
    legend_below(figure, axes)
    figure.align_ylabels(axes)
    return figure


@styled
def timing_figure(run: "Run") -> Figure:
    """Where the time of every decision went, and how the totals are distributed."""
    milliseconds = 1e3 * run.timings
    figure = Figure(figsize=(8.4, 3.6), layout="constrained")
    figure.suptitle(_title_of(run))
    over_time, distribution = figure.subplots(1, 2, gridspec_kw={"width_ratios": [3, 2]})
    edges, bottom = _edges(run), np.zeros(len(run.times))
    for j, (name, colour) in enumerate(zip(_STAGES, _STAGE_COLOURS, strict=True)):
        top = bottom + milliseconds[:, j]
        over_time.stairs(top, edges, baseline=bottom, fill=True, color=colour, label=name)
        bottom = top
    total = np.sort(milliseconds[:, -1])
    total = total[total > 0] if total.any() else total  # a controller that was not asked took no time
    # A first step that compiles, and those that waited for a core, would leave nothing to be seen of the others.
    ceiling = 1.15 * min(total[max(0, int(np.ceil(0.98 * len(total))) - 1)], 5 * float(np.median(total))) or 1.0
    over_time.set_ylim(0, ceiling)
    beyond = int((total > ceiling).sum())
    if beyond:
        over_time.set_title(f"{beyond} of {len(total)} steps above, up to {_duration(total[-1])}", fontsize="small")
    over_time.set_xlabel("time [s]")
    over_time.set_ylabel("time of a decision [ms]")
    distribution.step(total, np.arange(1, len(total) + 1) / len(total), where="post", color=FLOWN)
    if total[0] > 0 and total[-1] > 5 * total[0]:
        distribution.set_xscale("log")
        plain_numbers(distribution.xaxis, few=total[-1] < 300 * total[0])
    median, most = (float(np.quantile(total, share)) for share in (0.5, 0.99))
    for value in (median, most):
        distribution.axvline(value, color=_BOUND, linewidth=1, linestyle=DASHED)
    distribution.set_title(f"median {_duration(median)}, 99 % below {_duration(most)}", fontsize="small")
    distribution.set_ylim(0, 1.02)
    distribution.set_xlabel("time of a decision [ms]")
    distribution.set_ylabel("share of the steps")
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


def _unit(run: "Run", field: str) -> str:
    return run.metadata.get("units", {}).get(field, "")


def _bounds(axis: Axes, inputs: np.ndarray, bounds: np.ndarray) -> None:
    """Lines where they are near; where they are so far that the input would be flat beside them, in words."""
    low, high = float(inputs.min()), float(inputs.max())
    span = max(high - low, 1e-3 * max(abs(low), abs(high), 1e-3))
    limits = [limit for limit in bounds if np.isfinite(limit)]
    near = [limit for limit in limits if low - 2 * span <= limit <= high + 2 * span]
    for limit in near:
        axis.axhline(limit, color=_BOUND, linestyle=DASHED, linewidth=1, label="bound")
    low, high = min([low, *near]), max([high, *near])
    axis.set_ylim(low - 0.12 * max(high - low, span), high + 0.25 * max(high - low, span))
    if len(near) < len(limits):
        text = "bounds " + " and ".join(f"{limit:g}" for limit in limits)
        axis.annotate(
            text, (0.995, 0.97), xycoords="axes fraction", ha="right", va="top", fontsize="small", color=_BOUND
        )


def _failures(run: "Run", axes: tuple[Axes, ...]) -> None:
    """A mark at every step whose decision was not applied."""
    times = run.times[run.failed]
    for axis in axes:
        for j, time in enumerate(times):
            axis.axvline(
                time, color=_FAILED, linewidth=1, alpha=0.6, label="failed solve" if j == 0 else None, zorder=0
            )
