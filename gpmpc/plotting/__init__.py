"""Draws the results; the only package that imports matplotlib.

Every function returns a ``Figure`` made without pyplot, so nothing global is touched and no window opens.
"""

from gpmpc.plotting._animation import animate
from gpmpc.plotting._film import film
from gpmpc.plotting._recorded import inputs_figure, inspection_figure, judgement_figure, timing_figure, tracking_figure
from gpmpc.plotting._results import (
    Curve,
    calibration_figure,
    error_over_size,
    innovations_figure,
    over_settings,
    quality,
    tracking,
)
from gpmpc.plotting._style import png
from gpmpc.plotting._sweeps import Series, over_variable, search_figure

__all__ = [
    "Curve",
    "Series",
    "animate",
    "calibration_figure",
    "error_over_size",
    "film",
    "innovations_figure",
    "inputs_figure",
    "inspection_figure",
    "judgement_figure",
    "over_settings",
    "over_variable",
    "png",
    "quality",
    "search_figure",
    "timing_figure",
    "tracking",
    "tracking_figure",
]
