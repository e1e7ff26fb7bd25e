"""Gaussian beliefs pushed through learned models, and the local models that control needs of that."""

from gpmpc.propagation.linearization import Linearization, MeanEquivalence
from gpmpc.propagation.local_model import LocalModel, linearize, rollout
from gpmpc.propagation.moment_matching import MomentMatching, best_propagator
from gpmpc.propagation.monte_carlo import MonteCarlo
from gpmpc.propagation.propagator import Propagation, Propagator
from gpmpc.propagation.sensitivity import Sensitivity, differentiate
from gpmpc.propagation.unscented import Unscented

__all__ = [
    "Linearization",
    "LocalModel",
    "MeanEquivalence",
    "MomentMatching",
    "MonteCarlo",
    "Propagation",
    "Propagator",
    "Sensitivity",
    "Unscented",
    "best_propagator",
    "differentiate",
    "linearize",
    "rollout",
]
