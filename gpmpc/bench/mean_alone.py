"""Problem: methods for the stochastic problem are to solve the deterministic one, beside methods that know no other.

The mean goes through the model; no covariance is predicted, so the expected cost is the cost of the means.
"""

import torch

from gpmpc.dynamics import DynamicsModel
from gpmpc.gaussian import Gaussian
from gpmpc.propagation.propagator import Propagation, checked_input
from gpmpc.propagation.sensitivity import Sensitivity

Tensor = torch.Tensor


class MeanAlone:
    """A propagator whose next states are certain."""

    def __call__(self, model: DynamicsModel, belief: Gaussian, input: Tensor | None = None) -> Gaussian:
        """The next mean with no covariance."""
        return self.propagate(model, belief, input).belief

    def propagate(self, model: DynamicsModel, belief: Gaussian, input: Tensor | None = None) -> Propagation:
        """See ``Propagator.propagate``."""
        return self.differentiate(model, belief, input)[0]

    def differentiate(
        self, model: DynamicsModel, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity]:
        """``propagate`` with its derivatives."""
        moved, A, B = model.predict_with_jacobian(belief.mean, checked_input(model, belief, input))
        batch, (k, n), m = A.shape[:-2], A.shape[-2:], B.shape[-1]

        def zero(*shape: int) -> Tensor:
            return torch.zeros((*batch, *shape), dtype=A.dtype, device=A.device)

        sensitivity = Sensitivity(A, zero(k, n, n), B, zero(k, k, n), zero(k, k, n, n), zero(k, k, m))
        return Propagation(Gaussian(moved.mean, zero(k, k)), zero(n, k), zero()), sensitivity
