"""Exact moment matching through SE-ARD GPs f, alone or around an affine model.

    x+ = A x + G u + c + B f(x_s, u_s)

covers what a model with exact moments can be: next states (A = 0, B = I), differences (A = B = I), and the residual of
an affine nominal model, whose f depends on some states and inputs only. With C = Cov[x, B f] = S J' B' (Stein, 1981),

    mu+ = A mu + G u + c + B M,   Sigma+ = A S A' + A C + C' A' + B V B',   Cov[x, x+] = S A' + C

Derivatives follow by the product rule; those by S are kept symmetric in their last two indices.
"""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from gpmpc.exceptions import UnsupportedModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp._backend import host_arrays
from gpmpc.gp._posterior import AffineForm
from gpmpc.propagation._moments import Latent, moments, moments_with_jacobian
from gpmpc.propagation._points import Unscented
from gpmpc.propagation._propagator import (
    NoisyPropagator,
    Propagation,
    Propagator,
    Sensitivity,
    checked_input,
)


class MomentMatching(NoisyPropagator):
    """Exact moment matching through a ``GPPosterior``, or a ``ResidualModel`` with an affine nominal part.

    Of any other model ``propagate`` raises ``UnsupportedModel``.

    Args:
        diagonal: Takes the outputs as independent: only the diagonal of the predicted covariance is computed, at a
            quarter of the cost for six outputs.
        process_noise: Whether the noise variance sn2 is added to the predicted covariance. In the paper's tables it is
            not.
    """

    def __init__(self, diagonal: bool = False, process_noise: bool = True):
        super().__init__(process_noise)
        self.diagonal = diagonal

    def differentiate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity]:
        """``propagate`` with all derivatives in closed form, compiled or by torch."""
        input = checked_input(model, belief, input)
        form, f = self._latent(model, belief, input, derivatives=True)
        d = _derivatives(form, belief.covariance, f)
        if self.diagonal:
            of = torch.eye(
                d.covariance_by_mean.shape[-2], dtype=f.M.dtype, device=f.M.device
            )[..., None]
            by_mean = of * d.covariance_by_mean
            by_input = of * d.covariance_by_input
            by_covariance = of[..., None] * d.covariance_by_covariance
            d = replace(
                d,
                covariance_by_mean=by_mean,
                covariance_by_covariance=by_covariance,
                covariance_by_input=by_input,
            )
        return self._projected(model, *_next_moments(form, belief, input, f)), d

    def _moved(
        self, model: Any, belief: Gaussian, input: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        form, f = self._latent(model, belief, input, derivatives=False)
        return _next_moments(form, belief, input, f)

    def _latent(
        self, model: Any, belief: Gaussian, input: Tensor, derivatives: bool
    ) -> tuple[AffineForm, Latent]:
        """How the model is composed, and the moments of its latent functions, compiled or by torch."""
        if (form := _exact_form(model)) is None:
            raise UnsupportedModel(
                "MomentMatching needs a GPPosterior, or a ResidualModel of an Affine nominal model and one; "
                f"got {type(model).__name__}. "
                "Possible with any model: MeanEquivalence, Linearization, Unscented, MonteCarlo"
            )
        f = form.f
        cross = form.A is not None
        batch = belief.mean.shape[:-1]
        if form.states is not None:
            S = belief.covariance[..., form.states, :][..., form.states]
            belief = Gaussian(belief.mean[..., form.states], S)
            input = input[..., form.inputs]
        if (
            arrays := host_arrays(f.weights, belief.mean, belief.covariance, input)
        ) is None:
            if derivatives:
                return form, moments_with_jacobian(
                    f, belief, input, self.diagonal, cross
                )
            return form, Latent(*moments(f, belief, input, self.diagonal))
        from gpmpc import _kernels as kernels  # loads numba

        mean, S, u = [
            part.reshape(batch.numel(), *part.shape[len(batch) :])
            for part in arrays[1:]
        ]
        found = kernels.moments(f.packed, mean, S, u, self.diagonal, derivatives)
        parts: list[Any] = [
            torch.from_numpy(part.reshape(*batch, *part.shape[1:])) for part in found
        ]
        parts[0] += f.offset
        return form, Latent(*parts)


def best_propagator(model: Any) -> Propagator:
    """Makes ``MomentMatching()`` where a model has exact moments, else ``Unscented()``."""
    return Unscented() if _exact_form(model) is None else MomentMatching()


def _exact_form(model: Any) -> AffineForm | None:
    """The affine form of a model; None where it has none, or one with angles or a tape."""
    form = getattr(model, "affine_form", None)
    return None if form is None or form.angles or form.tape is not None else form


def _next_moments(
    form: AffineForm, belief: Gaussian, input: Tensor, f: Latent
) -> tuple[Tensor, Tensor, Tensor]:
    """mu+ (*batch, n), Sigma+ (*batch, n, n) and Cov[x, x+] (*batch, n, n), by the module's text."""
    M = f.M
    V = f.V
    S = belief.covariance
    A = form.A
    cross = (S if form.states is None else S[..., form.states]) @ f.J.mT
    if form.B is not None:
        M = M @ form.B.mT
        V = form.B @ V @ form.B.mT
        cross = cross @ form.B.mT
    if A is None:
        return M, V, cross
    half = A @ cross
    M = M + (
        belief.mean
        if form.G is None or form.c is None
        else belief.mean @ A.mT + input @ form.G.mT + form.c
    )
    return M, A @ S @ A.mT + half + half.mT + V, S @ A.mT + cross


def _derivatives(form: AffineForm, S: Tensor, f: Latent) -> Sensitivity:
    """The derivatives of mu+ and Sigma+ at a belief with covariance S (*batch, n, n)."""
    A = form.A
    B = form.B
    n = S.shape[-1]
    m = 0 if form.G is None else form.G.shape[1]
    J = _whole(f.J, form.states, n)
    dM_dS = _whole(f.dM_dS, form.states, n, 2)
    dM_du = _whole(f.dM_du, form.inputs, m)
    dV_dmu = _whole(f.dV_dmu, form.states, n)
    dV_dS = _whole(f.dV_dS, form.states, n, 2)
    dV_du = _whole(f.dV_du, form.inputs, m)
    if B is not None:
        J = B @ J
        dM_du = B @ dM_du
        dM_dS = torch.einsum("ia,...acd->...icd", B, dM_dS)
        dV_dmu, dV_du = (
            torch.einsum("ia,jb,...abc->...ijc", B, B, d) for d in (dV_dmu, dV_du)
        )
        dV_dS = torch.einsum("ia,jb,...abcd->...ijcd", B, B, dV_dS)
    if A is None:
        return Sensitivity(J, dM_dS, dM_du, dV_dmu, dV_dS, dV_du)

    AS = (
        (A @ S) if form.states is None else (A @ S)[..., form.states]
    )  # A C = (A S) J' B'
    dJ_dS = _whole(f.dJ_dS, form.states, n, 2)
    by_mean = _doubled(B, AS, _whole(2 * f.dM_dS, form.states, n))
    by_input = _doubled(B, AS, _whole(f.dJ_du, form.inputs, m))
    by_covariance = _doubled(B, AS, dJ_dS.flatten(-2)).unflatten(-1, dJ_dS.shape[-2:])
    # of A S A' + A S J' B' + B J S A' at a held J
    outer = (
        A[:, None, :, None] * (A + J)[..., None, :, None, :]
        + J[..., :, None, :, None] * A[:, None, :]
    )
    return Sensitivity(
        A + J,
        dM_dS,
        dM_du if form.G is None else form.G + dM_du,
        dV_dmu + by_mean,
        dV_dS + by_covariance + (outer + outer.mT) / 2,
        dV_du + by_input,
    )


def _doubled(B: Tensor | None, AS: Tensor, dJ: Tensor) -> Tensor:
    """A S dJ' B' and its transpose (*batch, n, n, j), for derivatives dJ (*batch, k, n_s, j)."""
    moved = AS[..., None, :, :] @ dJ  # (*batch, k, n, j)
    if B is not None:
        moved = torch.einsum("ja,...aic->...jic", B, moved)
    return moved + moved.transpose(-3, -2)


def _whole(
    derivative: Tensor, places: list[int] | None, size: int, axes: int = 1
) -> Tensor:
    """Extends a derivative by some entries of a vector (its last axes) to one by all, ``size`` of them."""
    if places is None:
        return derivative
    full = derivative.new_zeros(*derivative.shape[:-axes], *[size] * axes)
    rows = torch.tensor(places, dtype=torch.long, device=derivative.device)
    full[(..., rows) if axes == 1 else (..., rows[:, None], rows)] = derivative
    return full
