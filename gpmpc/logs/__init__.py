"""Logs of real systems: reading, checking, learning from them, and judging what was learned."""

from gpmpc.logs.fitting import NominalFit, fit_nominal
from gpmpc.logs.flying import LogDynamics, SavedModel, load_flyable
from gpmpc.logs.inspection import Inspection, inspect_log
from gpmpc.logs.judging import Judgement, judge
from gpmpc.logs.kinematics import Increments, Kinematics, RigidBody
from gpmpc.logs.learning import Candidate, Learned, learn
from gpmpc.logs.log import Finding, Log, LogRun, Windows
from gpmpc.logs.mapping import LogMapping, Signal
from gpmpc.logs.noise import OutputNoise
from gpmpc.logs.nominal import MultirotorNominal, Nominal
from gpmpc.logs.readers import read_streams
from gpmpc.logs.reading import read_log
from gpmpc.logs.rollouts import LogModel
from gpmpc.logs.state_space import StateGroup, StateSpace
from gpmpc.logs.storage import load_learned, save_learned

__all__ = [
    "Candidate",
    "Finding",
    "Increments",
    "Inspection",
    "Judgement",
    "Kinematics",
    "Learned",
    "Log",
    "LogDynamics",
    "LogMapping",
    "LogModel",
    "LogRun",
    "MultirotorNominal",
    "Nominal",
    "NominalFit",
    "OutputNoise",
    "RigidBody",
    "SavedModel",
    "Signal",
    "StateGroup",
    "StateSpace",
    "Windows",
    "fit_nominal",
    "inspect_log",
    "judge",
    "learn",
    "load_flyable",
    "load_learned",
    "read_log",
    "read_streams",
    "save_learned",
]
