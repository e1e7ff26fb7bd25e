"""Dynamics models: the protocol, and models made of a known part and a learned one."""

from gpmpc.dynamics import DynamicsModel, Linearized, linearize, linearize_by_autograd

__all__ = ["DynamicsModel", "Linearized", "linearize", "linearize_by_autograd"]
