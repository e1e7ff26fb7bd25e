"""Gaussian beliefs pushed through learned models."""

from gpmpc.propagation.moment_matching import MomentMatching
from gpmpc.propagation.propagator import Propagation, Propagator

__all__ = ["MomentMatching", "Propagation", "Propagator"]
