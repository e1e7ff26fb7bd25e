"""Problem: move a Gaussian belief over the state one step on through a learned model, behind one call."""

from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor

from gpmpc.gaussian import Gaussian


@dataclass(frozen=True)
class Propagation:
    """A belief moved one step on, with what else is known of the step.

    Attributes:
        belief: N(mean, covariance) of the next state; the covariance is symmetric positive semidefinite.
        cross_covariance: Cov[x, x+] (*batch, n, n).
        deficit: How far below zero the covariance's smallest eigenvalue was before the projection (*batch,). More
            than round-off of the largest entry says that the model is too nearly noise-free for double precision.
    """

    belief: Gaussian
    cross_covariance: Tensor
    deficit: Tensor


class Propagator(Protocol):
    """One way to push a Gaussian through a model."""

    def __call__(self, model: Any, belief: Gaussian, input: Tensor) -> Gaussian:
        """The next state's belief from the state's belief and a certain control (*batch, m)."""

    def propagate(self, model: Any, belief: Gaussian, input: Tensor) -> Propagation:
        """The same with the input-output covariance and the size of the projection."""
