"""Dynamics models: the protocol, and models made of a known part and a learned one."""

from gpmpc.dynamics import DynamicsModel, Linearized, linearize, linearize_by_autograd
from gpmpc.models.nominal import Affine, CasadiNominal
from gpmpc.models.residual import ResidualModel, load_residual_model, save_residual_model

__all__ = [
    "Affine",
    "CasadiNominal",
    "DynamicsModel",
    "Linearized",
    "ResidualModel",
    "linearize",
    "linearize_by_autograd",
    "load_residual_model",
    "save_residual_model",
]
