"""Dynamics models: the protocol, and models made of a known part and a learned one."""

from gpmpc._dynamics import DynamicsModel, Linearized, linearize, linearize_by_autograd
from gpmpc.models._features import Features, Lags
from gpmpc.models._nominal import Affine, CasadiFunction, KnownModel
from gpmpc.models._residual import ResidualModel
from gpmpc.models._roll_out import RollOut
from gpmpc.models._storage import load_model, save_model
from gpmpc.models._wrapper import DelayedModel, DisturbedModel, NoisyModel

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
    "NoisyModel",
    "ResidualModel",
    "RollOut",
    "linearize",
    "linearize_by_autograd",
    "load_model",
    "save_model",
]
