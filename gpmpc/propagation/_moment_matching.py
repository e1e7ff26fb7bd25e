"""Exact moment matching through SE-ARD GPs f, alone or around an affine model.

    x+ = A x + G u + c + B f(x_s, u_s)

covers what a model with exact moments can be: next states (A = 0, B = I), differences
(A = B = I), and the residual of an affine nominal model, whose f depends on some states
and inputs only. With C = Cov[x, B f] = S J' B' (Stein, 1981),

    mu+       = A mu + G u + c + B M
    Sigma+    = A S A' + A C + C' A' + B V B'
    Cov[x, x+] = S A' + C

Derivatives follow by the product rule; those by S are kept symmetric in their last two
indices. M, V and J are ``_moments``'.
"""

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import UnsupportedModel, check_flag
from gpmpc.gaussian import Gaussian
from gpmpc.gp._backend import host_arrays
from gpmpc.gp._posterior import AffineForm, GPPosterior
from gpmpc.propagation._moments import (
    LatentDerivatives,
    LatentMoments,
    moments,
    moments_with_jacobian,
)
from gpmpc.propagation._points import Unscented
from gpmpc.propagation._propagator import (
    NextMoments,
    NoisyPropagator,
    Propagation,
    Propagator,
    Sensitivity,
    checked_arguments,
)


@explains_arguments
class MomentMatching(NoisyPropagator):
    """Exact moment matching through GPs, alone or around an affine nominal model.

    The model is a ``GPPosterior``, or a ``ResidualModel`` with an affine nominal part;
    of any other ``propagate`` raises ``UnsupportedModel``.

    Args:
        diagonal: Takes the outputs as independent: only the diagonal of the predicted
            covariance is computed, at a quarter of the cost for six outputs.
        process_noise: Whether the noise variance sn2 is added to the predicted
            covariance. In the paper's tables it is not.

    See Also:
        ``Linearization``, which is faster and takes any model.
    """

    def __init__(self, diagonal: bool = False, process_noise: bool = True):
        check_flag("diagonal", diagonal)
        super().__init__(process_noise)
        self.diagonal = diagonal

    def differentiate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity]:
        """Propagates with all derivatives in closed form, compiled or by torch."""
        input = checked_arguments(model, belief, input)
        form = _exact_form(model)
        f, df = self._latent_moments_with_jacobian(form, belief, input)
        sensitivity = _derivatives(form, belief.covariance, input.shape[-1], f, df)
        next_moments = _through_affine_part(form, belief, input, f)
        return self._complete_step(model, next_moments, sensitivity)

    def _next_moments(self, model: Any, belief: Gaussian, input: Tensor) -> NextMoments:
        form = _exact_form(model)
        f = self._latent_moments(form, belief, input)
        return _through_affine_part(form, belief, input, f)

    def _latent_moments(
        self, form: AffineForm, belief: Gaussian, input: Tensor
    ) -> LatentMoments:
        """Returns the moments of f."""
        x, u = _arguments_of_gps(form, belief, input)
        compiled = self._compiled_moments(form.f, x, u, derivatives=False)
        if compiled is not None:
            return compiled[0]
        return moments(form.f, x, u, self.diagonal)

    def _latent_moments_with_jacobian(
        self, form: AffineForm, belief: Gaussian, input: Tensor
    ) -> tuple[LatentMoments, LatentDerivatives]:
        """Returns the moments of f, and their derivatives."""
        x, u = _arguments_of_gps(form, belief, input)
        compiled = self._compiled_moments(form.f, x, u, derivatives=True)
        if compiled is not None:
            return compiled
        return moments_with_jacobian(
            form.f,
            x,
            u,
            diagonal=self.diagonal,
            slope_derivatives=form.A is not None,
        )

    def _compiled_moments(
        self, f: GPPosterior, belief: Gaussian, input: Tensor, derivatives: bool
    ) -> tuple[LatentMoments, LatentDerivatives] | None:
        """Returns the moments of f by the compiled loops; None where torch has to.

        Without ``derivatives`` the tensors of the derivatives are empty.
        """
        arrays = host_arrays(
            belief.mean, belief.covariance, input, gps_on_host=f.on_host
        )
        if arrays is None:
            return None
        from gpmpc import _kernels as kernels  # loads numba

        mean, covariance, control = arrays
        batch = mean.shape[:-1]
        H = math.prod(batch)
        matched = kernels.gp_moments(
            f.packed,
            mu=mean.reshape(H, mean.shape[-1]),
            S=covariance.reshape(H, *covariance.shape[-2:]),
            u=control.reshape(H, control.shape[-1]),
            diagonal=self.diagonal,
            derivatives=derivatives,
        )

        def tensor(rows: kernels.Array) -> Tensor:
            return torch.from_numpy(rows.reshape(*batch, *rows.shape[1:]))

        latent_moments = LatentMoments(
            M=tensor(matched.M).add_(f.offset),
            V=tensor(matched.V),
            J=tensor(matched.J),
        )
        latent_derivatives = LatentDerivatives(
            dM_dS=tensor(matched.dM_dS),
            dM_du=tensor(matched.dM_du),
            dV_dmu=tensor(matched.dV_dmu),
            dV_dS=tensor(matched.dV_dS),
            dV_du=tensor(matched.dV_du),
            dJ_dS=tensor(matched.dJ_dS),
            dJ_du=tensor(matched.dJ_du),
        )
        return latent_moments, latent_derivatives


@explains_arguments
def best_propagator(model: Any) -> Propagator:
    """Makes ``MomentMatching()`` if a model has exact moments, else ``Unscented()``.

    >>> from gpmpc.models import KnownModel
    >>> model = KnownModel(lambda x, u: x, state_dim=1, input_dim=0)
    >>> type(best_propagator(model)).__name__
    'Unscented'

    See Also:
        ``MomentMatching``; ``Unscented``; ``Linearization``, the fastest.
    """
    return MomentMatching() if _has_exact_moments(model) else Unscented()


def _has_exact_moments(model: Any) -> bool:
    """Whether a model has an affine form, and one without angles or a tape."""
    form = getattr(model, "affine_form", None)
    return form is not None and not form.angles and form.tape is None


def _exact_form(model: Any) -> AffineForm:
    """Returns the affine form of a model that has exact moments."""
    if not _has_exact_moments(model):
        raise UnsupportedModel(
            "MomentMatching needs a GPPosterior, or a ResidualModel of an Affine "
            f"nominal model and one; got {type(model).__name__}. Possible with any "
            "model: MeanEquivalence, Linearization, Unscented, MonteCarlo"
        )
    return model.affine_form


def _arguments_of_gps(
    form: AffineForm, belief: Gaussian, input: Tensor
) -> tuple[Gaussian, Tensor]:
    """Returns the belief over the states x_s, and the inputs u_s, that f depends on."""
    if form.states is None:
        return belief, input
    S = belief.covariance[..., form.states, :][..., form.states]
    return Gaussian(belief.mean[..., form.states], S), input[..., form.inputs]


def _through_affine_part(
    form: AffineForm, belief: Gaussian, input: Tensor, f: LatentMoments
) -> NextMoments:
    """Returns mu+, Sigma+ and Cov[x, x+], by the module's text."""
    S = belief.covariance
    A = form.A
    M = f.M
    V = f.V
    C = (S if form.states is None else S[..., form.states]) @ f.J.mT
    if form.B is not None:
        M = M @ form.B.mT
        V = form.B @ V @ form.B.mT
        C = C @ form.B.mT
    nominal: Tensor | float = 0.0  # A mu + G u + c
    if A is not None:
        nominal = belief.mean @ A.mT
    if form.G is not None:
        nominal = nominal + input @ form.G.mT
    if form.c is not None:
        nominal = nominal + form.c
    mean = M + nominal
    if A is None:
        return NextMoments(mean=mean, covariance=V, cross_covariance=C)
    AC = A @ C
    return NextMoments(
        mean=mean,
        covariance=A @ S @ A.mT + AC + AC.mT + V,
        cross_covariance=S @ A.mT + C,
    )


def _derivatives(
    form: AffineForm, S: Tensor, m: int, f: LatentMoments, df: LatentDerivatives
) -> Sensitivity:
    """Returns the derivatives of mu+ and Sigma+.

    Args:
        form: The model.
        S: The belief's covariance (*batch, n, n).
        m: Number of inputs.
        f: The moments of the GPs.
        df: Their derivatives.
    """
    A = form.A
    n = S.shape[-1]
    through_gps = _derivatives_of_residual(form, f, df, n, m)  # of B M and B V B'
    mean_by_input = through_gps.mean_by_input
    if form.G is not None:
        mean_by_input = form.G + mean_by_input
    if A is None:
        return replace(through_gps, mean_by_input=mean_by_input)
    assert df.dJ_dS is not None  # those of J are computed where A is not zero
    assert df.dJ_du is not None
    BJ = through_gps.mean_by_mean
    # Sigma+ has A C = A S (B J)' and its transpose. They change with J ...
    AS = A @ S
    if form.states is not None:
        AS = AS[..., form.states]
    dJ_dmu = 2 * df.dM_dS  # Price's theorem
    dJ_dS = _extend_matrix(df.dJ_dS, form.states, n)
    by_mean = _with_transpose(form.B, AS, _extend(dJ_dmu, form.states, n))
    by_input = _with_transpose(form.B, AS, _extend(df.dJ_du, form.inputs, m))
    by_covariance = _with_transpose(form.B, AS, dJ_dS.flatten(-2))
    by_covariance = by_covariance.unflatten(-1, dJ_dS.shape[-2:])
    # ... and, together with A S A', with S: of A S (A + B J)' + B J S A' the derivative
    # while J stays; A and A + B J stand on both sides of dS
    by_inner_covariance = torch.einsum("ic,...jd->...ijcd", A, A + BJ) + torch.einsum(
        "...ic,jd->...ijcd", BJ, A
    )
    return Sensitivity(
        mean_by_mean=A + BJ,
        mean_by_covariance=through_gps.mean_by_covariance,
        mean_by_input=mean_by_input,
        covariance_by_mean=through_gps.covariance_by_mean + by_mean,
        covariance_by_covariance=through_gps.covariance_by_covariance
        + by_covariance
        + (by_inner_covariance + by_inner_covariance.mT) / 2,
        covariance_by_input=through_gps.covariance_by_input + by_input,
    )


def _derivatives_of_residual(
    form: AffineForm, f: LatentMoments, df: LatentDerivatives, n: int, m: int
) -> Sensitivity:
    """Returns the derivatives of B M and B V B' by all n states and m inputs."""
    dM_dmu = _extend(f.J, form.states, n)
    dM_dS = _extend_matrix(df.dM_dS, form.states, n)
    dM_du = _extend(df.dM_du, form.inputs, m)
    dV_dmu = _extend(df.dV_dmu, form.states, n)
    dV_dS = _extend_matrix(df.dV_dS, form.states, n)
    dV_du = _extend(df.dV_du, form.inputs, m)
    B = form.B
    if B is not None:
        dM_dmu = B @ dM_dmu
        dM_du = B @ dM_du
        dM_dS = torch.einsum("ia,...acd->...icd", B, dM_dS)
        dV_dmu = torch.einsum("ia,jb,...abc->...ijc", B, B, dV_dmu)
        dV_du = torch.einsum("ia,jb,...abc->...ijc", B, B, dV_du)
        dV_dS = torch.einsum("ia,jb,...abcd->...ijcd", B, B, dV_dS)
    return Sensitivity(
        mean_by_mean=dM_dmu,
        mean_by_covariance=dM_dS,
        mean_by_input=dM_du,
        covariance_by_mean=dV_dmu,
        covariance_by_covariance=dV_dS,
        covariance_by_input=dV_du,
    )


def _with_transpose(B: Tensor | None, AS: Tensor, dJ: Tensor) -> Tensor:
    """Returns A S dJ' B' and its transpose, of derivatives dJ (*batch, k, n_s, j).

    The result is (*batch, n, n, j).
    """
    product = AS[..., None, :, :] @ dJ  # (*batch, k, n, j)
    if B is not None:
        product = torch.einsum("ja,...aic->...jic", B, product)
    return product + product.transpose(-3, -2)


def _extend(derivative: Tensor, places: list[int] | None, size: int) -> Tensor:
    """Extends a derivative by some entries of a vector to one by all, its last axis."""
    if places is None:
        return derivative
    full = derivative.new_zeros(*derivative.shape[:-1], size)
    full[..., _indices(places, derivative)] = derivative
    return full


def _extend_matrix(derivative: Tensor, places: list[int] | None, size: int) -> Tensor:
    """Extends a derivative by a part of a matrix to one by all, its last two axes."""
    if places is None:
        return derivative
    full = derivative.new_zeros(*derivative.shape[:-2], size, size)
    rows = _indices(places, derivative)
    full[..., rows[:, None], rows] = derivative
    return full


def _indices(places: list[int], like: Tensor) -> Tensor:
    return torch.tensor(places, dtype=torch.long, device=like.device)
