"""Nonlinear MPC on the true model.

NMPC is the best that a controller can do which knows the plant, and the paper's
benchmark: a ``Problem`` under x_{i+1} = plant(x_i, u_i), from the belief's mean;
constraints hold for the states themselves, since the model is taken to be true. It
generated the data of Cao, Lai and Alam (2017), whose sum over N = H + 1 states starts
at the measured one (its cost is constant) and has one input more, which only pays for
itself.

Multiple shooting in CasADi (Andersson et al., 2019), solved by IPOPT (Waechter and
Biegler, 2006) with exact derivatives. It starts from the previous input repeated: the
last plan shifted saves an interior-point method nothing, and led IPOPT to a worse local
minimum on the paper's elliptical flight, where the end of a plan costs little.
"""

from collections.abc import Sequence
from time import perf_counter
from typing import Any, NamedTuple

import casadi
import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc._interrupts import interrupts_after
from gpmpc.exceptions import check_number
from gpmpc.gaussian import Gaussian
from gpmpc.gp.casadi_ import successor_function
from gpmpc.mpc._constraints import ConstraintRows
from gpmpc.mpc._controller import (
    FEASIBLE,
    KEPT,
    Decision,
    Reference,
    Request,
    Timing,
    check_controller,
)
from gpmpc.mpc._linear_quadratic import Plan
from gpmpc.mpc._sqp import FAILURES
from gpmpc.mpc.problem import Problem
from gpmpc.signals import signals_of
from gpmpc.status import Status
from gpmpc.systems import System
from gpmpc.systems._system import check_system

Array = np.ndarray

_STATUSES = {
    "Solve_Succeeded": Status.SOLVED,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
    "Maximum_Iterations_Exceeded": Status.ITERATION_LIMIT,
    "Maximum_CpuTime_Exceeded": Status.TIME_LIMIT,
    "Maximum_WallTime_Exceeded": Status.TIME_LIMIT,
}


@explains_arguments
class NMPC:
    """Nonlinear MPC on the true model.

    Problem, horizon and initial input are those of ``GPMPC``, and so are the errors.
    Soft constraints get one slack variable a row and stage, with their price.

    Args:
        plant: The model, and what ``x_{i+1} = plant(x_i, u_i)`` means.
        problem: Weights and bounds.
        horizon: H, the number of predicted states.
        initial_input: The input before the first step (m,).
        tolerance: IPOPT's, on the scaled optimality conditions.
    """

    def __init__(
        self,
        plant: System,
        problem: Problem,
        horizon: int,
        initial_input: Sequence[float],
        tolerance: float = 1e-10,
    ):
        check_system("plant", plant)
        self.signals = signals_of(plant)
        self.initial_input = check_controller(
            problem,
            states=len(plant.dynamics.state_names),
            inputs=len(plant.dynamics.input_names),
            horizon=horizon,
            initial_input=initial_input,
            input_names=self.signals.input_names,
        )
        check_number("tolerance", tolerance, above=0)
        self.plant = plant
        problem = problem.with_angles(getattr(plant, "angle_indices", ()))
        self.problem = problem
        self.horizon = horizon
        self._program = _build(plant, problem, horizon, tolerance)

    def control(
        self, belief: Gaussian, reference: Reference, previous: Decision | None = None
    ) -> Decision:
        """Solves the problem from the belief's mean; see ``Controller.control``.

        Covariances are not predicted: kappas of a reference raise ``SettingError``.
        """
        n = self.problem.state_dim
        m = self.problem.input_dim
        H = self.horizon
        start = perf_counter()
        request = Request.read(
            self.problem,
            H,
            self.initial_input,
            belief,
            reference,
            previous,
            signals=self.signals,
        )
        request.refuse_kappas("NMPC")
        if not request.finite:
            return request.failed_decision(Status.INVALID_MEASUREMENT)
        parameters = _parameters(request)
        try:
            guess = self._guess(request)
        except (*FAILURES, ArithmeticError):  # where the plant has no numbers
            return request.failed_decision(Status.NUMERICAL_TROUBLE)
        with interrupts_after():
            solution = self._program.solve(guess, parameters)
        unknowns = solution.unknowns
        means = np.vstack([request.state, unknowns[: H * n].reshape(H, n)])
        inputs = unknowns[H * n : H * (n + m)].reshape(H, m)
        status = solution.status
        stopped = status not in (Status.SOLVED, Status.INFEASIBLE)
        if status is Status.SOLVED and solution.soft_violation > KEPT:
            status = Status.SOFT_BOUND_MISSED
        return Decision(
            input=inputs[0],
            inputs=inputs,
            means=means,
            covariances=np.zeros((H + 1, n, n)),
            status=status,
            iterations=solution.iterations,
            timing=Timing(solve=perf_counter() - start),
            suboptimal=stopped and bool(solution.hard_violation <= FEASIBLE),
            violation=solution.violation,
        )

    def _guess(self, request: Request) -> Array:
        """Returns unknowns to start from: the last input held, without slack."""
        lower, upper = self.problem.inputs.by_stage(self.horizon)
        inputs = request.constant_guess.clip(lower, upper)
        states = [request.state]
        for input in inputs:
            after = self.plant.successor(states[-1], input)
            states.append(np.array(after, dtype=float))
        guess = np.concatenate([*states[1:], inputs.ravel()])
        unknowns = np.zeros(len(self._program.unknowns.lower))
        unknowns[: len(guess)] = guess
        return unknowns


class _Bounds(NamedTuple):
    """Bounds of the entries of a vector."""

    lower: Array
    upper: Array

    def violation(self, values: Array) -> float:
        """Returns the largest distance beyond a bound; 0 inside all, NaN of a NaN."""
        excess = np.maximum(self.lower - values, values - self.upper)
        return float(excess.max(initial=0.0))


class _Solution(NamedTuple):
    """Where IPOPT ended."""

    unknowns: Array  # x_1 .. x_H, u_0 .. u_{H-1} and slacks
    status: Status
    iterations: int
    hard_violation: float  # largest one of what has no slack; NaN where it is unknown
    soft_violation: float  # largest one of soft constraints, without their slack

    @property
    def violation(self) -> float:
        """The largest violation, 0 inside all; NaN where it is unknown."""
        return float(np.maximum(self.hard_violation, self.soft_violation))


class _Program(NamedTuple):
    """The nonlinear program of a step, and IPOPT for it."""

    solver: casadi.Function
    unknowns: _Bounds  # of x_1 .. x_H, u_0 .. u_{H-1} and slacks
    constraints: _Bounds
    soft_rows: casadi.Function  # values of the soft rows at the unknowns
    soft_bounds: _Bounds  # of these

    def solve(self, guess: Array, parameters: Array) -> _Solution:
        """Solves the program from a guess of its unknowns."""
        solution = self.solver(
            x0=guess,
            p=parameters,
            lbx=self.unknowns.lower,
            ubx=self.unknowns.upper,
            lbg=self.constraints.lower,
            ubg=self.constraints.upper,
        )
        stats = self.solver.stats()
        unknowns = np.array(solution["x"]).ravel()
        values = np.array(solution["g"]).ravel()
        soft_values = np.array(self.soft_rows(unknowns)).ravel()
        hard_violations = [
            self.unknowns.violation(unknowns),
            self.constraints.violation(values),
        ]
        return _Solution(
            unknowns=unknowns,
            status=_STATUSES.get(stats["return_status"], Status.NUMERICAL_TROUBLE),
            iterations=stats["iter_count"],
            hard_violation=float(np.max(hard_violations)),  # NaN where one is
            soft_violation=self.soft_bounds.violation(soft_values),
        )


class _Entries:
    """Unknowns or constraints of a program, with their bounds, as they are added."""

    def __init__(self) -> None:
        self._values: list[casadi.SX] = []
        self._bounds: list[Array] = []

    def add(self, values: casadi.SX, lower: Any, upper: Any) -> None:
        """Adds values (k, H), a column a stage, and bounds (H, k) or one for all."""
        stages = (values.shape[1], values.shape[0])
        sides = [np.broadcast_to(side, stages).ravel() for side in (lower, upper)]
        self._values.append(casadi.vec(values))
        self._bounds.append(np.array(sides))

    @property
    def values(self) -> casadi.SX:
        """All of them, one below the other."""
        return casadi.vertcat(*self._values)

    @property
    def bounds(self) -> _Bounds:
        """The bounds of all of them."""
        lower, upper = np.hstack([np.empty((2, 0)), *self._bounds])
        return _Bounds(lower, upper)


def _parameters(request: Request) -> Array:
    """Returns the values of the program's parameters."""
    references = request.references
    return np.concatenate(
        [
            request.state,
            references.previous_input,
            references.states.ravel(),
            references.inputs.ravel(),
        ]
    )


def _build(plant: System, problem: Problem, horizon: int, tolerance: float) -> _Program:
    """Returns the program of multiple shooting."""
    problem.check_plain("NMPC")
    successor_function(plant)  # says what CasADi cannot follow
    n = problem.state_dim
    m = problem.input_dim
    H = horizon
    initial_state = casadi.SX.sym("x0", n)
    previous_input = casadi.SX.sym("last", m)
    x = casadi.SX.sym("x", n, H)
    u = casadi.SX.sym("u", m, H)
    reference_states = casadi.SX.sym("r", n, H)
    reference_inputs = casadi.SX.sym("wanted", m, H)
    increments = u - casadi.horzcat(previous_input, u[:, :-1])
    penalized = {
        "inputs": u,
        "deviations": u - reference_inputs,
        "increments": increments,
    }
    Q, R = problem.cost.by_stage(H)
    cost = _sum_of_squares(R, penalized[problem.cost.penalized])
    cost += _sum_of_squares(Q, x - reference_states)

    unknowns = _Entries()
    unknowns.add(x, -np.inf, np.inf)
    lower, upper = problem.inputs.by_stage(H)
    unknowns.add(u, lower, upper)

    constraints = _Entries()
    successors = _successors(plant, casadi.horzcat(initial_state, x[:, :-1]), u)
    constraints.add(x - successors, 0.0, 0.0)
    if problem.input_rates.finite:
        lower, upper = problem.input_rates.by_stage(H)
        constraints.add(increments, lower, upper)
    soft = _Entries()
    cost = _constrain_states(problem, x, cost, unknowns, constraints, soft)

    parameters = casadi.vertcat(
        initial_state,
        previous_input,
        casadi.vec(reference_states),
        casadi.vec(reference_inputs),
    )
    program = {
        "x": unknowns.values,
        "f": cost,
        "g": constraints.values,
        "p": parameters,
    }
    solver = casadi.nlpsol("nmpc", "ipopt", program, _options(tolerance))
    return _Program(
        solver=solver,
        unknowns=unknowns.bounds,
        constraints=constraints.bounds,
        soft_rows=casadi.Function("soft_rows", [unknowns.values], [soft.values]),
        soft_bounds=soft.bounds,
    )


def _options(tolerance: float) -> dict[str, Any]:
    """Returns the options of CasADi and IPOPT."""
    ipopt = {
        "print_level": 0,
        "sb": "yes",
        "tol": tolerance,
        "max_iter": 500,
        "bound_relax_factor": 0.0,
    }
    return {"print_time": False, "show_eval_warnings": False, "ipopt": ipopt}


def _sum_of_squares(weights: Array, values: casadi.SX) -> casadi.SX:
    """Returns sum_k v_k' W_k v_k of columns v_k, weights (H, k, k)."""
    total = casadi.SX(0)
    for weight, value in zip(weights, casadi.horzsplit(values), strict=True):
        total += casadi.bilin(casadi.DM(weight), value, value)
    return total


def _successors(plant: System, states: casadi.SX, inputs: casadi.SX) -> casadi.SX:
    """Returns the plant's next state (n, H) of every stage."""
    stages = zip(casadi.horzsplit(states), casadi.horzsplit(inputs), strict=True)
    return casadi.horzcat(*[casadi.vertcat(*plant.successor(x, u)) for x, u in stages])


def _constrain_states(
    problem: Problem,
    x: casadi.SX,
    cost: casadi.SX,
    unknowns: _Entries,
    constraints: _Entries,
    soft_rows: _Entries,
) -> casadi.SX:
    """Adds constraints of states (n, H) and their slacks; returns the whole cost.

    Soft rows are added once more, without slack.
    """
    n, H = x.shape
    rows = ConstraintRows(problem, H, "none")
    if not rows.per_stage:
        return cost
    no_plan = Plan(np.empty((0, n)), np.empty((0, problem.input_dim)), np.empty(0))
    stage_rows = rows.at(no_plan, np.empty(0), H)
    values = casadi.mtimes(casadi.DM(stage_rows.E[0]), x)
    soft = np.flatnonzero(np.isfinite(rows.prices))
    if len(soft):
        lower = np.broadcast_to(stage_rows.lower, (H, len(rows.prices)))
        upper = np.broadcast_to(stage_rows.upper, (H, len(rows.prices)))
        soft_rows.add(values[soft.tolist(), :], lower[:, soft], upper[:, soft])
    slack = casadi.SX.sym("slack", len(soft), H)
    for index, row in enumerate(soft):
        # A soft row gives way on its side.
        values[int(row), :] -= rows.signs[row] * slack[index, :]
        cost += rows.prices[row] * casadi.sum2(slack[index, :])
    constraints.add(values, stage_rows.lower, stage_rows.upper)
    unknowns.add(slack, 0.0, np.inf)
    return cost
