"""Exact moment matching through SE-ARD GPs, alone or around an affine model."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gpmpc.exceptions import UnsupportedModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.gp._backend import host_arrays
from gpmpc.propagation._composition import Composition, Latent
from gpmpc.propagation._moments import moments, moments_with_jacobian
from gpmpc.propagation._propagator import NoisyPropagator, Propagation, Propagator, checked_input
from gpmpc.propagation._sensitivity import Sensitivity
from gpmpc.propagation._unscented import Unscented


class MomentMatching(NoisyPropagator):
    """Exact moment matching through a ``GPPosterior``, or a ``ResidualModel`` with an affine nominal part.

    Args:
        diagonal: Takes the outputs as independent: only the diagonal of the predicted covariance is computed, at a
            quarter of the cost for six outputs.
        process_noise: Adds the noise variance sn2 to the predicted covariance. The paper's tables do not.
    """

    def __init__(self, diagonal: bool = False, process_noise: bool = False):
        super().__init__(process_noise)
        self.diagonal = diagonal

    def propagate(self, model: Any, belief: Gaussian, input: Tensor | None = None) -> Propagation:
        """Moves a belief N(mu, S) one step on; see ``Propagator.propagate``.

        Raises:
            UnsupportedModel: There is no closed form for this model.
        """
        return self._moved(model, belief, input, derivatives=False)[0]

    def differentiate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity]:
        """``propagate`` with all derivatives in closed form, compiled or by torch."""
        moved, composition, f = self._moved(model, belief, input, derivatives=True)
        sensitivity = composition.sensitivity(belief.covariance, f)
        return moved, sensitivity.of_variances() if self.diagonal else sensitivity

    def _moved(
        self, model: Any, belief: Gaussian, input: Tensor | None, derivatives: bool
    ) -> tuple[Propagation, Composition, Latent]:
        """A belief moved one step on, how the model is composed, and the moments of its latent functions."""
        input, composition = checked_input(model, belief, input), Composition.of(model)
        if composition is None:
            raise UnsupportedModel(
                "MomentMatching needs a GPPosterior, or a ResidualModel of an Affine nominal model and one; "
                f"got {type(model).__name__}. "
                "Possible with any model: MeanEquivalence, Linearization, Unscented, MonteCarlo"
            )
        (seen, control), gp, cross = composition.seen(belief, input), composition.f, composition.A is not None
        arrays = host_arrays(gp.weights, seen.mean, seen.covariance, control)
        if arrays is not None:
            f = self._compiled(gp, seen.mean.shape[:-1], arrays[1:], derivatives)
        elif derivatives:
            f = moments_with_jacobian(gp, seen, control, self.diagonal, cross)
        else:
            f = Latent(*moments(gp, seen, control, self.diagonal))
        return self._projected(model, *composition.moments(belief, input, f)), composition, f

    def _compiled(self, f: GPPosterior, batch: torch.Size, arrays: Sequence[Any], derivatives: bool) -> Latent:
        """The moments of f by ``gpmpc._kernels``."""
        from gpmpc import _kernels as kernels  # loads numba

        (mean, S, u), n, count = arrays, f.state_dim, batch.numel()
        flat = mean.reshape(count, n), S.reshape(count, n, n), u.reshape(count, f.input_dim)
        found = kernels.moments(f.packed, *flat, self.diagonal, derivatives)
        parts: list[Any] = [torch.from_numpy(part.reshape(*batch, *part.shape[1:])) for part in found]
        parts[0] += f.offset
        return Latent(*parts)


def best_propagator(model: Any) -> Propagator:
    """Makes ``MomentMatching()`` where a model has exact moments, else ``Unscented()``."""
    return Unscented() if Composition.of(model) is None else MomentMatching()
