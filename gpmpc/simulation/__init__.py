"""Closed loops of a controller and a plant, or of a controller and a learned model.

``closed_loop`` flies once, ``closed_loops`` many seeds at the same time, and
``cascade_loop`` two controllers at two rates. Noise and disturbances are arguments. The
result is a ``Rollout``. None of these loops filters: a filter is a ``Controller`` of
your own around a ``GPMPC``, as ``FilteredControl`` of
``benchmarks/disturbance_states.py`` is.
"""

from gpmpc.simulation._cascade_loop import Cascade, cascade_loop
from gpmpc.simulation._disturbances import Disturbance, Dropout, Gust, Replaced
from gpmpc.simulation._loop import Trial, closed_loop, closed_loops, rehearse
from gpmpc.simulation._rollout import Rollout
from gpmpc.simulation._simulator import ModelLoop, Noise
from gpmpc.step import Step

__all__ = [
    "Cascade",
    "Disturbance",
    "Dropout",
    "Gust",
    "ModelLoop",
    "Noise",
    "Replaced",
    "Rollout",
    "Step",
    "Trial",
    "cascade_loop",
    "closed_loop",
    "closed_loops",
    "rehearse",
]
