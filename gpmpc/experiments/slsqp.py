"""Solves nonlinear GP-MPC by SciPy's SLSQP, a generic optimiser: the reference for time in section 5.2 of the paper.

    minimise over u_0 .. u_{H-1}   sum_i |mu_i - r_i|^2_Q + tr(Q Sigma_i) + |v_i|^2_R
    subject to                     (mu_{i+1}, Sigma_{i+1}) = F(mu_i, Sigma_i, u_i), input and rate bounds,
                                   mu_ij -+ kappa sqrt(Sigma_ij,jj) within hard state bounds

(Cao, Lai and Alam, 2017, eq. (22)). States are eliminated by rolling the belief out (single shooting). Derivatives of
cost and margins come from one sweep of the discrete adjoint (Bryson and Ho, 1975, section 2.2) over those of F, in
s = [mu; vec Sigma]: lam_H = dphi/ds_H, lam_i = dphi/ds_i + (dF/ds)' lam_{i+1}, dphi/du_i = (dF/du)' lam_{i+1}.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.linalg import block_diag, solve_triangular
from scipy.optimize import minimize

from gpmpc._dynamics import check_next_states, tensors_for, to_array
from gpmpc.exceptions import DataError, SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.models import DynamicsModel
from gpmpc.mpc import Decision, Reference, Request, Timing
from gpmpc.mpc._controller import check_controller
from gpmpc.mpc.problem import Box, Problem
from gpmpc.propagation import Propagator, differentiate
from gpmpc.status import Status

Array = np.ndarray

ROUNDS = 8  # restarts with a fresh scaling
FEASIBLE = 1e-6  # violation of a margin, in its unit


@dataclass(frozen=True)
class Evaluation:
    """A plan, where it leads, and its first derivatives; c margins g <= 0 in all.

    Attributes:
        plan: U, the inputs in one row (H m,).
        cost: f.
        gradient: df/dU (H m,).
        margins: g (c,), stage by stage.
        margin_jacobian: dg/dU (c, H m).
        hessian: The Gauss-Newton Hessian of the cost of the means and inputs (H m, H m).
        means: mu_0 .. mu_H (H + 1, n).
        covariances: Sigma_0 .. Sigma_H (H + 1, n, n).
    """

    plan: Array
    cost: float
    gradient: Array
    margins: Array
    margin_jacobian: Array
    hessian: Array
    means: Array
    covariances: Array


class SLSQP:
    """Nonlinear GP-MPC by sequential least-squares programming.

    Args:
        model: What was learned.
        propagator: How the belief moves.
        problem: Weights and bounds; state bounds are hard.
        horizon: H.
        initial_input: The input before the first step (m,).
        tolerance: Of a plan: root of the decrease of the cost in the last round, relative to the cost and the plan.
        iterations: Of one decision.

    Raises:
        SettingError: As for ``GPMPC``, or state bounds with a price.
    """

    def __init__(
        self,
        model: DynamicsModel,
        propagator: Propagator,
        problem: Problem,
        horizon: int,
        initial_input: Sequence[float],
        tolerance: float = 1e-5,
        iterations: int = 300,
    ):
        self.initial_input = check_controller(
            problem, *check_next_states(model), horizon, initial_input
        )
        H = horizon
        m = problem.input_dim
        cost = problem.cost
        boxes = [
            box
            for box in problem.constraints
            if isinstance(box, Box) and box.penalty is None and not box.joint
        ]
        if len(boxes) < len(problem.constraints) or any(
            box.lower.ndim > 1 or box.stages for box in boxes
        ):
            raise SettingError(
                "problem",
                "must have hard boxes (penalty=None) at all stages, or no constraints",
            )
        problem.check_plain("SLSQP")
        self.model = model
        self.propagator = propagator
        self.problem = problem
        self.horizon = horizon
        self.tolerance = tolerance
        self.iterations = iterations
        self._differences = np.kron(
            np.eye(H) - np.eye(H, k=-1), np.eye(m)
        )  # U -> u_i - u_{i-1}, without u_{-1}
        self._penalized = (
            self._differences if cost.penalized == "increments" else np.eye(H * m)
        )
        self._weights, R = cost.by_stage(H)
        self._R = block_diag(*R)
        sides = [
            (side, sign, box)
            for box in boxes
            for side, sign in ((box.lower, -1.0), (box.upper, 1.0))
        ]
        entries = [
            (j, sign, bound[j], box.standard_deviations())
            for bound, sign, box in sides
            for j in np.flatnonzero(np.isfinite(bound))
        ]
        state, self._sign, self._bound, self._kappa = (
            np.array(entries, dtype=float).reshape(-1, 4).T
        )
        self._state = state.astype(int)

    def control(
        self, belief: Gaussian, reference: Reference, previous: Decision | None = None
    ) -> Decision:
        """Solves the problem from a belief along a reference; see ``Controller.control``."""
        began = time.perf_counter()
        request = Request.read(
            self.problem, self.horizon, self.initial_input, belief, reference, previous
        )
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        try:
            found, status, count = self._minimize(request)
        except (
            DataError,
            np.linalg.LinAlgError,
            RuntimeError,
        ):  # a trial plan led the model out of its numbers
            return request.failed_decision(Status.NUMERICAL_TROUBLE)
        inputs = found.plan.reshape(self.horizon, -1)
        timing = Timing(0.0, 0.0, time.perf_counter() - began)
        kept = bool((found.margins <= 1e3 * FEASIBLE).all())
        predicted = found.means, found.covariances, status, count, timing
        return Decision(
            inputs[0],
            inputs,
            *predicted,
            suboptimal=kept and status is Status.ITERATION_LIMIT,
        )

    def evaluate(self, inputs: Array, request: Request) -> Evaluation:
        """Cost, margins and derivatives of a plan (H, m), whose input bounds are not looked at."""
        plan, (H, n, r) = (
            np.asarray(inputs, dtype=float).ravel(),
            (self.horizon, self.problem.state_dim, len(self._state)),
        )
        means, covariances, by_state, by_input = self._roll_out(plan, request)
        errors = means[1:] - request.references.states
        weighted = np.einsum("iab,ib->ia", self._weights, errors)
        offset = {
            "inputs": 0.0,
            "deviations": request.references.inputs.ravel(),
            "increments": self._first(request.references.previous_input),
        }
        v = self._penalized @ plan - offset[self.problem.cost.penalized]
        cost = (
            (errors * weighted).sum()
            + (self._weights * covariances[1:]).sum()
            + v @ self._R @ v
        )
        sd = np.sqrt(
            covariances[1:].diagonal(axis1=-2, axis2=-1)[:, self._state].clip(0)
        )  # (H, r)
        slope = np.divide(self._kappa / 2, sd, out=np.zeros_like(sd), where=sd > 0)
        seeds = np.zeros(
            (H, 1 + H * n + H * r, n + n * n)
        )  # by stage, row (cost, means, margins), and s
        seeds[:, 0, :n] = 2 * weighted
        seeds[:, 0, n:] = self._weights.reshape(H, -1)
        for i in range(H):
            seeds[i, 1 + i * n : 1 + (i + 1) * n, :n] = np.eye(n)
            rows = 1 + H * n + i * r + np.arange(r)
            seeds[i, rows, self._state], seeds[i, rows, n + self._state * (n + 1)] = (
                self._sign,
                slope[i],
            )
        jacobian = _adjoint(by_state, by_input, seeds)
        J = jacobian[1 : 1 + H * n].reshape(H, n, -1)
        hessian = 2 * np.einsum("iaj,iab,ibk->jk", J, self._weights, J, optimize=True)
        hessian += 2 * self._penalized.T @ self._R @ self._penalized
        gradient = jacobian[0] + 2 * self._penalized.T @ (self._R @ v)
        margins = self._sign * (means[1:, self._state] - self._bound) + self._kappa * sd
        return Evaluation(
            plan,
            float(cost),
            gradient,
            margins.ravel(),
            jacobian[1 + H * n :],
            hessian,
            means,
            covariances,
        )

    def _minimize(self, request: Request) -> tuple[Evaluation, Status, int]:
        """Rounds of SLSQP, each in inputs scaled by the Gauss-Newton Hessian, from the better of two plans."""
        lower, upper = (
            side.ravel() for side in self.problem.inputs.by_stage(self.horizon)
        )
        starts = [
            plan.ravel().clip(lower, upper)
            for plan in (request.constant_guess, request.initial_guess)
        ]
        found = min((self.evaluate(plan, request) for plan in starts), key=_rank)
        used = 0
        for _ in range(ROUNDS):
            scale = (
                abs(found.cost)
                + found.plan @ found.hessian @ found.plan
                + np.finfo(float).tiny
            )
            T = solve_triangular(
                np.linalg.cholesky(found.hessian), np.eye(len(found.plan)), lower=True
            ).T
            last = found
            result = self._round(
                found, T, scale, lower, upper, request, self.iterations - used
            )
            found = self.evaluate(
                (last.plan + T @ result.x).clip(lower, upper), request
            )
            used += int(result.nit)
            settled = abs(last.cost - found.cost) <= self.tolerance**2 * scale
            if (
                settled
                and (found.margins <= FEASIBLE).all()
                and self._keeps_rates(found.plan, request)
            ):
                return found, Status.SOLVED, used
            if used >= self.iterations:
                return min(found, last, key=_rank), Status.ITERATION_LIMIT, used
        kept = (found.margins <= FEASIBLE).all() and self._keeps_rates(
            found.plan, request
        )
        return found, Status.NUMERICAL_TROUBLE if kept else Status.INFEASIBLE, used

    def _keeps_rates(self, plan: Array, request: Request) -> bool:
        rates = (
            self._differences @ plan - self._first(request.references.previous_input)
        ).reshape(self.horizon, -1)
        bounds = self.problem.input_rates
        return bool(
            (np.maximum(rates - bounds.upper, bounds.lower - rates) <= FEASIBLE).all()
        )

    def _round(
        self,
        start: Evaluation,
        T: Array,
        scale: float,
        lower: Array,
        upper: Array,
        request: Request,
        limit: int,
    ):
        """One run in w, U = U_0 + T w."""
        memory = [start]

        def at(w: Array) -> Evaluation:
            plan = start.plan + T @ w
            if not np.array_equal(plan, memory[0].plan):
                memory[0] = self.evaluate(plan, request)
            return memory[0]

        rows = [np.eye(len(T))]
        low = [lower]
        high = [upper]
        if self.problem.input_rates.finite:
            first = self._first(request.references.previous_input)
            H = self.horizon
            rows.append(self._differences)
            low.append(np.tile(self.problem.input_rates.lower, H) + first)
            high.append(np.tile(self.problem.input_rates.upper, H) + first)
        C, low, high = (np.concatenate(parts) for parts in (rows, low, high))
        C, low, high = C @ T, low - C @ start.plan, high - C @ start.plan
        C = np.concatenate([C, -C])
        b = np.concatenate([low, -high])
        C = C[np.isfinite(b)]
        b = b[np.isfinite(b)]
        kept = {
            "type": "ineq",
            "fun": lambda w: np.concatenate([C @ w - b, -at(w).margins]),
            "jac": lambda w: np.concatenate([C, -at(w).margin_jacobian @ T]),
        }
        return minimize(
            lambda w: at(w).cost,
            np.zeros(len(T)),
            jac=lambda w: T.T @ at(w).gradient,
            method="SLSQP",
            constraints=[kept] if len(C) + len(start.margins) else [],
            options={"ftol": 0.1 * self.tolerance**2 * scale, "maxiter": max(1, limit)},
        )

    def _first(self, last: Array) -> Array:
        """u_{-1} in the place of the first input, zeros after it (H m,)."""
        return np.concatenate([last, np.zeros((self.horizon - 1) * len(last))])

    def _roll_out(self, plan: Array, request: Request) -> tuple[Array, ...]:
        """Means and covariances of stages 0 .. H, and dF/ds (H, p, p) and dF/du (H, p, m), p = n + n^2."""
        n = self.problem.state_dim
        m = self.problem.input_dim
        belief = Gaussian(*tensors_for(self.model, request.state, request.covariance))
        beliefs = [belief]
        by_state = []
        by_input = []
        for u in tensors_for(self.model, plan.reshape(-1, m))[0]:
            moved, d = differentiate(self.propagator, self.model, beliefs[-1], u)
            beliefs.append(moved.belief)
            means = torch.cat(
                [d.mean_by_mean, d.mean_by_covariance.reshape(n, -1)], dim=1
            )
            spreads = [
                d.covariance_by_mean.reshape(-1, n),
                d.covariance_by_covariance.reshape(n * n, -1),
            ]
            by_state.append(to_array(torch.cat([means, torch.cat(spreads, dim=1)])))
            by_input.append(
                to_array(
                    torch.cat([d.mean_by_input, d.covariance_by_input.reshape(-1, m)])
                )
            )
        means, covariances = (
            [to_array(part) for part in parts]
            for parts in zip(*[(b.mean, b.covariance) for b in beliefs], strict=True)
        )
        return tuple(map(np.array, (means, covariances, by_state, by_input)))


def _rank(found: Evaluation) -> tuple[bool, float]:
    """Smaller for the better of two plans."""
    return bool((found.margins > FEASIBLE).any()), found.cost


def _adjoint(by_state: Array, by_input: Array, seeds: Array) -> Array:
    """Rows dphi/dU (rows, H m) of functions whose partial derivatives by s_1 .. s_H are the seeds (H, rows, p)."""
    H, rows, _ = seeds.shape
    jacobian = np.empty((rows, H, by_input.shape[-1]))
    adjoint = seeds[-1]
    for i in reversed(range(H)):
        jacobian[:, i] = adjoint @ by_input[i]
        if i:
            adjoint = seeds[i - 1] + adjoint @ by_state[i]
    return jacobian.reshape(rows, -1)
