"""Gaussian process dynamics models: data, training (GPyTorch), and the frozen posterior that predicts."""

from gpmpc.gp.dynamics import DynamicsModel
from gpmpc.gp.evaluation import evaluation
from gpmpc.gp.posterior import GPPosterior
from gpmpc.gp.residual import Affine, ResidualModel
from gpmpc.gp.scaling import Scaling, identity, min_max, standardize
from gpmpc.gp.training import SoftLimits, Trainer, Training, train
from gpmpc.gp.transitions import Transitions

__all__ = [
    "Affine",
    "DynamicsModel",
    "GPPosterior",
    "ResidualModel",
    "Scaling",
    "SoftLimits",
    "Trainer",
    "Training",
    "Transitions",
    "evaluation",
    "identity",
    "min_max",
    "standardize",
    "train",
]
