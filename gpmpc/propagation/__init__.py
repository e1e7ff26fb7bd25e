"""Moves Gaussian beliefs through models, and linearises that for controllers.

``Linearization``, ``MomentMatching``, ``Unscented``, ``MonteCarlo`` and
``MeanEquivalence`` are the propagators. ``rollout`` applies one along inputs,
``differentiate`` gives its derivatives, and ``linearize`` a linear system of mean and
covariance root.

``_propagator`` holds the protocol and derivatives by autograd; ``_linearization``,
``_points`` and ``_moment_matching`` the propagators, the last on top of ``_moments``,
the exact moments of GPs; ``_local_model`` the linear system that controllers take.
"""

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
