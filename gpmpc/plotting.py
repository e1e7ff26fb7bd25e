"""Problem: figures of the results; the only importer of matplotlib.

Every function returns a ``Figure`` made without pyplot, so nothing global is touched and no window opens.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, NullLocator


@dataclass(frozen=True)
class Panel:
    """One panel of ``error_over_size``.

    Attributes:
        title: Above the panel.
        draws: Errors of all draws by training size.
        paper: The paper's figure by training size.
    """

    title: str
    draws: Mapping[int, Sequence[float]]
    paper: Mapping[int, float]


def error_over_size(panels: Sequence[Panel], label: str) -> Figure:
    """Boxes and draws of an error over the training size, with the paper's points on them; logarithmic."""
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.6 * columns, 3.4 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis, panel in zip(axes, panels, strict=False):
        sizes = sorted(panel.draws)
        axis.set_title(panel.title)
        if not sizes:  # every fit failed
            axis.set_axis_off()
            continue
        positions = range(len(sizes))
        axis.boxplot(
            [list(panel.draws[size]) for size in sizes],
            positions=positions,
            whis=(0, 100),
            widths=0.5,
            patch_artist=True,
            boxprops={"facecolor": "#cfe0f3", "edgecolor": "#1f4e79"},
            whiskerprops={"color": "#1f4e79"},
            capprops={"color": "#1f4e79"},
            medianprops={"color": "#1f4e79", "linewidth": 1.8},
        )
        for position, size in enumerate(sizes):  # the draws themselves: a box hides that there are two modes
            draws = list(panel.draws[size])
            aside = [0.18 * ((7 * i) % 11 / 5 - 1) for i in range(len(draws))]
            axis.plot([position + a for a in aside], draws, ".", color="#1f4e79", alpha=0.55, markersize=4)
        known = [(position, panel.paper[size]) for position, size in enumerate(sizes) if size in panel.paper]
        if known:
            axis.plot(*zip(*known, strict=True), "o", color="#c0392b", markersize=6, zorder=3, label="paper")
            axis.legend(loc="upper right", frameon=False)
        axis.set_yscale("log")
        axis.yaxis.set_minor_locator(NullLocator())
        axis.yaxis.set_minor_formatter(NullFormatter())
        axis.set_xticks(list(positions), [str(size) for size in sizes])
        axis.grid(axis="y", color="0.9")
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
    for axis in axes[len(panels) :]:
        axis.set_visible(False)
    figure.supxlabel("training points N")
    figure.supylabel(label)
    return figure
