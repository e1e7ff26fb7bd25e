"""Draws one recorded flight: how it tracked, what acted, how long it took.

Cao, Lai and Alam (2017), figures 2 to 4, show positions and inputs over time. The tube
here is what the controller predicted one step before, with two standard deviations.
"""

import textwrap
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gpmpc._angles import whole_turns
from gpmpc._calls import explains_arguments
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
    broken,
    check_run,
    figure_label,
    gaps_of,
    legend_below,
    make_figure,
    name_of,
    names_in_words,
    plain_numbers,
    styled,
    turns_of,
)

if TYPE_CHECKING:
    from gpmpc.recording import Run

_BOUND = GREY
_STAGES = {"model": BLUE, "build": SKY, "solve": VERMILION}
_LEVELS = {"suspicious": ORANGE, "lost": VERMILION}


def expected(run: "Run", states: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Returns means and standard deviations (K, j) that were predicted one step before.

    They are NaN where nothing was: at the first step, where the plan before was not
    applied, and where the step before was lost. What is predicted is the state itself:
    the noise that the plan leaves out belongs to it.
    """
    shape = (len(run.times), len(states))
    mean = np.full(shape, np.nan)
    std = np.full(shape, np.nan)
    if run.plan_means.shape[1] > 1:
        noise_std = _unplanned_noise(run)
        (after,) = np.nonzero((np.diff(run.steps) == 1) & ~run.failed[:-1])
        mean[after + 1] = run.plan_means[after][:, 1, states]
        planned_std = run.plan_stds[after][:, 1, states]
        std[after + 1] = np.hypot(planned_std, noise_std[states])
    return mean, std


def _unplanned_noise(run: "Run") -> np.ndarray:
    """Returns standard deviations (n,) of the noise that the plans leave out."""
    n = len(run.state_names)
    words = run.metadata.get("run", {}).get("noise_std", "").split()
    try:
        deviations = np.array(words, dtype=float)
    except ValueError:  # metadata of others
        return np.zeros(n)
    if len(deviations) != n or not np.isfinite(deviations).all():
        return np.zeros(n)
    return deviations


class _Tracked(NamedTuple):
    """A state that follows a reference, at K steps."""

    title: str  # its name with its unit
    unit: str
    gaps: np.ndarray  # rows before which steps are lost
    jumps: np.ndarray  # rows at which its reference moves by a full turn
    values: np.ndarray  # (K,) as they were flown
    reference: np.ndarray  # (K,)
    expected: np.ndarray  # (K,) mean that was predicted one step before
    expected_std: np.ndarray  # (K,)

    @property
    def breaks(self) -> np.ndarray:
        """Rows before which a line of its reference is broken."""
        return np.union1d(self.gaps, self.jumps)


@explains_arguments
@styled
def tracking_figure(run: "Run") -> Figure:
    """Draws every tracked state and angle over time against its reference.

    Below it stand the error of tracking, and the error of the prediction one step
    ahead with its tube, where something was predicted.
    """
    check_run(run)
    tracked_states = _tracked_states(run)
    n = len(tracked_states)
    is_predicted = any(
        np.isfinite(state.expected_std).any() for state in tracked_states
    )
    figure, axes = make_figure(
        width=2.9 * max(n, 2),
        height=6.2 if is_predicted else 4.8,
        rows=3 if is_predicted else 2,
        columns=n,
        title=_title_of(run),
        sharex=True,
        gridspec_kw={"height_ratios": [3, 2, 2] if is_predicted else [3, 2]},
    )
    tube = "$\\pm 2\\sigma$ of the prediction, " + _noise_in_words(run)
    unit_of_last = None
    for column, state in zip(axes.T, tracked_states, strict=True):
        _draw_path(column[0], run.times, state)
        _draw_error(column[1], run.times, state)
        if is_predicted:
            _draw_prediction_error(column[2], run.times, state, tube)
        _mark_failures(run, *column)
        column[-1].set_xlabel("time [s]")
        if state.unit != unit_of_last:
            column[1].set_ylabel(name_of("tracking\nerror", state.unit))
            if is_predicted:
                column[2].set_ylabel(name_of("prediction\nerror", state.unit))
        unit_of_last = state.unit
    legend_below(figure, axes.flat)
    figure.align_ylabels(axes[:, 0])
    return figure


def _tracked_states(run: "Run") -> list[_Tracked]:
    """Returns the tracked states and the angles of a run; all states if it names none.

    Of an angle, reference and prediction stand at the turn that is nearest to where it
    was.
    """
    settings = run.metadata.get("run", {})
    units = run.metadata.get("units", {})
    labels = _names_in_words(run)
    angles = settings.get("angles", "").split()
    tracked_names = [*settings.get("tracked", "").split(), *angles]
    all_names = list(run.state_names)
    # Each once, in the order in which they are named.
    names = [name for name in dict.fromkeys(tracked_names) if name in all_names]
    names = names or all_names
    indices = [all_names.index(name) for name in names]
    means, stds = expected(run, indices)
    tracked_states = []
    for column, (name, index) in enumerate(zip(names, indices, strict=True)):
        values = run.states[:, index]
        reference = run.references[:, index]
        mean = means[:, column]
        if name in angles:
            reference = reference + whole_turns(values - reference)
            mean = mean + whole_turns(values - mean)
        unit = units.get(f"state.{name}", "")
        tracked_states.append(
            _Tracked(
                title=name_of(name, unit, labels),
                unit=unit,
                gaps=gaps_of(run),
                jumps=turns_of(reference) if name in angles else np.empty(0, int),
                values=values,
                reference=reference,
                expected=mean,
                expected_std=stds[:, column],
            )
        )
    return tracked_states


def _names_in_words(run: "Run") -> dict[str, str]:
    """Returns what states and inputs of a recording are called in figures."""
    z_is_down = run.metadata.get("frames", {}).get("z axis") != "up"
    return names_in_words(run.metadata.get("pose", {}), z_is_down)


def _draw_path(axis: Axes, times: np.ndarray, state: _Tracked) -> None:
    """Draws a state over time against its reference."""
    axis.plot(
        broken(times, state.gaps),
        broken(state.values, state.gaps),
        color=FLOWN,
        linewidth=1.6,
        label="flown",
    )
    axis.plot(
        broken(times, state.breaks),
        broken(state.reference, state.breaks),
        color=REFERENCE,
        linewidth=1.2,
        linestyle=DASHED,
        label="reference",
    )
    axis.set_title(state.title)


def _draw_error(axis: Axes, times: np.ndarray, state: _Tracked) -> None:
    """Draws how far a state is from its reference over time."""
    axis.axhline(0, color=REFERENCE, linewidth=1, linestyle=DASHED)
    error = state.values - state.reference
    axis.plot(
        broken(times, state.breaks),
        broken(error, state.breaks),
        color=FLOWN,
        linewidth=1.2,
    )


def _draw_prediction_error(
    axis: Axes, times: np.ndarray, state: _Tracked, tube: str
) -> None:
    """Draws how far a state is from what was predicted one step before, with a tube."""
    axis.fill_between(
        times,
        -2 * state.expected_std,
        2 * state.expected_std,
        color=TUBE,
        alpha=0.7,
        linewidth=0,
        label=tube,
    )
    axis.plot(times, state.values - state.expected, color=FLOWN, linewidth=1.0)


def _noise_in_words(run: "Run") -> str:
    """Returns which noise the tube of a prediction holds."""
    if "noise_std" in run.metadata.get("run", {}):
        return "the model's noise included"
    return "as planned"


@explains_arguments
@styled
def inputs_figure(run: "Run") -> Figure:
    """Draws what acted, over time, with its bounds."""
    check_run(run)
    m = len(run.input_names)
    units = run.metadata.get("units", {})
    labels = _names_in_words(run)
    figure, axes = make_figure(
        width=7.2,
        height=1.6 * m + 1.0,
        rows=m,
        title=_title_of(run),
        sharex=True,
    )
    for i, (axis, name) in enumerate(zip(axes.flat, run.input_names, strict=True)):
        values = run.inputs[:, i]
        axis.step(
            *_until_steps_end(run, values),
            where="post",
            color=FLOWN,
            linewidth=1.4,
            label="applied",
        )
        _draw_bounds(axis, values, run.input_bounds[:, i])
        axis.set_ylabel(name_of(name, units.get(f"input.{name}", ""), labels))
        _mark_failures(run, axis)
    axes[-1, 0].set_xlabel("time [s]")
    legend_below(figure, axes.flat)
    figure.align_ylabels(axes[:, 0])
    return figure


@explains_arguments
@styled
def timing_figure(run: "Run") -> Figure:
    """Draws the parts of the time of every decision, and the totals' distribution."""
    check_run(run)
    figure, ((over_time, distribution),) = make_figure(
        width=8.4,
        height=3.6,
        columns=2,
        title=_title_of(run),
        gridspec_kw={"width_ratios": [3, 2]},
    )
    milliseconds = 1e3 * run.timings
    totals = np.sort(milliseconds[:, -1])
    if totals.any():
        totals = totals[totals > 0]  # a controller that was not asked took no time
    _draw_stages(over_time, run, milliseconds)
    _limit_height(over_time, totals)
    _draw_distribution(distribution, totals)
    legend_below(figure, [over_time])
    return figure


def _draw_stages(axis: Axes, run: "Run", milliseconds: np.ndarray) -> None:
    """Stacks the parts (K, 4) of the decisions' times over the time."""
    edges, bottom = _until_steps_end(run, np.zeros(len(milliseconds)))
    stages = zip(_STAGES.items(), milliseconds.T, strict=False)
    for (name, colour), stage in stages:
        _, values = _until_steps_end(run, stage)
        top = bottom + values
        axis.stairs(
            top[:-1],
            edges,
            baseline=bottom[:-1],
            fill=True,
            color=colour,
            label=name,
        )
        bottom = top
    axis.set(xlabel="time [s]", ylabel="time of a decision [ms]")


def _limit_height(axis: Axes, totals: np.ndarray) -> None:
    """Limits an axis to the usual of the sorted times, and says how many are above.

    A first step that compiles, and those that waited for a core, would leave nothing to
    be seen of the others.
    """
    almost_largest = float(np.quantile(totals, 0.98, method="inverted_cdf"))
    median = float(np.median(totals))
    ceiling = 1.15 * min(almost_largest, 5 * median) or 1.0
    axis.set_ylim(0, ceiling)
    count_above = int((totals > ceiling).sum())
    if count_above:
        axis.set_title(
            f"{count_above} of {len(totals)} steps above, "
            f"up to {_duration(totals[-1])}",
            fontsize="small",
        )


def _draw_distribution(axis: Axes, totals: np.ndarray) -> None:
    """Draws the cumulative distribution of sorted times, with median and 99 %."""
    shares = np.arange(1, len(totals) + 1) / len(totals)
    axis.step(totals, shares, where="post", color=FLOWN)
    shortest = totals[0]
    longest = totals[-1]
    if shortest > 0 and longest > 5 * shortest:
        axis.set_xscale("log")
        plain_numbers(axis.xaxis, few=longest < 300 * shortest)
    median, almost_all = np.quantile(totals, [0.5, 0.99]).tolist()
    for value in (median, almost_all):
        axis.axvline(value, color=_BOUND, linewidth=1, linestyle=DASHED)
    axis.set_title(
        f"median {_duration(median)}, 99 % below {_duration(almost_all)}",
        fontsize="small",
    )
    axis.set(
        ylim=(0, 1.02), xlabel="time of a decision [ms]", ylabel="share of the steps"
    )


def _step_ends(run: "Run") -> np.ndarray:
    """Returns the times at which steps end (K,) [s]."""
    duration = float(np.min(np.diff(run.times), initial=np.inf))
    return run.times + (duration if np.isfinite(duration) else 1.0)


def _until_steps_end(run: "Run", values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns times and values (K,) that hold until their steps end.

    Where steps are lost, and behind the last one, a time is added at which they do; the
    value there is NaN before lost steps, and the last one again at the end.
    """
    gaps = gaps_of(run)
    ends = _step_ends(run)
    # The times that are added stand where ``broken`` puts its NaN.
    times = np.insert(run.times, gaps, ends[gaps - 1])
    held_values = broken(values, gaps)
    return np.append(times, ends[-1]), np.append(held_values, values[-1])


def _duration(milliseconds: float) -> str:
    """Returns a time in words, with three digits."""
    if milliseconds < 999.5:
        return f"{milliseconds:.3g} ms"
    return f"{milliseconds / 1e3:.3g} s"


def _title_of(run: "Run") -> str:
    """Returns the command that was run, or the file."""
    command = run.metadata.get("run", {}).get("command", "")
    title = command if command.startswith("gpmpc") else str(run.path)
    return figure_label(textwrap.fill(title, 90, max_lines=2, placeholder=" ..."))


def _draw_bounds(axis: Axes, inputs: np.ndarray, bounds: np.ndarray) -> None:
    """Draws bounds as lines where they are near, else as words.

    They are far where the input would be flat beside them.
    """
    low = float(inputs.min())
    high = float(inputs.max())
    span = max(high - low, 1e-3 * max(abs(low), abs(high), 1e-3))
    finite_bounds = bounds[np.isfinite(bounds)]
    is_near = (low - 2 * span <= finite_bounds) & (finite_bounds <= high + 2 * span)
    near_bounds = finite_bounds[is_near]
    for bound in near_bounds:
        axis.axhline(bound, color=_BOUND, linestyle=DASHED, linewidth=1, label="bound")
    low = min([low, *near_bounds])
    high = max([high, *near_bounds])
    height = max(high - low, span)
    axis.set_ylim(low - 0.12 * height, high + 0.25 * height)
    if len(near_bounds) < len(finite_bounds):
        axis.annotate(
            "bounds " + " and ".join(f"{bound:g}" for bound in finite_bounds),
            (0.995, 0.97),
            xycoords="axes fraction",
            ha="right",
            va="top",
            fontsize="small",
            color=_BOUND,
        )


def _mark_failures(run: "Run", *axes: Axes) -> None:
    """Marks steps whose decision was not applied; shades suspicious and lost ones."""
    begins = run.times.tolist()
    ends = _step_ends(run).tolist()
    for axis in axes:
        for level, colour in _LEVELS.items():
            for first, last in _spans(run.judgements == level):
                axis.axvspan(
                    begins[first],
                    ends[last],
                    color=colour,
                    alpha=0.15,
                    linewidth=0,
                    label=level,
                    zorder=-1,
                )
        for time in run.times[run.failed]:
            axis.axvline(
                time,
                color=ORANGE,
                linewidth=1,
                alpha=0.6,
                label="failed solve",
                zorder=0,
            )


def _spans(is_true: np.ndarray) -> list[tuple[int, int]]:
    """Returns first and last of every series of steps (K,) that are true."""
    changes = np.flatnonzero(np.diff(np.concatenate([[0], is_true, [0]])))
    return [(int(first), int(end) - 1) for first, end in changes.reshape(-1, 2)]
