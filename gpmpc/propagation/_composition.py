"""From the moments of latent functions f to those of the next state, with all derivatives.

    x+ = A x + G u + c + B f(x_s, u_s)

covers what a model with exact moments can be: next states (A = 0, B = I), differences (A = B = I), and the residual of
an affine nominal model, whose f depends on some states and inputs only. With C = Cov[x, B f] = S J' B' (Stein, 1981),

    mu+ = A mu + G u + c + B M,   Sigma+ = A S A' + A C + C' A' + B V B',   Cov[x, x+] = S A' + C

Derivatives follow by the product rule; those by S are kept symmetric in their last two indices.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpmpc.gaussian import Gaussian
from gpmpc.gp._posterior import AffineForm
from gpmpc.propagation._sensitivity import Sensitivity

_NOT_WANTED: Any = None


class Latent(NamedTuple):
    """Moments of f at x_s ~ N(mu_s, S_s), with derivatives by mu_s, S_s and u_s where they are wanted."""

    M: Tensor  # E[f] (*batch, k)
    V: Tensor  # Cov[f] (*batch, k, k)
    J: Tensor  # E[df/dx_s] (*batch, k, n_s)
    dM_dS: Tensor = _NOT_WANTED  # (*batch, k, n_s, n_s); half of dJ/dmu (Price, 1958)
    dM_du: Tensor = _NOT_WANTED  # (*batch, k, m_s)
    dV_dmu: Tensor = _NOT_WANTED  # (*batch, k, k, n_s)
    dV_dS: Tensor = _NOT_WANTED  # (*batch, k, k, n_s, n_s)
    dV_du: Tensor = _NOT_WANTED  # (*batch, k, k, m_s)
    dJ_dS: Tensor = _NOT_WANTED  # (*batch, k, n_s, n_s, n_s); needed where A is not zero
    dJ_du: Tensor = _NOT_WANTED  # (*batch, k, n_s, m_s); needed where A is not zero


class Composition:
    """The affine part of a model around its latent functions ``f``, an ``AffineForm``."""

    B: Any
    G: Any

    def __init__(self, form: AffineForm):
        self.f, self.A, self.G, self.c, self.B, self.states, self.inputs = form[:7]

    @classmethod
    def of(cls, model: Any) -> "Composition | None":
        """The composition of a model; None where it has no affine form, or one with angles or a tape."""
        form = getattr(model, "affine_form", None)
        return None if form is None or form.angles or form.tape is not None else cls(form)

    def seen(self, belief: Gaussian, input: Tensor) -> tuple[Gaussian, Tensor]:
        """Selects from a belief and an input what f depends on."""
        if self.states is None:
            return belief, input
        S = belief.covariance[..., self.states, :][..., self.states]
        return Gaussian(belief.mean[..., self.states], S), input[..., self.inputs]

    def moments(self, belief: Gaussian, input: Tensor, f: Latent) -> tuple[Tensor, Tensor, Tensor]:
        """mu+ (*batch, n), Sigma+ (*batch, n, n) and Cov[x, x+] (*batch, n, n), by the module's text."""
        M, V, S, A = f.M, f.V, belief.covariance, self.A
        cross = (S if self.states is None else S[..., self.states]) @ f.J.mT
        if self.B is not None:
            M, V, cross = M @ self.B.mT, self.B @ V @ self.B.mT, cross @ self.B.mT
        if A is None:
            return M, V, cross
        half = A @ cross
        M = M + (belief.mean if self.G is None else belief.mean @ A.mT + input @ self.G.mT + self.c)
        return M, A @ S @ A.mT + half + half.mT + V, S @ A.mT + cross

    def sensitivity(self, S: Tensor, f: Latent) -> Sensitivity:
        """The derivatives of mu+ and Sigma+ at a belief with covariance S (*batch, n, n)."""
        J, dM_dS, dM_du = self._by_state(f.J), self._by_state(f.dM_dS, 2), self._by_input(f.dM_du)
        dV_dmu, dV_dS, dV_du = self._by_state(f.dV_dmu), self._by_state(f.dV_dS, 2), self._by_input(f.dV_du)
        if self.B is not None:
            J, dM_du = self.B @ J, self.B @ dM_du
            dM_dS = torch.einsum("ia,...acd->...icd", self.B, dM_dS)
            dV_dmu, dV_du = (torch.einsum("ia,jb,...abc->...ijc", self.B, self.B, d) for d in (dV_dmu, dV_du))
            dV_dS = torch.einsum("ia,jb,...abcd->...ijcd", self.B, self.B, dV_dS)
        if self.A is None:
            return Sensitivity(J, dM_dS, dM_du, dV_dmu, dV_dS, dV_du)

        A = self.A
        AS = (A @ S) if self.states is None else (A @ S)[..., self.states]  # A C = (A S) J' B'
        dJ_dmu, dJ_dS = self._by_state(2 * f.dM_dS), self._by_state(f.dJ_dS, 2)
        by_mean = self._doubled(AS, dJ_dmu)
        by_input = self._doubled(AS, self._by_input(f.dJ_du))
        by_covariance = self._doubled(AS, dJ_dS.flatten(-2)).unflatten(-1, dJ_dS.shape[-2:])
        # of A S A' + A S J' B' + B J S A' at a held J
        outer = A[:, None, :, None] * (A + J)[..., None, :, None, :] + J[..., :, None, :, None] * A[:, None, :]
        return Sensitivity(
            A + J,
            dM_dS,
            dM_du if self.G is None else self.G + dM_du,
            dV_dmu + by_mean,
            dV_dS + by_covariance + (outer + outer.mT) / 2,
            dV_du + by_input,
        )

    def _doubled(self, AS: Tensor, dJ: Tensor) -> Tensor:
        """A S dJ' B' and its transpose (*batch, n, n, j), for derivatives dJ (*batch, k, n_s, j)."""
        moved = AS[..., None, :, :] @ dJ  # (*batch, k, n, j)
        if self.B is not None:
            moved = torch.einsum("ja,...aic->...jic", self.B, moved)
        return moved + moved.transpose(-3, -2)

    def _by_state(self, derivative: Tensor, axes: int = 1) -> Tensor:
        """Extends a derivative by the states of f (its last axes) to one by the whole state."""
        if self.states is None:
            return derivative
        full = derivative.new_zeros(*derivative.shape[:-axes], *[len(self.B)] * axes)
        if axes == 1:
            full[..., self.states] = derivative
        else:
            rows = torch.tensor(self.states, device=derivative.device)
            full[..., rows[:, None], rows] = derivative
        return full

    def _by_input(self, derivative: Tensor) -> Tensor:
        if self.inputs is None:
            return derivative
        full = derivative.new_zeros(*derivative.shape[:-1], self.G.shape[1])
        full[..., self.inputs] = derivative
        return full
