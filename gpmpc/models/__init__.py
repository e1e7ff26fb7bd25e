"""Dynamics models: the protocol, and models made of a known part and a learned one."""

from gpmpc.dynamics import DynamicsModel, Linearized, linearize, linearize_by_autograd
from gpmpc.models.delay import DelayedModel
from gpmpc.models.disturbance import DisturbedModel
from gpmpc.models.features import Features, Lags
from gpmpc.models.nominal import Affine, CasadiFunction, KnownModel
from gpmpc.models.residual import ResidualModel, train_residual
from gpmpc.models.storage import load_model, save_model

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
    "linearize",
    "linearize_by_autograd",
    "load_model",
    "save_model",
    "train_residual",
]
