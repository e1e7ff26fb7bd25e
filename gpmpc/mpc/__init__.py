"""Controllers: from a state and a reference to an input.

``Problem`` says what a controller makes small (``Tracking``, ``LeastSquares``) and what
it keeps (``Box``, ``Halfspaces``, ``Inequality``). ``GPMPC`` decides by a learned model
and a propagator of ``gpmpc.propagation``; its ``control`` returns a ``Decision``.
``ControlLoop`` calls a controller at every step, acts where a decision fails, and
judges the flight. ``ManyStarts`` searches plans from many first guesses, as for a
swing-up. Other controllers to compare with are in ``gpmpc.mpc.baselines``.
"""

from gpmpc.mpc._controller import Controller, Decision, Reference, Request, Timing
from gpmpc.mpc._cost import LeastSquares, Tracking
from gpmpc.mpc._data_range import BeyondData, beyond_data
from gpmpc.mpc._judgement import FlightJudge, FlightJudgement, Judgement
from gpmpc.mpc._linearization import PredictionSettings
from gpmpc.mpc._policy import ControlLoop
from gpmpc.mpc._riccati import dlqr
from gpmpc.mpc._stability import Stability
from gpmpc.mpc._start_guesses import kicks
from gpmpc.mpc._starts import ManyStarts
from gpmpc.mpc.gp_mpc import GPMPC, NonlinearGPMPC
from gpmpc.mpc.problem import Box, Halfspaces, Inequality, Problem

__all__ = [
    "GPMPC",
    "BeyondData",
    "Box",
    "ControlLoop",
    "Controller",
    "Decision",
    "FlightJudge",
    "FlightJudgement",
    "Halfspaces",
    "Inequality",
    "Judgement",
    "LeastSquares",
    "ManyStarts",
    "NonlinearGPMPC",
    "PredictionSettings",
    "Problem",
    "Reference",
    "Request",
    "Stability",
    "Timing",
    "Tracking",
    "beyond_data",
    "dlqr",
    "kicks",
]
