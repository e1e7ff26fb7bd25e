"""Sets how every figure looks: colours, lines, names with units, legends, titles.

``gpmpc.mplstyle`` holds matplotlib's own settings, for scripts too. Lines differ in
their dashes as well as in their colours, so that a black and white print can be read.
"""

import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import DataError, check_kind

if TYPE_CHECKING:
    from gpmpc.recording import Run

BLUE = "#0072b2"
VERMILION = "#d55e00"
GREEN = "#009e73"
_PURPLE = "#cc79a7"
ORANGE = "#e69f00"
SKY = "#56b4e9"
BLACK = "#000000"
GREY = "0.45"
COLOURS = (BLUE, VERMILION, GREEN, _PURPLE, ORANGE, SKY, BLACK, GREY)
FLOWN = BLUE
REFERENCE = VERMILION
TUBE = SKY
PLAN = GREEN
DASHES: tuple[Any, ...] = (
    "-",
    (0, (5, 2)),
    (0, (1.2, 1.6)),
    (0, (6, 2, 1.2, 2)),
    (0, (3, 3)),
    (0, (8, 2)),
)
DASHED = (0, (4, 3))  # of references and bounds
# Inputs of the quadrotor, whose z axis points downwards, in words.
_INPUTS_IN_WORDS = {
    "U1": "thrust U1",
    "ux": "direction ux",
    "uy": "direction uy",
}

# A decorator of functions that make a figure.
styled = mpl.rc_context(fname=Path(__file__).with_name("gpmpc.mplstyle"))


def make_figure(
    width: float,
    height: float,
    rows: int = 1,
    columns: int = 1,
    title: str = "",
    **options: Any,
) -> tuple[Figure, np.ndarray]:
    """Returns a figure, its size in inches, and its axes (rows, columns)."""
    figure = Figure(figsize=(width, height), layout="constrained")
    if title:
        figure.suptitle(title)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def figure_label(text: str) -> str:
    """Returns a text that somebody chose as one that is no formula in a figure."""
    return text.replace("$", r"\$")


def names_in_words(pose: Mapping[str, str], z_down: bool) -> dict[str, str]:
    """Returns what signals of a vehicle are called in figures, by their names.

    Args:
        pose: Which states say where it is and how it is turned, by x, ..., roll, ...
        z_down: Whether its z axis points downwards.
    """
    labels = {
        state: axis for axis, state in pose.items() if axis in ("roll", "pitch", "yaw")
    }
    if z_down and pose:
        labels |= _INPUTS_IN_WORDS
    if z_down and "z" in pose:
        labels[pose["z"]] = f"{figure_label(pose['z'])}, downwards"
    return labels


def name_of(name: str, unit: str = "", labels: Mapping[str, str] | None = None) -> str:
    """Returns the name of a state or input with its unit, as ``z, downwards [m]``.

    ``labels`` are those of ``names_in_words``.
    """
    full = (labels or {}).get(name, figure_label(name))
    unit = figure_label(unit)
    return f"{full} [{unit}]" if unit not in ("", "1", "?") else full


def clipped(text: str, most: int) -> str:
    """Returns a text of at most ``most`` characters; a longer one ends in dots."""
    return text if len(text) <= most else f"{text[: most - 4]} ..."


def plain_numbers(axis: Axis, few: bool) -> None:
    """Labels a logarithmic axis by plain numbers; over few decades by 2 and 5 too."""
    locator = LogLocator(subs=(1, 2, 5)) if few else LogLocator(numticks=5)
    axis.set_major_locator(locator)
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def legend_below(figure: Figure, axes: Iterable[Axes]) -> None:
    """Puts one legend for all axes below them, each label once.

    It has as many columns as the figure's width holds.
    """
    handles = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            handles[label] = handle
    if not handles:
        return
    characters = 11.0 * figure.get_figwidth()  # that fit into a line
    labels = [clipped(label, int(characters) - 6) for label in handles]
    longest = max(map(len, labels))
    columns_that_fit = int(characters / (longest + 6))
    figure.legend(
        list(handles.values()),
        labels,
        loc="outside lower center",
        ncols=max(1, min(len(labels), columns_that_fit)),
    )


@explains_arguments
def png(figure: Figure, dpi: int = 150) -> bytes:
    """Returns the figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def gaps_of(run: "Run") -> np.ndarray:
    """Returns the rows before which steps are lost."""
    return np.flatnonzero(np.diff(run.steps) != 1) + 1


def turns_of(angle: np.ndarray) -> np.ndarray:
    """Returns the rows at which an angle (K,) jumps by a turn."""
    return np.flatnonzero(np.abs(np.diff(angle)) > np.pi) + 1


def broken(values: np.ndarray, breaks: np.ndarray) -> np.ndarray:
    """Returns the values (K, ...) of a line that is broken before some rows."""
    return np.insert(values, breaks, np.nan, axis=0)


def check_run(run: object) -> None:
    """Checks what is to be drawn.

    Raises:
        SettingError: It is no recorded run.
        DataError: It has no step.
    """
    from gpmpc.recording import Run  # here: a report of a sweep does not need it

    check_kind("run", run, Run, "a Run of read_run")
    assert isinstance(run, Run)
    if not len(run.times):
        raise DataError(f"{run.path}: holds no step, there is nothing to draw")
