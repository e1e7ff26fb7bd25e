"""Logs of real systems: reading, checking, learning from them, and judging what was learned."""

from gpmpc.logs._fitting import fit_nominal
from gpmpc.logs._inspection import Inspection, inspect_log
from gpmpc.logs._judging import Judgement, judge
from gpmpc.logs._kinematics import RigidBody
from gpmpc.logs._learning import Learned, learn
from gpmpc.logs._log import Log
from gpmpc.logs._mapping import LogMapping
from gpmpc.logs._reading import read_log
from gpmpc.logs._rollouts import LogModel, MultirotorNominal
from gpmpc.logs._storage import (
    LogDynamics,
    SavedModel,
    load_flyable,
    load_learned,
    save_learned,
)

__all__ = [
    "Inspection",
    "Judgement",
    "Learned",
    "Log",
    "LogDynamics",
    "LogMapping",
    "LogModel",
    "MultirotorNominal",
    "RigidBody",
    "SavedModel",
    "fit_nominal",
    "inspect_log",
    "judge",
    "learn",
    "load_flyable",
    "load_learned",
    "read_log",
    "save_learned",
]
