"""Figure of whether a filter's covariances are right: its innovations in units of their standard deviations."""

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from gpmpc.plotting._style import BLUE, VERMILION, styled

if TYPE_CHECKING:
    from gpmpc.estimation import FilterRun


@styled
def innovations_figure(run: "FilterRun", time_step: float = 1.0, names: list[str] | None = None) -> Figure:
    """Draws each measured value's innovations over their standard deviation, and the share outside of 95 %."""
    deviations = run.innovation_covariances.diagonal(dim1=-2, dim2=-1).sqrt()
    white = (run.innovations / deviations).cpu().numpy()
    p, times = white.shape[1], time_step * np.arange(len(white))
    figure = Figure(figsize=(7.0, 1.0 + 1.4 * p), layout="constrained")
    for i, axis in enumerate(figure.subplots(p, 1, sharex=True, squeeze=False).ravel()):
        seen = np.isfinite(white[:, i])
        outside = 100 * float((np.abs(white[seen, i]) > 1.96).mean()) if seen.any() else np.nan
        label = f"{outside:.1f} % outside (5 % expected), {100 * float((~seen).mean()):.0f} % missing"
        axis.plot(times[seen], white[seen, i], ".", color=BLUE, markersize=3, label=label)
        for limit in (-1.96, 1.96):
            axis.axhline(limit, color=VERMILION, linewidth=0.8)
        axis.set_ylabel(names[i] if names is not None else f"y{i + 1}")
        axis.legend(loc="upper right", fontsize="small")
        axis.set_xlabel("time [s]" if i == p - 1 else "")
    figure.suptitle("innovations over their standard deviation")
    return figure
