"""Draws a closed loop as it comes back from ``closed_loop``: one panel a unit."""

import itertools
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gpmpc._angles import whole_turns
from gpmpc._calls import explains_arguments
from gpmpc.exceptions import ShapeError, check_kind
from gpmpc.plotting._style import (
    COLOURS,
    DASHED,
    DASHES,
    GREY,
    ORANGE,
    broken,
    figure_label,
    legend_below,
    make_figure,
    name_of,
    names_in_words,
    styled,
    turns_of,
)

if TYPE_CHECKING:
    from gpmpc.simulation import Rollout
    from gpmpc.systems import System


class _Panel(NamedTuple):
    """Signals of one unit."""

    indices: list[int]
    unit: str


@explains_arguments
@styled
def flight_figure(rollout: "Rollout", system: "System") -> Figure:
    """Draws states against their references, and below them inputs with their bounds.

    Signals of one unit share a panel; one whose unit is not known has its own.

    >>> from gpmpc.plotting import flight_figure
    >>> from gpmpc.systems import pendulum
    >>> flight_figure([], pendulum())
    Traceback (most recent call last):
    gpmpc.exceptions.SettingError: rollout: must be a Rollout of closed_loop; got list

    Args:
        rollout: What ``closed_loop`` returned.
        system: Whose names, units and bounds of inputs are drawn.

    Returns:
        A figure; ``figure.savefig("flight.png")`` writes it.

    Raises:
        SettingError: They are of another kind.
        ShapeError: The flight is of another system.

    See Also:
        ``tracking_figure`` and ``inputs_figure``, which draw a recording.
    """
    # Here: with them everything else loads, which a report of a sweep does not need.
    from gpmpc.simulation import Rollout
    from gpmpc.systems import System

    check_kind("rollout", rollout, Rollout, "a Rollout of closed_loop")
    check_kind("system", system, System, "a System")
    n = len(system.state_names)
    m = len(system.input_names)
    dimensions = (rollout.states.shape[1], rollout.inputs.shape[1])
    if dimensions != (n, m):
        rule = f"{system.name} has {n} states and {m} inputs"
        raise ShapeError(f"{rule}; the flight has {dimensions[0]} and {dimensions[1]}")
    state_panels = _panels(system, system.state_names)
    input_panels = _panels(system, system.input_names)
    count = len(state_panels) + len(input_panels)
    figure, axes = make_figure(
        width=7.2,
        height=1.5 * count + 0.9,
        rows=count,
        title=f"{figure_label(system.name)}, {len(rollout.inputs)} steps",
        sharex=True,
    )
    for axis, panel in zip(axes[:, 0], state_panels, strict=False):
        _draw_states(axis, rollout, system, panel)
    for axis, panel in zip(axes[len(state_panels) :, 0], input_panels, strict=True):
        _draw_inputs(axis, rollout, system, panel)
    for axis in axes[:, 0]:
        for step, _ in rollout.failures:
            axis.axvline(
                rollout.times[step],
                color=ORANGE,
                linewidth=1,
                alpha=0.6,
                label="failed solve",
                zorder=0,
            )
    axes[-1, 0].set_xlabel("time [s]")
    legend_below(figure, axes.flat)
    figure.align_ylabels(axes[:, 0])
    return figure


def _panels(system: "System", names: tuple[str, ...]) -> list[_Panel]:
    """Returns the signals by unit, in the order of their names."""
    panels: list[_Panel] = []
    for index, name in enumerate(names):
        unit = system.units[name]
        same = [panel for panel in panels if panel.unit == unit and unit != "?"]
        if same:
            same[0].indices.append(index)
        else:
            panels.append(_Panel([index], unit))
    return panels


def _draw_states(
    axis: Axes, rollout: "Rollout", system: "System", panel: _Panel
) -> None:
    """Draws states of one unit, each with its reference in its colour."""
    names = [system.state_names[index] for index in panel.indices]
    lines: list[Line2D] = []
    for style, index in zip(_line_styles(len(names)), panel.indices, strict=True):
        values = rollout.states[:, index]
        reference = rollout.references[:, index]
        breaks = np.empty(0, dtype=int)
        if index in system.angle_indices:
            # at the turn that is nearest to where the angle was
            reference = reference + whole_turns(values - reference)
            breaks = turns_of(reference)
        axis.plot(
            broken(rollout.times, breaks),
            broken(reference, breaks),
            color=GREY,
            linestyle=DASHED,
            linewidth=1,
            label="reference or bound",
        )
        lines += axis.plot(rollout.times, values, **style)
    _name_lines(axis, lines, names, panel, system)


def _draw_inputs(
    axis: Axes, rollout: "Rollout", system: "System", panel: _Panel
) -> None:
    """Draws inputs of one unit as steps, with their finite bounds."""
    names = [system.input_names[index] for index in panel.indices]
    lines: list[Line2D] = []
    for style, index in zip(_line_styles(len(names)), panel.indices, strict=True):
        values = rollout.inputs[:, index]
        # The last one holds until its step ends.
        lines += axis.step(
            rollout.times, np.append(values, values[-1]), where="post", **style
        )
        for bound in (system.input_lower[index], system.input_upper[index]):
            if np.isfinite(bound):
                axis.axhline(
                    bound,
                    color=GREY,
                    linestyle=DASHED,
                    linewidth=1,
                    label="reference or bound",
                )
    _name_lines(axis, lines, names, panel, system)


def _line_styles(count: int) -> list[dict[str, Any]]:
    """Returns colours and dashes of lines in one panel, all different up to 42.

    None is grey, as references and bounds are.
    """
    colours = [colour for colour in COLOURS if colour != GREY]
    styles = itertools.product(DASHES, colours)
    return [
        {"color": colour, "linestyle": dashes}
        for dashes, colour in itertools.islice(itertools.cycle(styles), count)
    ]


def _name_lines(
    axis: Axes, lines: list[Line2D], names: list[str], panel: _Panel, system: "System"
) -> None:
    """Names a panel of one line by its axis, one of several by words beside them."""
    if len(names) == 1:
        labels = names_in_words(system.pose, system.z_down)
        axis.set_ylabel(name_of(names[0], panel.unit, labels))
        return
    axis.set_ylabel(f"[{figure_label(panel.unit)}]")
    legend = axis.legend(
        lines,
        [figure_label(name) for name in names],
        loc="center left",
        bbox_to_anchor=(1.0, 0.5),
    )
    legend.set_in_layout(True)
