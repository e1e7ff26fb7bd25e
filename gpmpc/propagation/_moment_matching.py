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
from gpmpc.propagation._propagator import Propagation, Propagator, checked_input, projected
from gpmpc.propagation._sensitivity import Sensitivity
from gpmpc.propagation._unscented import Unscented


class MomentMatching(Propagator):
    """Exact moment matching through a ``GPPosterior``, or a ``ResidualModel`` with an affine nominal part.

    Args:
        diagonal: Takes the outputs as independent: only the diagonal of the predicted covariance is computed, at a
            quarter of the cost for six outputs.
        process_noise: Adds the noise variance sn2 to the predicted covariance. The paper's tables do not.
    """

    def __init__(self, diagonal: bool = False, process_noise: bool = False):
        self.diagonal, self.process_noise = diagonal, process_noise

    def propagate(self, model: Any, belief: Gaussian, input: Tensor | None = None) -> Propagation:
        """Moves a belief N(mu, S) one step on; see ``Propagator.propagate``.

        Raises:
            UnsupportedModel: There is no closed form for this model.
        """
        input = checked_input(model, belief, input)
        composition = self._composition(model)
        seen, control = composition.seen(belief, input)
        found = composition.moments(belief, input, self._latent(composition.f, seen, control))
        return self._projected(model, found)

    def differentiate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity]:
        """``propagate`` with all derivatives in closed form, compiled or by torch."""
        input = checked_input(model, belief, input)
        composition = self._composition(model)
        seen, control = composition.seen(belief, input)
        arrays = host_arrays(composition.f.weights, seen.mean, seen.covariance, control)
        cross = composition.A is not None
        if arrays is None:
            f = moments_with_jacobian(composition.f, seen, control, self.diagonal, cross)
        else:
            f = self._compiled(composition.f, seen.mean.shape[:-1], arrays[1:], cross)
        sensitivity = composition.sensitivity(belief.covariance, f)
        if self.diagonal:
            sensitivity = sensitivity.of_variances()
        return self._projected(model, composition.moments(belief, input, f)), sensitivity

    def _projected(self, model: Any, found: tuple[Tensor, Tensor, Tensor]) -> Propagation:
        return projected(found, model.noise_covariance if self.process_noise else None, self.diagonal)

    def _composition(self, model: Any) -> Composition:
        composition = Composition.of(model)
        if composition is None:
            raise UnsupportedModel(
                "MomentMatching needs a GPPosterior, or a ResidualModel of an Affine nominal model and one; "
                f"got {type(model).__name__}. "
                "Possible with any model: MeanEquivalence, Linearization, Unscented, MonteCarlo"
            )
        return composition

    def _latent(self, f: GPPosterior, belief: Gaussian, input: Tensor) -> Latent:
        """The moments of f, compiled or by torch."""
        arrays = host_arrays(f.weights, belief.mean, belief.covariance, input)
        if arrays is None:
            return Latent(*moments(f, belief, input, self.diagonal))
        return self._compiled(f, belief.mean.shape[:-1], arrays[1:])

    def _compiled(self, f: GPPosterior, batch: torch.Size, arrays: Sequence[Any], cross: bool | None = None) -> Latent:
        """The moments of f by ``gpmpc._kernels``; ``cross`` adds derivatives, with those of J or without."""
        from gpmpc import _kernels as kernels  # loads numba

        mean, S, u = arrays
        n, m = f.state_dim, f.input_dim
        flat = mean.reshape(-1, n), S.reshape(-1, n, n), u.reshape(len(mean.reshape(-1, n)), m)
        if cross is None:
            found = kernels.moments(f.packed, *flat, self.diagonal)
        else:
            found = kernels.moments_with_jacobian(f.packed, *flat, self.diagonal, cross)
        parts: list[Any] = [p if p is None else torch.from_numpy(p.reshape(*batch, *p.shape[1:])) for p in found]
        parts[0] += f.offset
        return Latent(*parts)


def best_propagator(model: Any) -> Propagator:
    """Makes ``MomentMatching()`` where a model has exact moments, else ``Unscented()``."""
    return Unscented() if Composition.of(model) is None else MomentMatching()
