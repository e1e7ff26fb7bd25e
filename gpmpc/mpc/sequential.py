"""Problem: one quadratic program is a step towards the optimal plan; a sequence of them reaches it.

Sequential quadratic programming (Nocedal and Wright, 2006, chapter 18): linearise along the plan, solve the program, go
as far towards its solution as the true cost falls, and again, until the plan is a KKT point. The whole step is tried
first, rolled out under the ancillary feedback towards the states that the program predicts: over a horizon that is
unstable in the open loop its inputs alone would lead elsewhere. Then the step length is found by backtracking on the
cost along the true rollout, with an exact penalty for the state bounds; the Gauss-Newton Hessian is corrected by damped
BFGS updates for the curvature of the Lagrangian that it misses (section 18.3 there).

Between the model's and the solver's arithmetic stands little, on few numbers. In Python it would cost more than both,
most where other work has emptied the caches between two control steps; so the sequence is one compiled loop
(``gpmpc.mpc.sequential_loop``). What it cannot compute it asks for, by yielding ``MODEL`` or ``PROGRAM``, and goes
on when its caller has answered: the stages along a plan, where no compiled rollout gives them, and the solution of a
program, where the solver is not ``DualActiveSet`` or ended otherwise than well.
"""

from functools import cached_property
from time import perf_counter
from typing import NamedTuple

import numpy as np

from gpmpc.compiled import compile_for, direct
from gpmpc.exceptions import DataError
from gpmpc.mpc import sequential_loop as loop
from gpmpc.mpc.chance_constraints import ChanceConstraints
from gpmpc.mpc.compiled_rollout import NO_MODEL, NOTHING
from gpmpc.mpc.condense import Condenser
from gpmpc.mpc.controller import Decision, Timing
from gpmpc.mpc.flat_arrays import Layout, flattened
from gpmpc.mpc.prediction import Predictor
from gpmpc.mpc.request import Request
from gpmpc.qp import DualActiveSet, QPSolution, QPSolver, QuadraticProgram, SoftRows
from gpmpc.qp import record as layout
from gpmpc.qp.solution import Terms
from gpmpc.status import Status

Array = np.ndarray

run = loop.programs  # until it is compiled


class Reached(NamedTuple):
    """Where a sequence of programs ended.

    Attributes:
        status: ``SOLVED``, the status of a program that could not be solved, ``ITERATION_LIMIT``, or
            ``NUMERICAL_TROUBLE`` where no step lowers the cost any more.
        suboptimal: Whether it is not ``SOLVED``, and the plan may be applied all the same.
        programs: How many.
        timing: Where the time went.
        program: The last one.
        solution: Of the last one.
        inputs: The plan (H, m): that solution, or the last one on the way to it that had a lower cost.
        states: s_0 .. s_H under it, by the last stage models (H + 1, p).
        covariances: Sigma_0 .. Sigma_H that these were made at (H + 1, n, n).
    """

    status: Status
    suboptimal: bool
    programs: int
    timing: Timing
    program: QuadraticProgram
    solution: QPSolution
    inputs: Array
    states: Array
    covariances: Array


class SequentialPrograms:
    """The sequence of programs of one controller.

    Args:
        predictor: Of the form ``"trajectory"``.
        condenser: Of its problem.
        chance: Of its problem.
        solver: Of the programs.
        soft: Prices of the rows of G.
        limit: Programs at most.
        tolerance: Of ``convergence.kkt_share``, estimated from the slower of the last two rates of convergence.
    """

    def __init__(
        self,
        predictor: Predictor,
        condenser: Condenser,
        chance: ChanceConstraints,
        solver: QPSolver,
        soft: SoftRows | None,
        limit: int,
        tolerance: float,
    ):
        global run
        compile_for(loop.programs, loop.SIGNATURE)
        run = direct(loop.programs)
        self._predictor, self._chance, self._solver, self._soft = predictor, chance, solver, soft
        self._condenser, self._limits = condenser, (limit, tolerance)
        problem, H, r = predictor.problem, predictor.horizon, len(chance.known[0])
        n, m, rows = problem.state_dim, problem.input_dim, condenser.bounds.rate_lower.size + predictor.horizon * r
        p, size = n * len(predictor.extended(problem.Q)), H * m
        self._ours = isinstance(solver, DualActiveSet)
        self._softness, self._work = (solver if self._ours else DualActiveSet()).workspace(rows, size, soft)
        K = H if chance.constant is None else 1
        stages = [(H, p, p), (H, p, m), (H, p), (H + 1, n, n), (H, m)]
        self._along = Layout([*stages, (K, r, p), (H, r), (H, r)])
        program = [(size, size), (size,), (rows, size), (size + rows,), (size + rows,)]
        found = [(layout.record_size(size, size + rows),), (size,), (H + 1, p), (H + 1, n, n), (loop.OUTCOMES,)]
        self._answer, self._inputs = Layout(program + found), slice(layout.HEADER, layout.HEADER + size)

    @cached_property
    def _with_rollout(self) -> tuple[Array, Array, Array]:
        return self._told(self._predictor.rollout.known)

    @cached_property
    def _without_rollout(self) -> tuple[Array, Array, Array]:
        return self._told(NO_MODEL)

    def _told(self, rollout: tuple) -> tuple[Array, Array, Array]:
        """What the loop knows of its controller: columns, what is flat, and its table."""
        uncertain, _, gp, columns, (offset, difference), *_, noise = rollout
        problem, (limit, tolerance) = self._predictor.problem, self._limits
        weight, terminal, R, penalized = self._condenser.cost
        *bounds, kappa, prices = self._chance.known
        constant = np.empty((1, 0, 1)) if self._chance.constant is None else self._chance.constant
        sides = problem.input_lower, problem.input_upper, problem.rate_lower, problem.rate_upper
        settings = np.array(
            [uncertain, self._predictor.feedback, difference, penalized, kappa, limit, tolerance], dtype=float
        )
        weights = problem.Q, problem.terminal, *sides, weight, terminal, R, *self._condenser.bounds
        return columns, *flattened([*gp, offset, noise, *weights, *bounds, prices, constant, settings])

    def __call__(self, request: Request, previous: Decision | None, warm: QPSolution | None) -> Reached:
        """Goes from the request's plan to an optimal one.

        Args:
            request: With a finite belief.
            previous: The last decision, whose means the first rollout follows.
            warm: The last solution; None starts from nothing.

        Raises:
            DataError: The first rollout left the finite numbers.
            ProblemError: A program is malformed, numerically.
        """
        began, predictor = perf_counter(), self._predictor
        compiled, follow = predictor.compiled, predictor.followed(request, previous)
        columns, known, places = self._with_rollout if compiled else self._without_rollout
        along, answer = np.empty(self._along.size), np.empty(self._answer.size)
        start = predictor.state(request.state, request.covariance)
        told = request.targets, request.wanted, request.last, request.shifted
        sequence = run(
            compiled,
            self._ours,
            columns,
            known,
            places,
            self._work,
            (start, request.covariance, request.disturbance, *told),
            NOTHING if follow is None else np.ascontiguousarray(follow),
            layout.NO_RECORD if warm is None or not self._ours else warm.record,
            along,
            self._along.table,
            answer,
            self._answer.table,
        )
        P, q, G, lower, upper, record, plan, states, covariances, outcome = self._answer.parts(answer)
        solution, first = None, True
        for wish in sequence:
            if wish != loop.PROGRAM:
                if not first:
                    follow = states[:-1, : len(request.state)] if wish == loop.GUIDED else None
                self._linearise(request, along, follow, first)
                first = False
            else:
                solution = self._solve((P, q, G, lower, upper), warm if solution is None else solution)
                record[:] = solution.record[: len(record)]
        status, suboptimal, count, build, solve = outcome.tolist()
        if self._ours:
            terms = Terms(P, G, self._softness)
            solution = QPSolution(record[self._inputs], terms, q, lower, upper, record, 0.0, solve)
        timing = Timing(perf_counter() - began - build - solve, build, solve)
        program, inputs = QuadraticProgram.unchecked(P, q, G, lower, upper), plan.reshape(request.shifted.shape)
        ended = layout.STATUSES[int(status)], bool(suboptimal), int(count)
        return Reached(*ended, timing, program, solution, inputs, states, covariances)

    def _linearise(self, request: Request, along: Array, follow: Array | None, first: bool) -> None:
        """The stages along a plan, from the model itself."""
        *stages, rows, low, high = self._along.parts(along)
        try:
            found = self._predictor.along(request, stages[-1], follow)
        except DataError:  # the rollout left the finite numbers; from the second one on a shorter step may not
            if first:
                raise
            along[: self._along.table[loop.PLAN, 0]] = np.nan
            return
        made = found.A, found.B, found.c, found.covariances, found.inputs
        for place, part in zip(stages, made, strict=True):
            place[:] = part
        low[:], high[:] = self._chance.limits(found)
        rows[:] = self._chance.rows(found)

    def _solve(self, program: tuple[Array, ...], warm: QPSolution | None) -> QPSolution:
        if self._ours:
            return self._solver.solve(QuadraticProgram.unchecked(*program), warm, self._soft)
        _, q, _, lower, _ = program
        fits = warm is not None and len(warm.q) == len(q) and len(warm.lower) == len(lower)
        return self._solver.solve(QuadraticProgram.from_stacked(*program), warm if fits else None)
