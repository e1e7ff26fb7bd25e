"""Gaussian process dynamics models: data, training (GPyTorch), and the frozen posterior that predicts."""

from gpmpc.gp.budget import Budget
from gpmpc.gp.dynamics import DynamicsModel
from gpmpc.gp.penalties import SoftLimits
from gpmpc.gp.posterior import GPPosterior
from gpmpc.gp.residual import Affine, ResidualModel
from gpmpc.gp.scaling import Scaling, identity, min_max, standardize
from gpmpc.gp.training import Trainer, Training, train
from gpmpc.gp.transitions import Transitions

__all__ = [
    "Affine",
    "Budget",
    "DynamicsModel",
    "GPPosterior",
    "ResidualModel",
    "Scaling",
    "SoftLimits",
    "Trainer",
    "Training",
    "Transitions",
    "identity",
    "min_max",
    "standardize",
    "train",
]
