"""Draws results as figures and animations, with matplotlib.

Every function returns a ``Figure`` made without pyplot, so nothing global is touched
and no window opens.
"""

from gpmpc.plotting._animation import animate
from gpmpc.plotting._film import film
from gpmpc.plotting._flown import flight_figure
from gpmpc.plotting._models import (
    calibration_figure,
    innovations_figure,
    inspection_figure,
    judgement_figure,
)
from gpmpc.plotting._recorded import inputs_figure, timing_figure, tracking_figure
from gpmpc.plotting._style import png
from gpmpc.plotting._sweeps import Series, over_variable, search_figure

__all__ = [
    "Series",
    "animate",
    "calibration_figure",
    "film",
    "flight_figure",
    "innovations_figure",
    "inputs_figure",
    "inspection_figure",
    "judgement_figure",
    "over_variable",
    "png",
    "search_figure",
    "timing_figure",
    "tracking_figure",
]
