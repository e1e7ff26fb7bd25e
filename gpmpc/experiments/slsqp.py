"""Nonlinear GP-MPC by SciPy's SLSQP, a generic optimiser.

It is the reference for time in section 5.2 of Cao, Lai and Alam (2017), and solves
their eq. (22):

    minimise over u_0 .. u_{H-1}
        sum_i |mu_i - r_i|^2_Q + tr(Q Sigma_i) + |v_i|^2_R
    subject to
        (mu_{i+1}, Sigma_{i+1}) = F(mu_i, Sigma_i, u_i),
        input and rate bounds,
        mu_ij -+ kappa sqrt(Sigma_ij,jj) within hard state bounds

States are eliminated by rolling the belief out (single shooting). Derivatives of cost
and margins come from one sweep of the discrete adjoint (Bryson and Ho, 1975, section
2.2) over those of F, in s = [mu; vec Sigma]:

    lam_H = dphi/ds_H
    lam_i = dphi/ds_i + (dF/ds)' lam_{i+1}
    dphi/du_i = (dF/du)' lam_{i+1}
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import block_diag, solve_triangular
from scipy.optimize import OptimizeResult, minimize

from gpmpc._dynamics import check_next_states, tensors_for, to_array
from gpmpc.exceptions import DataError, SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.models import DynamicsModel
from gpmpc.mpc import Box, Decision, Problem, Reference, Request, Timing
from gpmpc.mpc._controller import check_controller
from gpmpc.propagation import Propagator, Sensitivity, differentiate
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
        hessian: Gauss-Newton, of the cost of the means and inputs (H m, H m).
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


class RollOut(NamedTuple):
    """Beliefs along a plan, and the derivatives of each by the one before.

    s stacks mean and covariance; it has p = n + n^2 entries.
    """

    means: Array  # of stages 0 .. H (H + 1, n)
    covariances: Array  # (H + 1, n, n)
    by_state: Array  # dF/ds (H, p, p)
    by_input: Array  # dF/du (H, p, m)


class Optimum(NamedTuple):
    """The end of all rounds."""

    evaluation: Evaluation
    status: Status
    iterations: int


class Scaling(NamedTuple):
    """Coordinates w of one round, U = U_0 + T w, in which the Hessian is about I."""

    T: Array  # (H m, H m)
    cost: float  # size of the cost: what its decrease is relative to


class SLSQP:
    """Nonlinear GP-MPC by sequential least-squares programming.

    Args:
        model: What was learned.
        propagator: How the belief moves.
        problem: Weights and bounds; state bounds are hard.
        horizon: H.
        initial_input: The input before the first step (m,).
        tolerance: Of a plan: root of the decrease of the cost in the last round,
            relative to the cost and the plan.
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
        state_count, input_count = check_next_states(model)
        self.initial_input = check_controller(
            problem, state_count, input_count, horizon, initial_input
        )
        boxes = _hard_boxes(problem)
        problem.check_plain("SLSQP")
        self.model = model
        self.propagator = propagator
        self.problem = problem
        self.horizon = horizon
        self.tolerance = tolerance
        self.iterations = iterations
        self._set_cost()
        self._set_margins(boxes)

    def _set_cost(self) -> None:
        """Reads the weights of all stages, and what the inputs are weighed by."""
        H = self.horizon
        m = self.problem.input_dim
        cost = self.problem.cost
        # U -> u_i - u_{i-1}, without u_{-1}
        self._differences = np.kron(np.eye(H) - np.eye(H, k=-1), np.eye(m))
        self._penalized: Array = np.eye(H * m)
        if cost.penalized == "increments":
            self._penalized = self._differences
        self._weights, R = cost.by_stage(H)
        self._R = block_diag(*R)

    def _set_margins(self, boxes: Sequence[Box]) -> None:
        """Makes one margin of every finite state bound.

        sign (x - bound) + kappa sd <= 0 for the state x that it bounds.
        """
        states: list[int] = []
        signs: list[float] = []
        bounds: list[float] = []
        kappas: list[float] = []
        for box in boxes:
            for side, sign in ((box.lower, -1.0), (box.upper, 1.0)):
                for j in np.flatnonzero(np.isfinite(side)):
                    states.append(int(j))
                    signs.append(sign)
                    bounds.append(float(side[j]))
                    kappas.append(float(box.standard_deviations()))
        self._state = np.array(states, dtype=int)
        self._sign = np.array(signs, dtype=float)
        self._bound = np.array(bounds, dtype=float)
        self._kappa = np.array(kappas, dtype=float)

    def control(
        self, belief: Gaussian, reference: Reference, previous: Decision | None = None
    ) -> Decision:
        """Solves the problem along a reference; see ``Controller.control``."""
        start = time.perf_counter()
        request = Request.read(
            problem=self.problem,
            horizon=self.horizon,
            initial_input=self.initial_input,
            belief=belief,
            reference=reference,
            previous=previous,
        )
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        try:
            optimum = self._minimize(request)
        except (DataError, np.linalg.LinAlgError, RuntimeError):
            # a trial plan led the model out of its numbers
            return request.failed_decision(Status.NUMERICAL_TROUBLE)
        evaluation = optimum.evaluation
        inputs = evaluation.plan.reshape(self.horizon, -1)
        keeps_bounds = bool((evaluation.margins <= 1e3 * FEASIBLE).all())
        return Decision(
            input=inputs[0],
            inputs=inputs,
            means=evaluation.means,
            covariances=evaluation.covariances,
            status=optimum.status,
            iterations=optimum.iterations,
            timing=Timing(0.0, 0.0, time.perf_counter() - start),
            suboptimal=keeps_bounds and optimum.status is Status.ITERATION_LIMIT,
        )

    def evaluate(self, inputs: Array, request: Request) -> Evaluation:
        """Computes cost, margins and derivatives of a plan (H, m).

        Its input bounds are not looked at.
        """
        plan = np.asarray(inputs, dtype=float).ravel()
        H = self.horizon
        n = self.problem.state_dim
        roll_out = self._roll_out(plan, request)
        means = roll_out.means
        covariances = roll_out.covariances
        errors = means[1:] - request.references.states
        weighted = np.einsum("iab,ib->ia", self._weights, errors)
        v = self._penalized @ plan - self._input_reference(request)
        cost = (
            (errors * weighted).sum()
            + (self._weights * covariances[1:]).sum()
            + v @ self._R @ v
        )
        variances = covariances[1:].diagonal(axis1=-2, axis2=-1)
        sd = np.sqrt(variances[:, self._state].clip(0))  # (H, r)
        jacobian = _adjoint(
            roll_out.by_state, roll_out.by_input, self._seeds(weighted, sd)
        )
        J = jacobian[1 : 1 + H * n].reshape(H, n, -1)  # of the means
        hessian = 2 * np.einsum("iaj,iab,ibk->jk", J, self._weights, J, optimize=True)
        hessian += 2 * self._penalized.T @ self._R @ self._penalized
        gradient = jacobian[0] + 2 * self._penalized.T @ (self._R @ v)
        margins = self._sign * (means[1:, self._state] - self._bound) + self._kappa * sd
        return Evaluation(
            plan=plan,
            cost=float(cost),
            gradient=gradient,
            margins=margins.ravel(),
            margin_jacobian=jacobian[1 + H * n :],
            hessian=hessian,
            means=means,
            covariances=covariances,
        )

    def _input_reference(self, request: Request) -> Array | float:
        """Returns what the penalized inputs are measured from (H m,)."""
        penalized = self.problem.cost.penalized
        if penalized == "deviations":
            return request.references.inputs.ravel()
        if penalized == "increments":
            return self._first(request.references.previous_input)
        return 0.0

    def _seeds(self, weighted_errors: Array, sd: Array) -> Array:
        """Returns partial derivatives of cost, means and margins by s_1 .. s_H.

        Returns:
            (H, rows, p); the rows are the cost, H n means, H r margins.
        """
        H, n = weighted_errors.shape
        r = len(self._state)
        slope = np.divide(self._kappa / 2, sd, out=np.zeros_like(sd), where=sd > 0)
        seeds = np.zeros((H, 1 + H * n + H * r, n + n * n))
        seeds[:, 0, :n] = 2 * weighted_errors
        seeds[:, 0, n:] = self._weights.reshape(H, -1)
        for i in range(H):
            seeds[i, 1 + i * n : 1 + (i + 1) * n, :n] = np.eye(n)
            rows = 1 + H * n + i * r + np.arange(r)
            seeds[i, rows, self._state] = self._sign
            seeds[i, rows, n + self._state * (n + 1)] = slope[i]
        return seeds

    def _minimize(self, request: Request) -> Optimum:
        """Runs rounds of SLSQP from the better of two plans.

        Each is in inputs scaled by the Gauss-Newton Hessian.
        """
        lower_sides, upper_sides = self.problem.inputs.by_stage(self.horizon)
        lower = lower_sides.ravel()
        upper = upper_sides.ravel()
        starts = [
            self.evaluate(plan.ravel().clip(lower, upper), request)
            for plan in (request.constant_guess, request.guessed_inputs)
        ]
        current = min(starts, key=_rank)
        iterations = 0
        for _ in range(ROUNDS):
            start = current
            scaling = _scaling(start)
            result = self._round(
                start=start,
                scaling=scaling,
                lower=lower,
                upper=upper,
                request=request,
                limit=self.iterations - iterations,
            )
            plan = (start.plan + scaling.T @ result.x).clip(lower, upper)
            current = self.evaluate(plan, request)
            iterations += int(result.nit)
            decrease = abs(start.cost - current.cost)
            is_settled = decrease <= self.tolerance**2 * scaling.cost
            if is_settled and self._is_feasible(current, request):
                return Optimum(current, Status.SOLVED, iterations)
            if iterations >= self.iterations:
                better = min(current, start, key=_rank)
                return Optimum(better, Status.ITERATION_LIMIT, iterations)
        status = Status.INFEASIBLE
        if self._is_feasible(current, request):
            status = Status.NUMERICAL_TROUBLE
        return Optimum(current, status, iterations)

    def _is_feasible(self, evaluation: Evaluation, request: Request) -> bool:
        """Returns whether a plan keeps the state bounds and the rates of the inputs."""
        if (evaluation.margins > FEASIBLE).any():
            return False
        first = self._first(request.references.previous_input)
        rates = (self._differences @ evaluation.plan - first).reshape(self.horizon, -1)
        bounds = self.problem.input_rates
        excess = np.maximum(rates - bounds.upper, bounds.lower - rates)
        return bool((excess <= FEASIBLE).all())

    def _round(
        self,
        start: Evaluation,
        scaling: Scaling,
        lower: Array,
        upper: Array,
        request: Request,
        limit: int,
    ) -> OptimizeResult:
        """Runs SLSQP once, in w, U = U_0 + T w."""
        T = scaling.T
        memory = [start]

        def at(w: Array) -> Evaluation:
            plan = start.plan + T @ w
            if not np.array_equal(plan, memory[0].plan):
                memory[0] = self.evaluate(plan, request)
            return memory[0]

        C, b = self._input_rows(lower, upper, request)
        b = b - C @ start.plan
        C = C @ T
        constraint = {
            "type": "ineq",
            "fun": lambda w: np.concatenate([C @ w - b, -at(w).margins]),
            "jac": lambda w: np.concatenate([C, -at(w).margin_jacobian @ T]),
        }
        tolerance = 0.1 * self.tolerance**2 * scaling.cost
        return minimize(
            lambda w: at(w).cost,
            np.zeros(len(T)),
            jac=lambda w: T.T @ at(w).gradient,
            method="SLSQP",
            constraints=[constraint] if len(C) + len(start.margins) else [],
            options={"ftol": tolerance, "maxiter": max(1, limit)},
        )

    def _input_rows(
        self, lower: Array, upper: Array, request: Request
    ) -> tuple[Array, Array]:
        """Returns input and rate bounds as rows C U >= b."""
        rows: list[Array] = [np.eye(len(lower))]
        low = [lower]
        high = [upper]
        rates = self.problem.input_rates
        if rates.finite:
            first = self._first(request.references.previous_input)
            rows.append(self._differences)
            low.append(np.tile(rates.lower, self.horizon) + first)
            high.append(np.tile(rates.upper, self.horizon) + first)
        one_sided = np.concatenate(rows)
        C = np.concatenate([one_sided, -one_sided])
        b = np.concatenate([*low, *(-side for side in high)])
        finite = np.isfinite(b)
        return C[finite], b[finite]

    def _first(self, last: Array) -> Array:
        """Returns u_{-1} in the place of the first input, zeros after it (H m,)."""
        return np.concatenate([last, np.zeros((self.horizon - 1) * len(last))])

    def _roll_out(self, plan: Array, request: Request) -> RollOut:
        """Propagates the belief along a plan, with derivatives."""
        m = self.problem.input_dim
        mean, covariance = tensors_for(self.model, request.state, request.covariance)
        belief = Gaussian(mean, covariance)
        beliefs = [belief]
        by_state = []
        by_input = []
        for u in tensors_for(self.model, plan.reshape(-1, m))[0]:
            step, sensitivity = differentiate(self.propagator, self.model, belief, u)
            belief = step.belief
            beliefs.append(belief)
            by_state.append(to_array(_by_state(sensitivity)))
            by_input.append(to_array(_by_input(sensitivity)))
        return RollOut(
            means=np.array([to_array(belief.mean) for belief in beliefs]),
            covariances=np.array([to_array(belief.covariance) for belief in beliefs]),
            by_state=np.array(by_state),
            by_input=np.array(by_input),
        )


def _hard_boxes(problem: Problem) -> list[Box]:
    """Returns the state bounds of a problem.

    Raises:
        SettingError: It has constraints other than hard boxes at all stages.
    """
    boxes = []
    for box in problem.constraints:
        if not isinstance(box, Box) or not _is_hard_at_all_stages(box):
            raise SettingError(
                "problem",
                "must have hard boxes (penalty=None) at all stages, or no constraints",
            )
        boxes.append(box)
    return boxes


def _is_hard_at_all_stages(box: Box) -> bool:
    is_hard = box.penalty is None and not box.joint
    return is_hard and box.lower.ndim == 1 and not box.stages


def _by_state(sensitivity: Sensitivity) -> torch.Tensor:
    """Returns dF/ds (p, p)."""
    n = len(sensitivity.mean_by_mean)
    of_mean = [
        sensitivity.mean_by_mean,
        sensitivity.mean_by_covariance.reshape(n, -1),
    ]
    of_covariance = [
        sensitivity.covariance_by_mean.reshape(-1, n),
        sensitivity.covariance_by_covariance.reshape(n * n, -1),
    ]
    return torch.cat([torch.cat(of_mean, dim=1), torch.cat(of_covariance, dim=1)])


def _by_input(sensitivity: Sensitivity) -> torch.Tensor:
    """Returns dF/du (p, m)."""
    m = sensitivity.mean_by_input.shape[-1]
    of_covariance = sensitivity.covariance_by_input.reshape(-1, m)
    return torch.cat([sensitivity.mean_by_input, of_covariance])


def _scaling(evaluation: Evaluation) -> Scaling:
    """Returns the coordinates of a round that starts from a plan."""
    plan = evaluation.plan
    hessian = evaluation.hessian
    cost = abs(evaluation.cost) + plan @ hessian @ plan + np.finfo(float).tiny
    root = np.linalg.cholesky(hessian)
    inverse = solve_triangular(root, np.eye(len(plan)), lower=True)
    return Scaling(T=inverse.T, cost=float(cost))


def _rank(evaluation: Evaluation) -> tuple[bool, float]:
    """Returns a key that is smaller for the better of two plans."""
    return bool((evaluation.margins > FEASIBLE).any()), evaluation.cost


def _adjoint(by_state: Array, by_input: Array, seeds: Array) -> Array:
    """Returns rows dphi/dU (rows, H m) by one sweep backwards.

    The seeds (H, rows, p) are the functions' partial derivatives by s_1 .. s_H.
    """
    H, rows, _ = seeds.shape
    jacobian = np.empty((rows, H, by_input.shape[-1]))
    adjoint = seeds[-1]
    for i in reversed(range(H)):
        jacobian[:, i] = adjoint @ by_input[i]
        if i:
            adjoint = seeds[i - 1] + adjoint @ by_state[i]
    return jacobian.reshape(rows, -1)
