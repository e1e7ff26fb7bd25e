"""Dynamics models: the protocol, and models made of a known part and a learned one."""

from gpmpc._dynamics import DynamicsModel, Linearized, linearize, linearize_by_autograd
from gpmpc.models._delay import DelayedModel
from gpmpc.models._disturbance import DisturbedModel
from gpmpc.models._features import Features, Lags
from gpmpc.models._nominal import Affine, CasadiFunction, KnownModel, linearize_function
from gpmpc.models._residual import ResidualModel, train_residual
from gpmpc.models._roll_out import RollOut
from gpmpc.models._storage import load_model, save_model
from gpmpc.models._wrapper import Wrapper

__all__ = [
    "Affine",
    "CasadiFunction",
    "DelayedModel",
    "DisturbedModel",
    "DynamicsModel",
    "Features",
    "KnownModel",
    "Lags",
    "Linearized",
    "ResidualModel",
    "RollOut",
    "Wrapper",
    "linearize",
    "linearize_by_autograd",
    "linearize_function",
    "load_model",
    "save_model",
    "train_residual",
]
