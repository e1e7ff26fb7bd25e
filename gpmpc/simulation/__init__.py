"""Closed loops: a controller on a plant or on a model, with noise, disturbances and many seeds."""

from gpmpc.simulation.batched_loop import closed_loops
from gpmpc.simulation.cascade_loop import CascadeRollout, cascade_loop
from gpmpc.simulation.disturbances import Disturbance, Dropout, Gust, Replaced
from gpmpc.simulation.loop import Rollout, Step, closed_loop, rehearse
from gpmpc.simulation.recording_callback import cascade_recording_callback, recording_callback
from gpmpc.simulation.systems import ModelLoop, Noise
from gpmpc.simulation.trials import Trial, trials

__all__ = [
    "CascadeRollout",
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
    "cascade_recording_callback",
    "closed_loop",
    "closed_loops",
    "recording_callback",
    "rehearse",
    "trials",
]
