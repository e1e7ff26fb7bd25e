"""Gaussian process models of dynamics: data, training, and posteriors that predict.

``train`` or a ``Trainer`` makes a ``GPPosterior`` of ``Transitions``; a
``SparseTrainer`` does so for tens of thousands of rows. ``from_gpytorch`` and
``KernelPosterior`` take models that GPyTorch has trained. ``append_transitions``,
``remove_points`` and ``SlidingWindow`` change a posterior's data. ``save_posterior``
and ``load_posterior`` keep it in a file.
"""

from gpmpc.gp._backend import backend
from gpmpc.gp._gpytorch import from_gpytorch, to_gpytorch
from gpmpc.gp._gpytorch_checks import exact_inference
from gpmpc.gp._gpytorch_posteriors import KernelPosterior
from gpmpc.gp._kernel import Hyperparameters
from gpmpc.gp._online import (
    SlidingWindow,
    append_points,
    append_transitions,
    remove_points,
)
from gpmpc.gp._posterior import GPPosterior
from gpmpc.gp._scaling import Scaling, centre, identity, min_max, standardize
from gpmpc.gp._search import SoftLimits
from gpmpc.gp._sparse_training import SparseTrainer, informative_points
from gpmpc.gp._storage import load_metadata, load_posterior, save_posterior
from gpmpc.gp._training import Trainer, Training, train
from gpmpc.gp._transitions import Transitions

__all__ = [
    "GPPosterior",
    "Hyperparameters",
    "KernelPosterior",
    "Scaling",
    "SlidingWindow",
    "SoftLimits",
    "SparseTrainer",
    "Trainer",
    "Training",
    "Transitions",
    "append_points",
    "append_transitions",
    "backend",
    "centre",
    "exact_inference",
    "from_gpytorch",
    "identity",
    "informative_points",
    "load_metadata",
    "load_posterior",
    "min_max",
    "remove_points",
    "save_posterior",
    "standardize",
    "to_gpytorch",
    "train",
]
