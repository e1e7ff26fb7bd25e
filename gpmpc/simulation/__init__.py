"""Closed loops of a controller and a plant or a model.

With noise, disturbances and many seeds. None of them filters: a filter is a
``Controller`` of one's own around a ``GPMPC``, as ``FilteredControl`` of
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
