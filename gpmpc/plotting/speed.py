"""Figures of what a control step costs over the size of the GPs and the horizon."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

COLOURS = {"paper's form": "#a4343a", "zero order": "#1f4e79", "mean only": "#3a7d44"}


def speed(rows: Sequence[Mapping], size: int, horizon: int) -> Figure:
    """Milliseconds a step: above over N at one horizon, below over H at one size; one column for every n.

    A line is the median, the area above it reaches to the 99th percentile; hot caches where both were measured.

    Args:
        rows: Of ``gpmpc.bench.steps``, part ``"step"``.
        size: N of the lower panels.
        horizon: H of the upper panels.
    """
    cache = "hot" if any(row["cache"] == "hot" for row in rows) else "flushed"
    rows = [row for row in rows if row["part"] == "step" and row["cache"] == cache]
    dims = sorted({row["n"] for row in rows})
    figure = Figure(figsize=(3.2 * len(dims) + 0.8, 5.6), layout="constrained")
    axes = figure.subplots(2, len(dims), sharey=True, squeeze=False)
    for column, n in enumerate(dims):
        here = [row for row in rows if row["n"] == n]
        over_size = [row for row in here if row["H"] == horizon]
        over_horizon = [row for row in here if row["N"] == size]
        panels = (
            (over_size, "N", f"training points N (H = {horizon})"),
            (over_horizon, "H", f"horizon H (N = {size})"),
        )
        for axis, (panel, key, label) in zip(axes[:, column], panels, strict=True):
            for what in dict.fromkeys(row["what"] for row in panel):
                line = sorted((row for row in panel if row["what"] == what), key=lambda row: row[key])
                at, median = [row[key] for row in line], [row["median"] for row in line]
                colour = COLOURS.get(what)
                drawn = axis.plot(at, median, "o-", color=colour, markersize=3.5, label=what)[0]
                axis.fill_between(at, median, [row["p99"] for row in line], color=drawn.get_color(), alpha=0.15, lw=0)
            axis.set(xscale="log", yscale="log", xlabel=label)
            ticks = sorted({row[key] for row in panel})
            axis.set_xticks(ticks, [str(tick) for tick in ticks])
            axis.xaxis.set_minor_formatter(NullFormatter())
            axis.yaxis.set_major_locator(LogLocator(10, (1, 2, 5)))
            axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.yaxis.set_minor_locator(NullLocator())
            axis.grid(True, which="major", color="#dddddd", linewidth=0.6)
        axes[0, column].set_title(f"n = {n}, m = {n // 2}")
    for axis in axes[:, 0]:
        axis.set_ylabel("ms a control step")
    named = axes[0, 0].get_legend_handles_labels()
    figure.legend(*named, loc="outside lower center", ncols=3, frameon=False, fontsize=8)
    return figure
