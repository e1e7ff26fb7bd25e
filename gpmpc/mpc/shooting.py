"""Problem: the cost of a plan under a learned model, and how it and its chance constraints answer to every input.

For the belief recursion (mu_{i+1}, Sigma_{i+1}) = F(mu_i, Sigma_i, u_i) of a propagator, the sensitivities
J_i = dF/d(mu, vec Sigma) and G_i = dF/du of each step follow from one pass forward (single shooting). Any function
phi(mu_1, Sigma_1, .., mu_H, Sigma_H) has its derivatives from one sweep backward, the discrete adjoint (Bryson and Ho,
1975, section 2.2),

    lam_H = dphi/ds_H,   lam_i = dphi/ds_i + J_i' lam_{i+1},   dphi/du_i = G_i' lam_{i+1},     s = [mu; vec Sigma]

and many functions have them from the same sweep, as rows of one matrix: the cost

    f(U) = sum_i |mu_i - r_i|^2_Q + tr(Q Sigma_i) + sum_i |v_i|^2_R        (Cao, Lai and Alam, 2017, section 3.2)

and the margins of the chance constraints, g = +-(mu_j - bound_j) + kappa sqrt(Sigma_jj) <= 0.
"""

import time
from dataclasses import dataclass

import numpy as np
import torch

from gpmpc.dynamics import DynamicsModel
from gpmpc.gaussian import Gaussian
from gpmpc.mpc.request import Request
from gpmpc.mpc.tracking import TrackingProblem
from gpmpc.propagation import Propagator, differentiate


@dataclass(frozen=True)
class Shot:
    """A plan, where it leads, and its first derivatives; c margins in all.

    Attributes:
        plan: U, the inputs in one row (H m,).
        cost: f; the price of violated soft bounds is not in it.
        gradient: df/dU (H m,).
        margins: g (c,), stage by stage; a bound is kept where g <= 0.
        margin_jacobian: dg/dU (c, H m).
        mean_jacobian: dmu_i/dU of i = 1..H (H, n, H m).
        means: mu_0 .. mu_H (H + 1, n).
        covariances: Sigma_0 .. Sigma_H (H + 1, n, n).
    """

    plan: np.ndarray
    cost: float
    gradient: np.ndarray
    margins: np.ndarray
    margin_jacobian: np.ndarray
    mean_jacobian: np.ndarray
    means: np.ndarray
    covariances: np.ndarray


class Shooting:
    """The functions of one tracking problem on one model.

    Args:
        model: What was learned.
        propagator: How the belief moves.
        problem: Weights and bounds.
        horizon: H.
    """

    def __init__(self, model: DynamicsModel, propagator: Propagator, problem: TrackingProblem, horizon: int):
        self.model, self.propagator, self.problem, self.horizon = model, propagator, problem, horizon
        H, m, limits = horizon, problem.input_dim, problem.state_bounds
        self.differences = np.kron(np.eye(H) - np.eye(H, k=-1), np.eye(m))  # U -> u_i - u_{i-1}, without u_{-1}
        penalized = self.differences if problem.penalized == "increments" else np.eye(H * m)
        self._penalized, self._R = penalized, np.kron(np.eye(H), problem.R)
        self.input_hessian = 2 * penalized.T @ self._R @ penalized
        self._weights = np.array([problem.Q] * (H - 1) + [problem.terminal])
        lower, upper = ([], []) if limits is None else (limits.lower, limits.upper)
        above, below = np.flatnonzero(np.isfinite(lower)), np.flatnonzero(np.isfinite(upper))
        self._bounded = np.concatenate([above, below]).astype(int)
        self._side = np.concatenate([-np.ones(len(above)), np.ones(len(below))])
        self._bound = np.concatenate([np.take(lower, above), np.take(upper, below)])
        self._kappa = 0.0 if limits is None else limits.kappa

    @property
    def margin_count(self) -> int:
        """c, the bounded sides of states over the horizon."""
        return self.horizon * len(self._bounded)

    def start(self, request: Request) -> np.ndarray:
        """u_{-1} in the place of the first input, zeros after it (H m,): ``differences @ U - start`` are the rates."""
        start = np.zeros(len(self.differences))
        start[: len(request.last)] = request.last
        return start

    def __call__(self, plan: np.ndarray, request: Request) -> tuple[Shot, float]:
        """Cost, margins and derivatives of a plan U (H m,), and the seconds spent in the model [s]."""
        began = time.perf_counter()
        means, covariances, by_state, by_input = self._forward(plan, request)
        seconds = time.perf_counter() - began
        H, n, rows = self.horizon, self.problem.state_dim, len(self._bounded)
        errors = means[1:] - request.targets
        weighted = np.einsum("iab,ib->ia", self._weights, errors)
        offset = {"inputs": 0.0, "deviations": request.wanted.ravel(), "increments": self.start(request)}
        v = self._penalized @ plan - offset[self.problem.penalized]
        cost = (errors * weighted).sum() + (self._weights * covariances[1:]).sum() + v @ self._R @ v

        seeds = np.zeros((H, 1 + H * n + H * rows, n + n * n))  # by stage, row (cost, means, margins), and s
        seeds[:, 0, :n] = 2 * weighted
        seeds[:, 0, n:] = self._weights.reshape(H, -1)
        variances = covariances[1:].diagonal(axis1=-2, axis2=-1)[:, self._bounded].clip(0)  # (H, rows)
        deviations = np.sqrt(variances)
        # A root has no derivative where a variance vanishes; the variance is at its least there: zero is in between.
        slope = np.divide(self._kappa / 2, deviations, out=np.zeros_like(deviations), where=deviations > 0)
        for i in range(H):
            seeds[i, 1 + i * n : 1 + (i + 1) * n, :n] = np.eye(n)
            at = 1 + H * n + i * rows + np.arange(rows)
            seeds[i, at, self._bounded] = self._side
            seeds[i, at, n + self._bounded * (n + 1)] = slope[i]
        jacobian = _backward(by_state, by_input, seeds)
        margins = self._side * (means[1:, self._bounded] - self._bound) + self._kappa * deviations
        shot = Shot(
            plan=plan,
            cost=float(cost),
            gradient=jacobian[0] + 2 * self._penalized.T @ (self._R @ v),
            margins=margins.ravel(),
            margin_jacobian=jacobian[1 + H * n :],
            mean_jacobian=jacobian[1 : 1 + H * n].reshape(H, n, -1),
            means=means,
            covariances=covariances,
        )
        return shot, seconds

    def curvature(self, shot: Shot) -> np.ndarray:
        """The Gauss-Newton Hessian of the cost (H m, H m): that of |mu - r|^2_Q with mu linearised, and of the inputs.

        Raised by a thousandth of a millionth of its diagonal, so that it has a Cholesky factor without an input weight.
        """
        J = shot.mean_jacobian
        hessian = 2 * np.einsum("iaj,iab,ibk->jk", J, self._weights, J, optimize=True) + self.input_hessian
        diagonal = hessian.diagonal()
        hessian[np.diag_indices_from(hessian)] += 1e-9 * np.where(diagonal > 0, diagonal, max(diagonal.max(), 1.0))
        return hessian

    def _forward(self, plan: np.ndarray, request: Request) -> tuple[np.ndarray, ...]:
        """Means and covariances of stages 0..H, and the steps' J_i (H, p, p) and G_i (H, p, m), p = n + n^2."""
        n, m = self.problem.state_dim, self.problem.input_dim
        to_model = {"dtype": self.model.dtype, "device": self.model.device}
        belief = Gaussian(torch.tensor(request.state, **to_model), torch.tensor(request.covariance, **to_model))
        means, covariances, by_state, by_input = [request.state], [request.covariance], [], []
        for u in torch.tensor(plan.reshape(-1, m), **to_model):
            moved, d = differentiate(self.propagator, self.model, belief, u)
            belief = moved.belief
            state_rows = [d.mean_by_mean, d.mean_by_covariance, d.covariance_by_mean, d.covariance_by_covariance]
            M_m, M_S, S_m, S_S = (part.detach().cpu().numpy() for part in state_rows)
            M_u, S_u = d.mean_by_input.detach().cpu().numpy(), d.covariance_by_input.detach().cpu().numpy()
            J = np.empty((n + n * n, n + n * n))
            J[:n, :n], J[:n, n:] = M_m, M_S.reshape(n, -1)
            J[n:, :n], J[n:, n:] = S_m.reshape(-1, n), S_S.reshape(n * n, -1)
            by_state.append(J)
            by_input.append(np.concatenate([M_u, S_u.reshape(-1, m)]))
            means.append(belief.mean.detach().cpu().numpy())
            covariances.append(belief.covariance.detach().cpu().numpy())
        return tuple(np.array(part, dtype=float) for part in (means, covariances, by_state, by_input))


def _backward(by_state: np.ndarray, by_input: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """Rows dphi/dU (rows, H m) of functions whose partial derivatives by s_1 .. s_H are the seeds (H, rows, p)."""
    H, rows, _ = seeds.shape
    m = by_input.shape[-1]
    jacobian = np.empty((rows, H, m))
    adjoint = seeds[-1]
    for i in reversed(range(H)):
        jacobian[:, i] = adjoint @ by_input[i]
        if i:
            adjoint = seeds[i - 1] + adjoint @ by_state[i]
    return jacobian.reshape(rows, H * m)
