"""Gaussian process dynamics models: data, training (GPyTorch), and the frozen posterior that predicts."""

from gpmpc.dynamics import DynamicsModel
from gpmpc.gp.budget import Budget
from gpmpc.gp.evaluation import evaluation
from gpmpc.gp.gpytorch_posterior import KernelPosterior
from gpmpc.gp.gpytorch_training import fit
from gpmpc.gp.many import train_many
from gpmpc.gp.penalties import SoftLimits
from gpmpc.gp.posterior import GPPosterior
from gpmpc.gp.residual import Affine, ResidualModel
from gpmpc.gp.scaling import Scaling, centre, identity, min_max, standardize
from gpmpc.gp.sparse import sparse_posterior
from gpmpc.gp.sparse_training import SparseTrainer, SparseTraining
from gpmpc.gp.training import Trainer, Training, train
from gpmpc.gp.transitions import Transitions

__all__ = [
    "Affine",
    "Budget",
    "DynamicsModel",
    "GPPosterior",
    "KernelPosterior",
    "ResidualModel",
    "Scaling",
    "SoftLimits",
    "SparseTrainer",
    "SparseTraining",
    "Trainer",
    "Training",
    "Transitions",
    "centre",
    "evaluation",
    "fit",
    "identity",
    "min_max",
    "sparse_posterior",
    "standardize",
    "train",
    "train_many",
]
