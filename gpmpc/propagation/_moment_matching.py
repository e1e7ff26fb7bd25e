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
    NextMoments,
    NoisyPropagator,
    Propagation,
    Propagator,
    Sensitivity,
    checked_input,
)


class MomentMatching(NoisyPropagator):
    """Exact moment matching through GPs, alone or around an affine nominal model.

    The model is a ``GPPosterior``, or a ``ResidualModel`` with an affine nominal part;
    of any other ``propagate`` raises ``UnsupportedModel``.

    Args:
        diagonal: Takes the outputs as independent: only the diagonal of the predicted
            covariance is computed, at a quarter of the cost for six outputs.
        process_noise: Whether the noise variance sn2 is added to the predicted
            covariance. In the paper's tables it is not.
    """

    def __init__(self, diagonal: bool = False, process_noise: bool = True):
        super().__init__(process_noise)
        self.diagonal = diagonal

    def differentiate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity]:
        """Propagates with all derivatives in closed form, compiled or by torch."""
        input = checked_input(model, belief, input)
        form = _exact_form(model)
        f = self._latent_moments(form, belief, input, derivatives=True)
        sensitivity = _derivatives(form, belief.covariance, f)
        if self.diagonal:
            sensitivity = _of_diagonal(sensitivity)
        next_moments = _through_affine_part(form, belief, input, f)
        return self._add_noise(model, next_moments), sensitivity

    def _next_moments(self, model: Any, belief: Gaussian, input: Tensor) -> NextMoments:
        form = _exact_form(model)
        f = self._latent_moments(form, belief, input, derivatives=False)
        return _through_affine_part(form, belief, input, f)

    def _latent_moments(
        self, form: AffineForm, belief: Gaussian, input: Tensor, derivatives: bool
    ) -> Latent:
        """Returns the moments of f at the states and inputs that it depends on."""
        f = form.f
        if form.states is not None:
            S = belief.covariance[..., form.states, :][..., form.states]
            belief = Gaussian(belief.mean[..., form.states], S)
            input = input[..., form.inputs]
        arrays = host_arrays(f.weights, belief.mean, belief.covariance, input)
        if arrays is not None:
            _, mean, covariance, control = arrays
            return self._compiled_moments(f, mean, covariance, control, derivatives)
        if derivatives:
            return moments_with_jacobian(
                f,
                belief,
                input,
                diagonal=self.diagonal,
                slope_derivatives=form.A is not None,
            )
        matched = moments(f, belief, input, self.diagonal)
        return Latent(M=matched.M, V=matched.V, J=matched.J)

    def _compiled_moments(
        self, f: Any, mean: Any, covariance: Any, control: Any, derivatives: bool
    ) -> Latent:
        """Returns the moments of f at mean (*batch, n), by the compiled loops."""
        from gpmpc import _kernels as kernels  # loads numba

        batch = mean.shape[:-1]
        points = mean.reshape(-1, mean.shape[-1])
        H = len(points)
        matched = kernels.moments(
            f.packed,
            mu=points,
            S=covariance.reshape(H, *covariance.shape[-2:]),
            u=control.reshape(H, control.shape[-1]),
            diagonal=self.diagonal,
            derivatives=derivatives,
        )

        def tensor(rows: kernels.Array) -> Tensor:
            return torch.from_numpy(rows.reshape(*batch, *rows.shape[1:]))

        return Latent(
            M=tensor(matched.M).add_(f.offset),
            V=tensor(matched.V),
            J=tensor(matched.J),
            dM_dS=tensor(matched.dM_dS),
            dM_du=tensor(matched.dM_du),
            dV_dmu=tensor(matched.dV_dmu),
            dV_dS=tensor(matched.dV_dS),
            dV_du=tensor(matched.dV_du),
            dJ_dS=tensor(matched.dJ_dS),
            dJ_du=tensor(matched.dJ_du),
        )


def best_propagator(model: Any) -> Propagator:
    """Makes ``MomentMatching()`` if a model has exact moments, else ``Unscented()``."""
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


def _through_affine_part(
    form: AffineForm, belief: Gaussian, input: Tensor, f: Latent
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
    if A is None:
        return NextMoments(mean=M, covariance=V, cross_covariance=C)
    nominal = belief.mean  # of differences, where A = I
    if form.G is not None and form.c is not None:
        nominal = belief.mean @ A.mT + input @ form.G.mT + form.c
    AC = A @ C
    return NextMoments(
        mean=M + nominal,
        covariance=A @ S @ A.mT + AC + AC.mT + V,
        cross_covariance=S @ A.mT + C,
    )


def _derivatives(form: AffineForm, S: Tensor, f: Latent) -> Sensitivity:
    """Returns the derivatives of mu+ and Sigma+ at a covariance S (*batch, n, n)."""
    A = form.A
    n = S.shape[-1]
    m = 0 if form.G is None else form.G.shape[1]
    sensitivity = _derivatives_of_residual(form, f, n, m)  # of B M and B V B'
    if A is None:
        return sensitivity
    J = sensitivity.mean_by_mean  # B J
    mean_by_input = sensitivity.mean_by_input
    # A C = (A S) J' B' changes with J ...
    AS = A @ S
    if form.states is not None:
        AS = AS[..., form.states]
    dJ_dS = _extend_matrix(f.dJ_dS, form.states, n)
    by_mean = _doubled(form.B, AS, _extend(2 * f.dM_dS, form.states, n))
    by_input = _doubled(form.B, AS, _extend(f.dJ_du, form.inputs, m))
    by_covariance = _doubled(form.B, AS, dJ_dS.flatten(-2))
    by_covariance = by_covariance.unflatten(-1, dJ_dS.shape[-2:])
    # ... and A S A' + A S J' B' + B J S A' with S, at one J
    outer = (
        A[:, None, :, None] * (A + J)[..., None, :, None, :]
        + J[..., :, None, :, None] * A[:, None, :]
    )
    return Sensitivity(
        mean_by_mean=A + J,
        mean_by_covariance=sensitivity.mean_by_covariance,
        mean_by_input=mean_by_input if form.G is None else form.G + mean_by_input,
        covariance_by_mean=sensitivity.covariance_by_mean + by_mean,
        covariance_by_covariance=sensitivity.covariance_by_covariance
        + by_covariance
        + (outer + outer.mT) / 2,
        covariance_by_input=sensitivity.covariance_by_input + by_input,
    )


def _derivatives_of_residual(
    form: AffineForm, f: Latent, n: int, m: int
) -> Sensitivity:
    """Returns the derivatives of B M and B V B' by all n states and m inputs."""
    J = _extend(f.J, form.states, n)
    dM_dS = _extend_matrix(f.dM_dS, form.states, n)
    dM_du = _extend(f.dM_du, form.inputs, m)
    dV_dmu = _extend(f.dV_dmu, form.states, n)
    dV_dS = _extend_matrix(f.dV_dS, form.states, n)
    dV_du = _extend(f.dV_du, form.inputs, m)
    B = form.B
    if B is not None:
        J = B @ J
        dM_du = B @ dM_du
        dM_dS = torch.einsum("ia,...acd->...icd", B, dM_dS)
        dV_dmu = torch.einsum("ia,jb,...abc->...ijc", B, B, dV_dmu)
        dV_du = torch.einsum("ia,jb,...abc->...ijc", B, B, dV_du)
        dV_dS = torch.einsum("ia,jb,...abcd->...ijcd", B, B, dV_dS)
    return Sensitivity(
        mean_by_mean=J,
        mean_by_covariance=dM_dS,
        mean_by_input=dM_du,
        covariance_by_mean=dV_dmu,
        covariance_by_covariance=dV_dS,
        covariance_by_input=dV_du,
    )


def _doubled(B: Tensor | None, AS: Tensor, dJ: Tensor) -> Tensor:
    """Returns A S dJ' B' and its transpose, of derivatives dJ (*batch, k, n_s, j).

    The result is (*batch, n, n, j).
    """
    product = AS[..., None, :, :] @ dJ  # (*batch, k, n, j)
    if B is not None:
        product = torch.einsum("ja,...aic->...jic", B, product)
    return product + product.transpose(-3, -2)


def _of_diagonal(sensitivity: Sensitivity) -> Sensitivity:
    """Returns derivatives whose covariance keeps its diagonal only."""
    by_mean = sensitivity.covariance_by_mean
    eye = torch.eye(by_mean.shape[-2], dtype=by_mean.dtype, device=by_mean.device)
    eye = eye[..., None]
    return replace(
        sensitivity,
        covariance_by_mean=eye * by_mean,
        covariance_by_covariance=eye[..., None] * sensitivity.covariance_by_covariance,
        covariance_by_input=eye * sensitivity.covariance_by_input,
    )


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
