"""Figures of one recorded flight.

Cao, Lai and Alam (2017), figures 2 to 4, show positions and inputs over time. The tube
here is what the controller expected one step before, with two standard deviations.
"""

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gpmpc._angles import whole_turns
from gpmpc.plotting._style import (
    BLUE,
    DASHED,
    FLOWN,
    GREY,
    ORANGE,
    REFERENCE,
    SKY,
    TUBE,
    VERMILION,
    legend_below,
    make_figure,
    name_of,
    plain_numbers,
    styled,
)

if TYPE_CHECKING:
    from gpmpc.recording import Run

_BOUND = GREY
_STAGES = {"model": BLUE, "build": SKY, "solve": VERMILION}


def expected(run: "Run", states: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Returns means and standard deviations (K, j) that were predicted one step before.

    NaN where nothing was.

    What is predicted is the state itself: the noise that the plan leaves out belongs to
    it.
    """
    mean, std = np.full((2, len(run.times), len(states)), np.nan)
    if run.plan_means.shape[1] > 1:
        noise = np.zeros(len(run.state_names))
        noise_std = run.metadata.get("run", {}).get("noise_std", "").split()
        if len(noise_std) == len(noise):
            noise = np.array(noise_std, dtype=float)
        mean[1:] = run.plan_means[:-1, 1, states]
        std[1:] = np.hypot(run.plan_stds[:-1, 1, states], noise[states])
    return mean, std


@styled
def tracking_figure(run: "Run") -> Figure:
    """Draws every tracked state and angle over time against its reference.

    Below it stands the error with the tube.
    """
    said = run.metadata.get("run", {})
    names = list(run.state_names)
    units = run.metadata.get("units", {})
    angles = said.get("angles", "").split()
    z_down = run.metadata.get("frames", {}).get("z axis") != "up"
    tracked = dict.fromkeys([*said.get("tracked", "").split(), *angles])
    states = [names.index(name) for name in tracked if name in names] or list(
        range(len(names))
    )
    mean, std = expected(run, states)
    n = len(states)
    heights = {"height_ratios": [3, 2]}
    figure, axes = make_figure(
        2.9 * max(n, 2), 4.8, 2, n, _title_of(run), sharex=True, gridspec_kw=heights
    )
    dashed: Any = {"color": REFERENCE, "linestyle": DASHED}
    before = None
    for (above, below), i, predicted, deviation in zip(
        axes.T, states, mean.T, std.T, strict=True
    ):
        state = run.states[:, i]
        reference = run.references[:, i]
        unit = units.get(f"state.{names[i]}", "")
        if names[i] in angles:  # at the turn that is nearest to where it was
            reference = reference + whole_turns(state - reference)
            predicted = predicted + whole_turns(state - predicted)
        above.plot(run.times, state, color=FLOWN, linewidth=1.6, label="flown")
        above.plot(run.times, reference, linewidth=1.2, label="reference", **dashed)
        above.set_title(name_of(names[i], unit, z_down))
        below.axhline(0, linewidth=1, **dashed)
        low = predicted - reference - 2 * deviation
        high = predicted - reference + 2 * deviation
        tube = {
            "color": TUBE,
            "alpha": 0.7,
            "linewidth": 0,
            "label": "expected one step before, noise included, $\\pm 2\\sigma$",
        }
        below.fill_between(run.times, low, high, **tube)
        below.plot(run.times, state - reference, color=FLOWN, linewidth=1.2)
        _mark_failures(run, above, below)
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
    units = run.metadata.get("units", {})
    figure, axes = make_figure(7.2, 1.6 * m + 1.0, m, 1, _title_of(run), sharex=True)
    for axis, name, values, bounds in zip(
        axes.flat, run.input_names, run.inputs.T, run.input_bounds.T, strict=True
    ):
        until_end = np.append(
            values, values[-1]
        )  # the last one holds until its step ends
        axis.step(
            _edges(run),
            until_end,
            where="post",
            color=FLOWN,
            linewidth=1.4,
            label="applied",
        )
        _draw_bounds(axis, values, bounds)
        axis.set_ylabel(name_of(name, units.get(f"input.{name}", "")))
        _mark_failures(run, axis)
    axes[-1, 0].set_xlabel("time [s]")
    legend_below(figure, axes.flat)
    figure.align_ylabels(axes[:, 0])
    return figure


@styled
def timing_figure(run: "Run") -> Figure:
    """Draws the parts of the time of every decision, and the totals' distribution."""
    milliseconds = 1e3 * run.timings
    widths = {"width_ratios": [3, 2]}
    figure, ((over_time, distribution),) = make_figure(
        8.4, 3.6, 1, 2, _title_of(run), gridspec_kw=widths
    )
    bottom = np.zeros(len(run.times))
    for (name, colour), stage in zip(_STAGES.items(), milliseconds.T, strict=False):
        over_time.stairs(
            bottom + stage,
            _edges(run),
            baseline=bottom,
            fill=True,
            color=colour,
            label=name,
        )
        bottom = bottom + stage
    total = np.sort(milliseconds[:, -1])
    if total.any():
        total = total[total > 0]  # a controller that was not asked took no time
    # A first step that compiles, and those that waited for a core, would leave nothing
    # to be seen of the others.
    most_of_them = float(np.quantile(total, 0.98, method="inverted_cdf"))
    ceiling = 1.15 * min(most_of_them, 5 * float(np.median(total))) or 1.0
    over_time.set(
        xlabel="time [s]", ylabel="time of a decision [ms]", ylim=(0, ceiling)
    )
    if beyond := int((total > ceiling).sum()):
        over_time.set_title(
            f"{beyond} of {len(total)} steps above, up to {_duration(total[-1])}",
            fontsize="small",
        )
    distribution.step(
        total, np.arange(1, len(total) + 1) / len(total), where="post", color=FLOWN
    )
    if total[0] > 0 and total[-1] > 5 * total[0]:
        distribution.set_xscale("log")
        plain_numbers(distribution.xaxis, few=total[-1] < 300 * total[0])
    median, most = np.quantile(total, [0.5, 0.99]).tolist()
    for value in (median, most):
        distribution.axvline(value, color=_BOUND, linewidth=1, linestyle=DASHED)
    distribution.set_title(
        f"median {_duration(median)}, 99 % below {_duration(most)}", fontsize="small"
    )
    distribution.set(
        ylim=(0, 1.02), xlabel="time of a decision [ms]", ylabel="share of the steps"
    )
    legend_below(figure, [over_time])
    return figure


def _edges(run: "Run") -> np.ndarray:
    """Times at which steps begin, and the end of the last one (K + 1,) [s]."""
    width = run.times[1] - run.times[0] if len(run.times) > 1 else 1.0
    return np.append(run.times, run.times[-1] + width)


def _duration(milliseconds: float) -> str:
    if milliseconds < 999.5:
        return f"{milliseconds:.3g} ms"
    return f"{milliseconds / 1e3:.3g} s"


def _title_of(run: "Run") -> str:
    """Returns what was run: the command, or the file."""
    command = run.metadata.get("run", {}).get("command", "")
    title = command if command.startswith("gpmpc") else str(run.path)
    return textwrap.fill(title, 90, max_lines=2, placeholder=" ...")


def _draw_bounds(axis: Axes, inputs: np.ndarray, bounds: np.ndarray) -> None:
    """Draws bounds as lines where they are near, else as words.

    They are far where the input would be flat beside them.
    """
    low = float(inputs.min())
    high = float(inputs.max())
    span = max(high - low, 1e-3 * max(abs(low), abs(high), 1e-3))
    limits = bounds[np.isfinite(bounds)]
    near = limits[(low - 2 * span <= limits) & (limits <= high + 2 * span)]
    for limit in near:
        axis.axhline(limit, color=_BOUND, linestyle=DASHED, linewidth=1, label="bound")
    low = min([low, *near])
    high = max([high, *near])
    axis.set_ylim(
        low - 0.12 * max(high - low, span), high + 0.25 * max(high - low, span)
    )
    if len(near) < len(limits):
        place: Any = {
            "xycoords": "axes fraction",
            "ha": "right",
            "va": "top",
            "fontsize": "small",
            "color": _BOUND,
        }
        axis.annotate(
            "bounds " + " and ".join(f"{limit:g}" for limit in limits),
            (0.995, 0.97),
            **place,
        )


_LEVELS = {"suspicious": ORANGE, "lost": VERMILION}


def _spans(steps: np.ndarray) -> list[tuple[int, int]]:
    """Returns first and behind the last of every series of steps (K,) that are true."""
    changes = np.flatnonzero(np.diff(np.concatenate([[0], steps, [0]])))
    return [(int(first), int(end)) for first, end in changes.reshape(-1, 2)]


def _mark_failures(run: "Run", *axes: Axes) -> None:
    """Marks steps whose decision was not applied; shades suspicious and lost ones."""
    edges = _edges(run).tolist()
    for axis in axes:
        for level, colour in _LEVELS.items():
            for first, end in _spans(run.judgements == level):
                shade: Any = {"color": colour, "alpha": 0.15, "linewidth": 0}
                axis.axvspan(edges[first], edges[end], label=level, zorder=-1, **shade)
        for time in run.times[run.failed]:
            axis.axvline(
                time,
                color=ORANGE,
                linewidth=1,
                alpha=0.6,
                label="failed solve",
                zorder=0,
            )
