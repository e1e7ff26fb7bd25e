"""Gaussian beliefs pushed through learned models, and the local models that control needs of that."""

from gpmpc.propagation._linearization import Linearization, MeanEquivalence
from gpmpc.propagation._local_model import linearize, rollout
from gpmpc.propagation._moment_matching import MomentMatching, best_propagator
from gpmpc.propagation._points import MonteCarlo, Unscented
from gpmpc.propagation._propagator import (
    Propagation,
    Propagator,
    Sensitivity,
    differentiate,
)

__all__ = [
    "Linearization",
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
